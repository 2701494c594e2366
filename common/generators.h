// The generators behind generate_scene(), one per file.
#pragma once

#include "common/scene.h"

namespace tessera {

SceneBundle generate_building();
SceneBundle generate_cornell();
SceneBundle generate_foliage();
SceneBundle generate_kitchen();
/// `triangles`: that fly.
SceneBundle generate_museum(std::uint32_t triangles);
SceneBundle generate_office();
SceneBundle generate_robots();
SceneBundle generate_rooms();
SceneBundle generate_shading();
SceneBundle generate_storeys(int storeys);
SceneBundle generate_sunflowers();
SceneBundle generate_terrain();

}  // namespace tessera
