// The Cornell box as measured at Cornell University (Program of Computer Graphics),
// in metres, with the RGB reflectances and emitter radiance that renderers commonly use. The lamp
// hangs 0.1 mm below the ceiling, as in the data set.

#include <span>

#include "common/generators.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

/// Corners in order, counter-clockwise from the front.
using Quad = std::array<vec3, 4>;

constexpr float height = 0.5488f;
constexpr float depth = 0.5592f;

/// The left wall leans: it meets the floor at 0.5528 (front) and 0.5496 (back), the ceiling at
/// 0.556.
const Quad floor_and_walls[] = {
    {{{0.5528f, 0, 0}, {0, 0, 0}, {0, 0, depth}, {0.5496f, 0, depth}}},
    {{{0.556f, height, 0}, {0.556f, height, depth}, {0, height, depth}, {0, height, 0}}},
    {{{0.5496f, 0, depth}, {0, 0, depth}, {0, height, depth}, {0.556f, height, depth}}},
    {{{0, 0, depth}, {0, 0, 0}, {0, height, 0}, {0, height, depth}}},
    {{{0.5528f, 0, 0}, {0.5496f, 0, depth}, {0.556f, height, depth}, {0.556f, height, 0}}},
};
const std::uint16_t wall_slots[] = {0, 0, 0, 1, 2};  // white, green, red

const Quad lamp[] = {{{{0.343f, 0.5487f, 0.227f},
                       {0.343f, 0.5487f, 0.332f},
                       {0.213f, 0.5487f, 0.332f},
                       {0.213f, 0.5487f, 0.227f}}}};

/// Four corners of a block's top, counter-clockwise from above.
const Quad short_block_top{{{0.13f, 0.165f, 0.065f},
                            {0.082f, 0.165f, 0.225f},
                            {0.24f, 0.165f, 0.272f},
                            {0.29f, 0.165f, 0.114f}}};
const Quad tall_block_top{{{0.423f, 0.33f, 0.247f},
                           {0.265f, 0.33f, 0.296f},
                           {0.314f, 0.33f, 0.456f},
                           {0.472f, 0.33f, 0.406f}}};

Mesh mesh_of(std::span<const Quad> quads, std::span<const std::uint16_t> slots = {}) {
    Mesh mesh;
    for (std::size_t i = 0; i < quads.size(); ++i) {
        const auto first = std::uint32_t(mesh.positions.size());
        mesh.positions.insert(mesh.positions.end(), quads[i].begin(), quads[i].end());
        mesh.triangles.push_back({first, first + 1, first + 2});
        mesh.triangles.push_back({first, first + 2, first + 3});
        if (!slots.empty()) mesh.slots.insert(mesh.slots.end(), 2, slots[i]);
    }
    return mesh;
}

/// A block that stands on the floor; it has no bottom.
Mesh block(const Quad& top) {
    std::vector<Quad> quads{top};
    const auto on_floor = [](const vec3& p) { return vec3(p.x, 0, p.z); };
    for (int i = 0; i < 4; ++i) {
        const vec3& a = top[(i + 1) % 4];
        const vec3& b = top[i];
        quads.push_back({{on_floor(a), a, b, on_floor(b)}});
    }
    return mesh_of(quads);
}

}  // namespace

SceneBundle generate_cornell() {
    SceneBundle bundle;
    const auto white =
        add_material(bundle, {.name = "white", .base_color = {0.725f, 0.71f, 0.68f}});
    const auto red = add_material(bundle, {.name = "red", .base_color = {0.63f, 0.065f, 0.05f}});
    const auto green =
        add_material(bundle, {.name = "green", .base_color = {0.14f, 0.45f, 0.091f}});
    const auto light = add_material(bundle, {.name = "light",
                                             .base_color = vec3(0),
                                             .emission = {17, 12, 4},
                                             .two_sided_emission = true});
    const auto add = [&](const char* name, const Mesh& mesh, std::vector<std::uint32_t> materials) {
        add_instance(bundle, name, add_object(bundle, name, mesh, std::move(materials)));
    };
    add("room", mesh_of(floor_and_walls, wall_slots), {white, green, red});
    add("lamp", mesh_of(lamp), {light});
    add("short block", block(short_block_top), {white});
    add("tall block", block(tall_block_top), {white});
    bundle.scene.cameras.push_back({.name = "front",
                                    .eye = {0.278f, 0.273f, -0.8f},
                                    .at = {0.278f, 0.273f, 0},
                                    .fov_y = 39.3077f});
    return bundle;
}

}  // namespace tessera
