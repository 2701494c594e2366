// The scenes of a server. Open scenes, those loaded at the start and those that a viewer has
// shared, stay for good: every viewer may use, watch and edit them. What a viewer uploads otherwise
// is its own, goes under a name of its own towards the workers, and lives as long as its session;
// viewers that upload the same scene hold one, so that workers build it once.
#pragma once

#include <functional>
#include <map>
#include <memory>
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
    /// A new open scene; its names become unique. Throws UserError when there is one of that name.
    ScenePtr open(const std::string& name, Scene scene, const BlobStore& blobs);

    /// What the viewer that held `before` (or nothing) under this name holds after its upload: an
    /// equal scene that somebody has uploaded if there is one, else a new version of `before` if
    /// nobody shares it, else a new scene.
    ScenePtr publish(const ScenePtr& before, const ReadyScene& uploaded);

    /// Makes the next version of an open scene if there is anything to change, and tells its
    /// watchers. What the operations name is in the scene or among the blobs `brought` along.
    /// Returns the complaints.
    std::vector<std::string> edit(const ScenePtr& scene,
                                  const std::vector<EditOperation>& operations,
                                  const BlobStore& brought = {});

    /// Null when there is no open scene of that name.
    ScenePtr find_open(const std::string& name) const;
    std::vector<std::string> open_names() const;
    /// All scenes that somebody holds.
    std::vector<ScenePtr> all() const;

private:
    bool is_taken(const std::string& name) const;
    bool is_open(const ScenePtr& scene) const;
    ScenePtr add(const std::string& name, SceneVersion version, const BlobStore& blobs);

    std::vector<ScenePtr> open_;
    std::uint64_t uploads_ = 0;
    std::vector<std::weak_ptr<StoredScene>> scenes_;  ///< open and uploaded
};

}  // namespace tessera
