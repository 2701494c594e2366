// The steps by which loaders and generators put geometry into a scene: a material, an object that
// wears materials, an instance that places the object.
#pragma once

#include <string>
#include <vector>

#include "common/scene.h"

namespace tessera {

/// Each adds one entry and returns its index.
std::uint32_t add_material(SceneBundle& bundle, Material material);
std::uint32_t add_object(SceneBundle& bundle, std::string name, const Mesh& mesh,
                         std::vector<std::uint32_t> materials);
std::uint32_t add_instance(SceneBundle& bundle, std::string name, std::uint32_t object,
                           const mat4& world_from_object = mat4(1));

/// Drops the materials that no object wears; returns how many.
std::size_t drop_unused_materials(Scene& scene);

/// validate() for a scene that came from `file`, where bad values are the user's: throws UserError.
void check_values(const Scene& scene, const std::string& file);

}  // namespace tessera
