// Ten rooms in two rows, each open to its neighbours by a door, with ten lamps each: a hundred
// lamps of which a view sees few, the case for choosing lights by place. About 80,000 triangles.
//
// And storeys of such rooms along corridors, with many small lamps each: seven are 2.5 million
// triangles and over 20,000 lights, of which a view from inside sees less than a hundredth. They
// stand in for the soda hall of Wald's thesis (2004), whose file is not public.

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

/// Tables, vases and balls of one room; slots are paints.
Mesh furniture(const vec3& corner, std::uint32_t seed) {
    MeshBuilder out;
    std::uint32_t number = 64 * seed;
    const auto chance = [&](float lo, float hi) { return random_between(number++, lo, hi); };
    const auto paint = [&] { out.slot(std::uint16_t(int(chance(0, paints)) % paints)); };
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

/// A square panel that faces down.
void add_panel(MeshBuilder& out, const vec3& centre, float half) {
    const vec3 x(half, 0, 0), z(0, 0, half);
    out.quad(centre - x - z, centre + x - z, centre + x + z, centre - x + z);
}

/// One lamp's panel under the ceiling.
Mesh panel() {
    MeshBuilder out;
    add_panel(out, vec3(0), 0.15f);
    return out.take();
}

/// Of strength and tint by chance.
vec3 lamp_radiance(std::uint32_t seed, float least, float most) {
    const float warmth = random_unit(1000 + seed);
    return random_between(2000 + seed, least, most) *
           glm::mix(vec3(1, 0.8f, 0.55f), vec3(0.75f, 0.85f, 1), warmth);
}

/// Floor, walls, ceiling and the paints of furniture: materials of every such scene, in this order.
std::vector<std::uint32_t> add_paints(SceneBundle& bundle) {
    std::vector<std::uint32_t> materials;
    const auto add = [&](const char* name, const vec3& colour) {
        materials.push_back(add_material(bundle, {.name = name, .base_color = colour}));
    };
    add("floor", {0.45f, 0.35f, 0.25f});
    add("wall", {0.75f, 0.74f, 0.7f});
    add("ceiling", vec3(0.8f));
    add("red", {0.6f, 0.15f, 0.1f});
    add("blue", {0.15f, 0.25f, 0.55f});
    add("green", {0.2f, 0.45f, 0.2f});
    add("white", vec3(0.8f));
    return materials;
}

// ---- Storeys ------------------------------------------------------------------------------------

constexpr int rooms_in_a_row = 16;
constexpr float corridor_width = 2.4f;
constexpr float storey_pitch = room.y + 0.35f;
constexpr float storey_length = float(rooms_in_a_row) * (room.x + wall);
/// Where the second row of rooms begins, beyond the corridor.
constexpr float second_row = room.z + 2 * wall + corridor_width;

/// Rooms in two rows with doors to the corridor between them.
Mesh storey_shell() {
    MeshBuilder out;
    const float depth = second_row + room.z + wall;
    out.slot(floor_slot).box({-wall, -wall, -wall}, {storey_length, 0, depth});
    out.slot(ceiling_slot).box({-wall, room.y, -wall}, {storey_length, room.y + 0.1f, depth});
    out.slot(wall_slot);
    for (const float z : {0.0f, second_row})
        for (int column = 0; column <= rooms_in_a_row; ++column)
            add_wall(out, {float(column) * (room.x + wall) - wall, 0, z}, 0, false);
    for (int column = 0; column < rooms_in_a_row; ++column) {
        const float x = float(column) * (room.x + wall);
        for (const float z : {-wall, room.z, second_row - wall, second_row + room.z})
            add_wall(out, {x, 0, z}, 2, z == room.z || z == second_row - wall);
    }
    for (const float x : {-wall, storey_length - wall})
        out.box({x, 0, room.z + wall}, {x + wall, room.y, second_row - wall});
    return out.take();
}

/// Forty-five small panels.
void add_room_lamps(MeshBuilder& out, const vec3& corner) {
    for (int i = 0; i < 9; ++i)
        for (int k = 0; k < 5; ++k)
            add_panel(out, corner + vec3(0.5f + 0.5f * float(i), room.y - 0.02f, 0.5f + float(k)),
                      0.06f);
}

Mesh corridor_lamps() {
    MeshBuilder out;
    for (int i = 0; i < 2 * rooms_in_a_row; ++i)
        add_panel(out,
                  {0.5f * (float(i) + 0.5f) * (room.x + wall), room.y - 0.02f,
                   room.z + wall + 0.5f * corridor_width},
                  0.08f);
    return out.take();
}

void add_storey(SceneBundle& bundle, int storey, const std::vector<std::uint32_t>& paints_used,
                std::uint32_t shell) {
    mat4 world_from_storey(1);
    world_from_storey[3].y = storey_pitch * float(storey);
    add_instance(bundle, "storey", shell, world_from_storey);
    const auto glow = [&](std::uint32_t seed, float least, float most) {
        return add_material(
            bundle,
            {.name = "lamp", .base_color = vec3(0), .emission = lamp_radiance(seed, least, most)});
    };
    for (int i = 0; i < 2 * rooms_in_a_row; ++i) {
        const auto seed = std::uint32_t(2 * rooms_in_a_row * storey + i);
        const vec3 corner(float(i / 2) * (room.x + wall), 0, i % 2 ? second_row : 0);
        add_instance(bundle, "furniture",
                     add_object(bundle, "furniture", furniture(corner, seed), paints_used),
                     world_from_storey);
        MeshBuilder lamps;
        add_room_lamps(lamps, corner);
        add_instance(bundle, "lamps",
                     add_object(bundle, "lamps", lamps.take(), {glow(seed, 6, 20)}),
                     world_from_storey);
    }
    add_instance(bundle, "corridor lamps",
                 add_object(bundle, "corridor lamps", corridor_lamps(),
                            {glow(std::uint32_t(5000 + storey), 6, 20)}),
                 world_from_storey);
}

}  // namespace

