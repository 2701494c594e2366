// The scenes of a server. Open scenes, those loaded at the start and those that a viewer has
// shared, stay for good: every viewer may use, watch and edit them. What a viewer uploads otherwise
// is its own, goes under a name of its own towards the workers, and lives as long as its session;
// viewers that upload the same scene hold one, so that workers build it once.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "common/scene_sync.h"

namespace tessera {

/// A scene in its newest version. `now.name` is the name by which workers know it, unique on this
/// server; versions count from 1 here, whatever the viewer's own numbers are.
struct StoredScene {
    ReadyScene now;
    std::uint64_t bytes = 0;  ///< meshes and textures
    /// Called after every change, by who wants to know.
    std::map<const void*, std::function<void()>> watchers;
};
using ScenePtr = std::shared_ptr<StoredScene>;

class SceneStore {
public:
    /// Keeps a name for a new open scene. Throws UserError when there is a scene of that name, or
    /// too many are open.
    void reserve(const std::string& name);
    void release(const std::string& name) { reserved_.erase(name); }
    /// A new open scene, whose name has been reserved; the names in its tables are unique.
    ScenePtr open(const ReadyScene& scene);

    /// What the viewer that held `before` (or nothing) under this name holds after its upload: an
    /// equal scene that somebody has uploaded if there is one, else a new version of `before` if
    /// nobody shares it, else a new scene.
    ScenePtr publish(const ScenePtr& before, const ReadyScene& uploaded);

    /// The scene has a newer version, and its watchers hear of it.
    void advance(const ScenePtr& scene, std::shared_ptr<const SceneVersion> version,
                 const BlobStore& blobs);

    /// Null when there is no open scene of that name.
    ScenePtr find_open(const std::string& name) const;
    std::vector<std::string> open_names() const;
    /// All scenes that somebody holds.
    std::vector<ScenePtr> all() const;

private:
    bool is_taken(const std::string& name) const;
    bool is_open(const ScenePtr& scene) const;
    ScenePtr add(const ReadyScene& scene);

    std::vector<ScenePtr> open_;
    std::set<std::string> reserved_;
    std::uint64_t uploads_ = 0;
    std::vector<std::weak_ptr<StoredScene>> scenes_;  ///< open and uploaded
};

}  // namespace tessera
