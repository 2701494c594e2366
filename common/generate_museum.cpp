// A hall in which mirroring triangles fly about, each on its own way: motion that no hierarchy can
// follow, after the scene of that name in the BART suite (Lext, Assarsson and Moeller, "A Benchmark
// for Animated Ray Tracing", 2001). Two lamps; as many triangles fly as are asked for.

#include "common/animate.h"
#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/motion_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr vec3 hall{14, 6, 10};
constexpr vec3 middle{7, 2.5f, 5};
constexpr double period = 8;  // seconds

/// Slots: 0 floor, 1 walls, 2 ceiling.
Mesh shell() {
    MeshBuilder out;
    const vec3 a(0), b = hall;
    out.slot(0).quad({a.x, 0, b.z}, {b.x, 0, b.z}, {b.x, 0, a.z}, {a.x, 0, a.z});
    out.slot(2).quad({a.x, b.y, a.z}, {b.x, b.y, a.z}, {b.x, b.y, b.z}, {a.x, b.y, b.z});
    out.slot(1).quad({a.x, 0, a.z}, {b.x, 0, a.z}, {b.x, b.y, a.z}, {a.x, b.y, a.z});
    out.quad({b.x, 0, b.z}, {a.x, 0, b.z}, {a.x, b.y, b.z}, {b.x, b.y, b.z});
    out.quad({a.x, 0, b.z}, {a.x, 0, a.z}, {a.x, b.y, a.z}, {a.x, b.y, b.z});
    out.quad({b.x, 0, a.z}, {b.x, 0, b.z}, {b.x, b.y, b.z}, {b.x, b.y, a.z});
    return out.take();
}

/// Columns along the walls and a round pedestal. Slots: 0 stone, 1 dark stone.
Mesh stonework() {
    MeshBuilder out;
    const vec2 column[] = {{0.42f, 0},    {0.42f, 0.2f}, {0.42f, 0.2f}, {0.3f, 0.3f},
                           {0.26f, 5.5f}, {0.36f, 5.7f}, {0.44f, 5.8f}, {0.44f, 6}};
    for (int i = 0; i < 5; ++i)
        for (const float z : {0.8f, hall.z - 0.8f})
            out.slot(0).lathe({1.6f + 2.7f * float(i), 0, z}, column, 40);
    const vec2 pedestal[] = {{1.5f, 0},    {1.5f, 0.15f}, {1.5f, 0.15f}, {1.25f, 0.2f},
                             {1.2f, 0.5f}, {1.3f, 0.55f}, {1.3f, 0.6f},  {0, 0.6f}};
    out.slot(1).lathe({middle.x, 0, middle.z}, pedestal, 64);
    return out.take();
}

/// Seen from below.
Mesh panel() {
    MeshBuilder out;
    out.quad({-1.2f, 0, -0.5f}, {1.2f, 0, -0.5f}, {1.2f, 0, 0.5f}, {-1.2f, 0, 0.5f});
    return out.take();
}

/// A direction, the same chance for all.
vec3 random_direction(std::uint32_t index) {
    const float z = random_between(index, -1, 1), phi = random_between(index + 1, 0, 2 * pi);
    const float r = std::sqrt(1 - z * z);
    return {r * std::cos(phi), z, r * std::sin(phi)};
}

/// Each triangle circles around its own place in its own plane, its corners not quite alike: as two
/// morph targets, of which one counts as the cosine of the time and the other as the sine.
SoftMesh flight(std::uint32_t count) {
    SoftMesh mesh;
    mesh.targets.resize(2);
    const float size = std::min(0.8f, 6 / std::sqrt(float(count)));
    for (std::uint32_t i = 0; i < count; ++i) {
        const std::uint32_t seed = 64 * i;
        const vec3 centre = random_between(seed, 0.5f, 1.4f) * random_direction(seed + 1);
        const Frame plane(random_direction(seed + 3));
        const float phase = random_between(seed + 5, 0, 2 * pi);
        for (std::uint32_t corner = 0; corner < 3; ++corner) {
            const std::uint32_t own = seed + 8 + 8 * corner;
            mesh.rest.positions.push_back(centre + size * random_direction(own));
            const float radius = 0.7f + size * random_between(own + 2, -0.5f, 0.5f);
            const float begin = phase + size * random_between(own + 3, -0.5f, 0.5f);
            const float c = std::cos(begin), s = std::sin(begin);
            mesh.targets[0].positions.push_back(radius * (c * plane.s + s * plane.t));
            mesh.targets[1].positions.push_back(radius * (c * plane.t - s * plane.s));
        }
    }
    return mesh;
}

void add_flight(SceneBundle& bundle, std::uint32_t count) {
    Motion& motion = bundle.motion;
    motion.soft_meshes.push_back(flight(count));
    Mesh mesh;
    mesh.positions = motion.soft_meshes[0].rest.positions;
    for (std::uint32_t i = 0; i < count; ++i)
        mesh.triangles.push_back(uvec3(3 * i, 3 * i + 1, 3 * i + 2));
    const auto mirror = add_material(
        bundle,
        {.name = "mirror", .base_color = {0.92f, 0.9f, 0.85f}, .metallic = 1, .roughness = 0});
    const auto object = add_object(bundle, "flight", mesh, {mirror});
    mat4 world_from_flight(1);
    world_from_flight[3] = vec4(middle, 1);
    add_instance(bundle, "flight", object, world_from_flight);
    const Beat beat{.period = period, .times = 1, .keys = 96};
    const std::uint32_t node = add_node(
        motion, {.weights = {},
                 .weights_track = add_weights(motion, beat, [](float part) {
                     return std::vector<float>{std::cos(2 * pi * part), std::sin(2 * pi * part)};
                 })});
    motion.objects.push_back({.object = "flight", .mesh = 0, .node = node});
    const SceneBundle first = bundle_at(bundle, 0);
    bundle.scene = first.scene;
    bundle.blobs = first.blobs;
}

}  // namespace

SceneBundle generate_museum(std::uint32_t triangles) {
    SceneBundle bundle;
    const auto paint = [&](const char* name, const vec3& colour) {
        return add_material(bundle, {.name = name, .base_color = colour});
    };
    const auto floor = add_material(
        bundle,
        {.name = "floor", .base_color = {0.3f, 0.22f, 0.16f}, .roughness = 0.3f, .specular = 1});
    const auto wall = paint("wall", {0.6f, 0.2f, 0.16f}), white = paint("plaster", vec3(0.8f)),
               stone = paint("stone", {0.75f, 0.71f, 0.63f}), dark = paint("slate", vec3(0.2f));
    const auto glow =
        add_material(bundle, {.name = "lamp", .base_color = vec3(0), .emission = {22, 20, 16}});
    add_instance(bundle, "hall", add_object(bundle, "hall", shell(), {floor, wall, white}));
    add_instance(bundle, "stonework", add_object(bundle, "stonework", stonework(), {stone, dark}));
    const auto lamp = add_object(bundle, "lamp", panel(), {glow});
    for (const float x : {3.5f, 10.5f}) {
        mat4 world_from_lamp(1);
        world_from_lamp[3] = vec4(x, hall.y - 0.02f, hall.z / 2, 1);
        add_instance(bundle, x < 7 ? "left lamp" : "right lamp", lamp, world_from_lamp);
    }
    add_flight(bundle, triangles);
    bundle.scene.cameras.push_back(
        {.name = "entrance", .eye = {13.2f, 2.2f, 8.6f}, .at = {6.6f, 2.2f, 4.6f}, .fov_y = 55});
    return bundle;
}

}  // namespace tessera
