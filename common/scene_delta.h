// Scene versions. Every change to a scene is a delta from one version to the next, and the law is
// apply(a, diff(a, b)) == b. A snapshot is the delta from the empty scene, version 0: there is one
// way to bring anybody from any version to the newest. After the state synchronisation of Winstein
// and Balakrishnan, "Mosh: An Interactive Remote Shell for Mobile Clients" (2012), in which a diff
// is applied only to the exact state that it was made from.
#pragma once

#include <cstdint>
#include <utility>
#include <vector>

#include "common/scene.h"

namespace tessera {

/// The change of one table: its new size, and the entries that differ, by index.
template <class T>
struct TableDelta {
    std::uint32_t size = 0;
    std::vector<std::pair<std::uint32_t, T>> changed;

    bool operator==(const TableDelta&) const = default;
};

struct SceneDelta {
    std::uint64_t base_version = 0;
    std::uint64_t next_version = 0;
    TableDelta<BlobId> meshes;
    TableDelta<BlobId> textures;
    TableDelta<BlobId> shapes;
    TableDelta<Object> objects;
    TableDelta<Instance> instances;
    TableDelta<Material> materials;
    TableDelta<Light> lights;
    TableDelta<Camera> cameras;
    Environment environment;  ///< of the next version

    bool operator==(const SceneDelta&) const = default;
};

/// A scene and the number of its version; version 0 is the empty scene.
struct SceneVersion {
    std::uint64_t version = 0;
    Scene scene;

    bool operator==(const SceneVersion&) const = default;
};

/// What leads from `base` to `next`; costs in proportion to what differs.
SceneDelta diff(const SceneVersion& base, const SceneVersion& next);

/// Throws std::runtime_error when `delta` was made from another version, names an entry outside its
/// table, or leaves a new entry unset; the result has passed validate().
SceneVersion apply(const SceneVersion& base, const SceneDelta& delta);

}  // namespace tessera
