// The three steps by which loaders and generators put geometry into a scene: a material, an object
// that wears materials, an instance that places the object.
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "common/scene.h"

namespace tessera {

/// Each adds one entry and returns its index.
inline std::uint32_t add_material(SceneBundle& bundle, Material material) {
    bundle.scene.materials.push_back(std::move(material));
    return std::uint32_t(bundle.scene.materials.size() - 1);
}

inline std::uint32_t add_object(SceneBundle& bundle, std::string name, const Mesh& mesh,
                                std::vector<std::uint32_t> materials) {
    bundle.scene.objects.push_back({std::move(name), add_mesh(bundle, mesh), std::move(materials)});
    return std::uint32_t(bundle.scene.objects.size() - 1);
}

inline std::uint32_t add_instance(SceneBundle& bundle, std::string name, std::uint32_t object,
                                  const mat4& world_from_object = mat4(1)) {
    bundle.scene.instances.push_back({std::move(name), object, world_from_object});
    return std::uint32_t(bundle.scene.instances.size() - 1);
}

}  // namespace tessera