SceneBundle generate_rooms() {
    SceneBundle bundle;
    const std::vector<std::uint32_t> materials = add_paints(bundle);
    add_instance(
        bundle, "rooms",
        add_object(bundle, "rooms", shell(), {materials.begin(), materials.begin() + first_paint}));
    const std::vector<std::uint32_t> of_furniture(materials.begin() + first_paint, materials.end());
    for (int i = 0; i < columns * rows; ++i) {
        const vec3 corner = corner_of(i % columns, i / columns);
        const auto seed = std::uint32_t(i);
        add_instance(bundle, "furniture",
                     add_object(bundle, "furniture", furniture(corner, seed), of_furniture));
        // Each room has light of its own.
        const std::uint32_t glow = add_material(
            bundle,
            {.name = "lamp", .base_color = vec3(0), .emission = lamp_radiance(seed, 4, 14)});
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

SceneBundle generate_storeys(int storeys) {
    SceneBundle bundle;
    const std::vector<std::uint32_t> materials = add_paints(bundle);
    const std::vector<std::uint32_t> of_furniture(materials.begin() + first_paint, materials.end());
    const auto shell = add_object(bundle, "storey", storey_shell(),
                                  {materials.begin(), materials.begin() + first_paint});
    for (int storey = 0; storey < storeys; ++storey)
        add_storey(bundle, storey, of_furniture, shell);
    const float x = 7 * (room.x + wall), y = storey_pitch * float(storeys / 2);
    bundle.scene.cameras.push_back({.name = "from a room",
                                    .eye = {x + 0.6f, y + 1.6f, 0.6f},
                                    .at = {x + 2.6f, y + 1.1f, room.z - 0.5f},
                                    .fov_y = 60});
    return bundle;
}

}  // namespace tessera
