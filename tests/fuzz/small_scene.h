// A scene with one or two of everything, for fuzzers to change.
#pragma once

#include "common/scene.h"

namespace tessera {

inline SceneBundle small_bundle() {
    SceneBundle bundle;
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
    mesh.triangles = {{0, 1, 2}};
    const std::uint32_t index = add_mesh(bundle, mesh);
    add_texture(bundle, {.width = 1, .height = 1, .rgba = {1, 2, 3, 4}});
    Scene& scene = bundle.scene;
    scene.materials.push_back({.name = "wood"});
    scene.materials.push_back({.name = "metal"});
    scene.objects.push_back({.name = "object", .mesh = index, .materials = {0}});
    scene.instances.push_back({.name = "a"});
    scene.instances.push_back({.name = "b"});
    scene.lights.push_back({.name = "lamp"});
    scene.cameras.push_back({.name = "camera"});
    validate(scene);
    return bundle;
}

inline Scene small_scene() { return small_bundle().scene; }

}  // namespace tessera
