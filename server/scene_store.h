// The scenes of a server. Those loaded at the start stay for good, open to every viewer. What a
// viewer uploads is its own, goes under a name of its own towards the workers, and lives as long as
// its session; viewers that upload the same scene share one, so that workers build it once.
#pragma once

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
};
using ScenePtr = std::shared_ptr<StoredScene>;

class SceneStore {
public:
    /// Throws UserError when a scene of that name is loaded already.
    ScenePtr load(const std::string& name, const SceneBundle& bundle);

    /// What the viewer that held `before` (or nothing) under this name holds after its upload: an
    /// equal scene if there is one, else a new version of `before` if nobody shares it, else a new
    /// scene.
    ScenePtr publish(const ScenePtr& before, const ReadyScene& uploaded);

    /// A scene loaded at the start; null when there is none of that name.
    ScenePtr find_loaded(const std::string& name) const;
    std::vector<std::string> loaded_names() const;
    /// All scenes that somebody holds.
    std::vector<ScenePtr> all() const;

private:
    ScenePtr add(const std::string& name, SceneVersion version, const BlobStore& blobs);

    std::vector<ScenePtr> loaded_;
    std::uint64_t uploads_ = 0;
    std::vector<std::weak_ptr<StoredScene>> scenes_;  ///< loaded and uploaded
};

}  // namespace tessera
