// A still life of what material shaders do: a wooden table before a brick wall on a marble floor,
// after the shading examples of Wald's thesis (2004, figure 13.10).
#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr vec3 size(3.2f, 2.4f, 3.0f);  ///< of the room, which is open towards +z

Mesh floor() {
    MeshBuilder builder;
    builder.quad({0, 0, size.z}, {size.x, 0, size.z}, {size.x, 0, 0}, {0, 0, 0});
    return builder.take();
}

/// The wall at the back, and those at the sides.
Mesh walls() {
    MeshBuilder builder;
    builder.quad({0, 0, 0}, {size.x, 0, 0}, {size.x, size.y, 0}, {0, size.y, 0});
    builder.slot(1).quad({0, 0, size.z}, {0, 0, 0}, {0, size.y, 0}, {0, size.y, size.z});
    builder.quad({size.x, 0, 0}, {size.x, 0, size.z}, {size.x, size.y, size.z},
                 {size.x, size.y, 0});
    builder.quad({0, size.y, 0}, {size.x, size.y, 0}, {size.x, size.y, size.z},
                 {0, size.y, size.z});
    return builder.take();
}

/// Origin in the middle of the top's underside.
Mesh table() {
    MeshBuilder builder;
    builder.rounded_box({-0.75f, 0, -0.4f}, {0.75f, 0.045f, 0.4f}, 0.01f);
    for (const float x : {-0.68f, 0.68f})
        for (const float z : {-0.33f, 0.33f})
            builder.rounded_box({x - 0.03f, -0.68f, z - 0.03f}, {x + 0.03f, 0, z + 0.03f}, 0.005f);
    return builder.take();
}

Mesh ball(float radius) {
    MeshBuilder builder;
    builder.ball(vec3(0), radius, 48);
    return builder.take();
}

Mesh vase() {
    const vec2 profile[] = {{0, 0},         {0.07f, 0},     {0.07f, 0},      {0.1f, 0.06f},
                            {0.11f, 0.12f}, {0.09f, 0.2f},  {0.05f, 0.27f},  {0.045f, 0.31f},
                            {0.06f, 0.34f}, {0.06f, 0.34f}, {0.052f, 0.34f}, {0.037f, 0.31f},
                            {0.04f, 0.27f}};
    MeshBuilder builder;
    builder.lathe(vec3(0), profile, 40);
    return builder.take();
}

Mesh lamp() {
    MeshBuilder builder;
    builder.quad({-0.35f, 0, -0.35f}, {0.35f, 0, -0.35f}, {0.35f, 0, 0.35f}, {-0.35f, 0, 0.35f});
    return builder.take();
}

}  // namespace

SceneBundle generate_shading() {
    SceneBundle bundle;
    const auto wood = add_material(bundle, {.name = "oak",
                                            .base_color = {0.62f, 0.38f, 0.18f},
                                            .roughness = 0.45f,
                                            .specular = 0.6f,
                                            .shader = "wood"});
    const auto brick = add_material(
        bundle, {.name = "brick", .base_color = {0.5f, 0.17f, 0.1f}, .shader = "brick"});
    const auto marble = add_material(
        bundle, {.name = "marble",
                 .base_color = {0.85f, 0.83f, 0.8f},
                 .roughness = 0.5f,
                 .specular = 1,
                 .shader = "marble",
                 .shader_parameters = {{"color", {0.1f, 0.13f, 0.12f}}, {"vein", vec3(0.45f)}}});
    const auto carved = add_material(
        bundle,
        {.name = "walnut",
         .base_color = {0.36f, 0.2f, 0.1f},
         .shader = "wood",
         .shader_parameters = {
             {"color", {0.1f, 0.045f, 0.02f}}, {"ring", vec3(0.012f)}, {"bump", vec3(0.0006f)}}});
    const auto stone = add_material(bundle, {.name = "white marble",
                                             .base_color = {0.88f, 0.87f, 0.85f},
                                             .roughness = 0.5f,
                                             .specular = 1,
                                             .shader = "marble",
                                             .shader_parameters = {{"vein", vec3(0.09f)}}});
    const auto plaster = add_material(bundle, {.name = "plaster", .base_color = vec3(0.75f)});
    const auto glow =
        add_material(bundle, {.name = "lamp", .base_color = vec3(0), .emission = {15, 13.5f, 11}});

    const auto place = [&](const char* name, const Mesh& mesh, std::vector<std::uint32_t> materials,
                           const vec3& at) {
        mat4 world_from_object(1);
        world_from_object[3] = vec4(at, 1);
        add_instance(bundle, name, add_object(bundle, name, mesh, std::move(materials)),
                     world_from_object);
    };
    place("floor", floor(), {marble}, vec3(0));
    place("walls", walls(), {brick, plaster}, vec3(0));
    place("table", table(), {wood}, {1.6f, 0.68f, 1.2f});
    place("ball", ball(0.14f), {stone}, {1.25f, 0.866f, 1.25f});
    place("vase", vase(), {carved}, {1.95f, 0.726f, 1.15f});
    place("lamp", lamp(), {glow}, {1.6f, size.y - 0.01f, 1.5f});
    bundle.scene.cameras.push_back(
        {.name = "visitor", .eye = {1.5f, 1.35f, 3.35f}, .at = {1.6f, 0.82f, 0.9f}, .fov_y = 42});
    return bundle;
}

}  // namespace tessera
