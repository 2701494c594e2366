// Ten rooms in two rows, each open to its neighbours by a door, with ten lamps each: a hundred
// lamps of which a view sees few, the case for choosing lights by place. About 80,000 triangles.

#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr int columns = 5;
constexpr int rows = 2;
constexpr vec3 room{5, 2.8f, 5};
constexpr float wall = 0.2f;
constexpr float door_width = 1;
constexpr float door_height = 2.1f;
constexpr int lamps_per_room = 10;

enum Slot : std::uint16_t { floor_slot, wall_slot, ceiling_slot, first_paint };
constexpr int paints = 4;

vec3 corner_of(int column, int row) {
    return {float(column) * (room.x + wall), 0, float(row) * (room.z + wall)};
}

/// A wall across `axis` (0: x, 2: z) from `lo`, as long as a room, with a door in its middle if
/// wanted.
void add_wall(MeshBuilder& out, const vec3& lo, int axis, bool with_door) {
    const int along = 2 - axis;
    const auto block = [&](float from, float to, float bottom) {
        vec3 a = lo, b = lo;
        a[along] += from;
        b[along] += to;
        a.y = bottom;
        b.y = room.y;
        b[axis] += wall;
        out.box(a, b);
    };
    const float length = room[along];
    if (!with_door) return block(-wall, length + wall, 0);
    const float first = 0.5f * (length - door_width);
    block(-wall, first, 0);
    block(first + door_width, length + wall, 0);
    block(first, first + door_width, door_height);
}

Mesh shell() {
    MeshBuilder out;
    const vec3 size(float(columns) * (room.x + wall), room.y, float(rows) * (room.z + wall));
    out.slot(floor_slot).box({-wall, -wall, -wall}, {size.x, 0, size.z});
    out.slot(ceiling_slot).box({-wall, room.y, -wall}, {size.x, room.y + wall, size.z});
    out.slot(wall_slot);
    for (int row = 0; row < rows; ++row)
        for (int column = 0; column <= columns; ++column)
            add_wall(out, corner_of(column, row) - vec3(wall, 0, 0), 0,
                     column > 0 && column < columns);
    for (int column = 0; column < columns; ++column)
        for (int row = 0; row <= rows; ++row)
            add_wall(out, corner_of(column, row) - vec3(0, 0, wall), 2, row > 0 && row < rows);
    return out.take();
}

/// Tables, vases and balls of one room.
Mesh furniture(const vec3& corner, std::uint32_t seed) {
    MeshBuilder out;
    std::uint32_t number = 64 * seed;
    const auto chance = [&](float lo, float hi) { return random_between(number++, lo, hi); };
    const auto paint = [&] {
        out.slot(std::uint16_t(first_paint + int(chance(0, paints)) % paints));
    };
    // Away from the doors, which are in the middle of each wall.
    for (int i = 0; i < 4; ++i) {
        const vec3 place = corner + vec3(i % 2 ? 3.6f : 0.6f, 0, i / 2 ? 3.6f : 0.6f) +
                           vec3(chance(0, 0.3f), 0, chance(0, 0.3f));
        paint();
        out.rounded_box(place + vec3(0, 0.68f, 0), place + vec3(0.9f, 0.74f, 0.7f), 0.02f, 4);
        for (int leg = 0; leg < 4; ++leg)
            out.cylinder(place + vec3(leg % 2 ? 0.8f : 0.1f, 0, leg / 2 ? 0.6f : 0.1f), 0.03f,
                         0.68f, 24);
        paint();
        const vec2 profile[] = {{0.06f, 0},     {0.12f, 0.06f}, {0.14f, 0.14f},
                                {0.09f, 0.24f}, {0.05f, 0.3f},  {0.07f, 0.36f}};
        out.lathe(place + vec3(0.3f, 0.74f, 0.35f), profile, 48);
        paint();
        out.ball(place + vec3(0.65f, 0.84f, chance(0.2f, 0.5f)), 0.1f, 32);
    }
    return out.take();
}

/// One lamp's panel under the ceiling.
Mesh panel() {
    MeshBuilder out;
    out.quad({-0.15f, 0, -0.15f}, {0.15f, 0, -0.15f}, {0.15f, 0, 0.15f}, {-0.15f, 0, 0.15f});
    return out.take();
}

}  // namespace

SceneBundle generate_rooms() {
    SceneBundle bundle;
    std::vector<std::uint32_t> materials;
    const auto add_paint = [&](const char* name, const vec3& colour) {
        materials.push_back(add_material(bundle, {.name = name, .base_color = colour}));
    };
    add_paint("floor", {0.45f, 0.35f, 0.25f});
    add_paint("wall", {0.75f, 0.74f, 0.7f});
    add_paint("ceiling", vec3(0.8f));
    add_paint("red", {0.6f, 0.15f, 0.1f});
    add_paint("blue", {0.15f, 0.25f, 0.55f});
    add_paint("green", {0.2f, 0.45f, 0.2f});
    add_paint("white", vec3(0.8f));
    add_instance(
        bundle, "rooms",
        add_object(bundle, "rooms", shell(), {materials.begin(), materials.begin() + first_paint}));
    const std::vector<std::uint32_t> of_furniture(materials.begin() + first_paint, materials.end());
    for (int i = 0; i < columns * rows; ++i) {
        const vec3 corner = corner_of(i % columns, i / columns);
        const auto seed = std::uint32_t(i);
        Mesh mesh = furniture(corner, seed);
        for (std::uint16_t& slot : mesh.slots) slot = std::uint16_t(slot - first_paint);
        add_instance(bundle, "furniture", add_object(bundle, "furniture", mesh, of_furniture));
        // Each room has light of its own strength and tint.
        const float warmth = random_unit(1000 + seed);
        const vec3 radiance = random_between(2000 + seed, 4, 14) *
                              glm::mix(vec3(1, 0.8f, 0.55f), vec3(0.75f, 0.85f, 1), warmth);
        const std::uint32_t glow =
            add_material(bundle, {.name = "lamp", .base_color = vec3(0), .emission = radiance});
        const std::uint32_t lamp = add_object(bundle, "lamp", panel(), {glow});
        for (int k = 0; k < lamps_per_room; ++k) {
            const vec3 place = corner + vec3(0.7f + 0.9f * float(k % 5), room.y - 0.02f,
                                             k < lamps_per_room / 2 ? 1.5f : 3.5f);
            mat4 world_from_lamp(1);
            world_from_lamp[3] = vec4(place, 1);
            add_instance(bundle, "lamp", lamp, world_from_lamp);
        }
    }
    bundle.scene.cameras.push_back({.name = "through doors",
                                    .eye = {5.8f, 1.6f, 0.8f},
                                    .at = {8.4f, 1.1f, 3.6f},
                                    .fov_y = 60});
    return bundle;
}

}  // namespace tessera
