// A building of thirty furnished rooms on five storeys around an atrium, about a million triangles.
// It stands in for the soda hall of Wald's thesis (2004), whose file is not public: large,
// architectural, lit by many lights of which a view sees a few. Each room is the office's, with its
// furniture shifted, turned and left out by chance, and is one mesh: nothing repeats, so that
// memory and building are those of a million triangles.

#include <array>
#include <glm/gtc/matrix_transform.hpp>
#include <optional>

#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr vec3 room{6, 2.8f, 5};
constexpr int columns = 3;
constexpr int storeys = 5;
constexpr float column_pitch = room.x + 0.5f;
constexpr float storey_pitch = room.y + 0.35f;
constexpr float atrium = 9;  // metres between the two wings
constexpr float length_x = columns * column_pitch;
constexpr float height = storeys * storey_pitch;

mat4 turned(float radians) { return glm::rotate(mat4(1), radians, vec3(0, 1, 0)); }

/// What chance does to a piece of furniture, in its own space; nothing where it is left out.
std::optional<mat4> disturbed(const std::string& name, std::uint32_t seed) {
    const auto chance = [&](std::uint32_t i) { return random_between(seed * 8 + i, 0, 1); };
    const auto shifted = [&](float reach) {
        return glm::translate(mat4(1), reach * vec3(chance(1) - 0.5f, 0, chance(2) - 0.5f));
    };
    if (name == "book" && chance(0) < 0.15f) return std::nullopt;
    if (name == "cup" && chance(0) < 0.3f) return std::nullopt;
    if (name == "chair") return shifted(0.15f) * turned(2 * pi * chance(3));
    if (name == "cup") return shifted(0.12f) * turned(2 * pi * chance(3));
    if (name == "mouse" || name == "keyboard") return shifted(0.04f) * turned(0.3f * chance(3));
    if (name == "waste basket" || name == "mirror ball") return shifted(0.2f);
    if (name == "leaf") return glm::scale(mat4(1), vec3(0.7f + 0.5f * chance(3)));
    return mat4(1);
}

/// Appends `mesh` where `world_from_object` places it. The slots of `out` are the scene's
/// materials, until number_slots().
void append(Mesh& out, const Mesh& mesh, const mat4& world_from_object,
            const std::vector<std::uint32_t>& materials) {
    const auto first = std::uint32_t(out.positions.size());
    const mat3 normal_matrix = glm::transpose(glm::inverse(mat3(world_from_object)));
    for (const vec3& p : mesh.positions)
        out.positions.push_back(vec3(world_from_object * vec4(p, 1)));
    for (const vec3& n : mesh.normals) out.normals.push_back(normalize(normal_matrix * n));
    for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
        out.triangles.push_back(first + mesh.triangles[i]);
        out.slots.push_back(std::uint16_t(materials[mesh.slots.empty() ? 0 : mesh.slots[i]]));
    }
}

/// Renames the slots of `mesh` from materials to 0, 1...; returns the material of each.
std::vector<std::uint32_t> number_slots(Mesh& mesh) {
    std::vector<std::uint32_t> materials(mesh.slots.begin(), mesh.slots.end());
    std::ranges::sort(materials);
    materials.erase(std::unique(materials.begin(), materials.end()), materials.end());
    for (std::uint16_t& slot : mesh.slots)
        slot = std::uint16_t(std::ranges::lower_bound(materials, std::uint32_t(slot)) -
                             materials.begin());
    return materials;
}

/// The walls of the office without the one at z = room.z: the room opens to the atrium.
Mesh opened(const Mesh& walls) {
    Mesh out = walls;
    out.triangles.clear();
    out.slots.clear();
    for (std::size_t i = 0; i < walls.triangles.size(); ++i) {
        const uvec3& t = walls.triangles[i];
        const auto at_front = [&](std::uint32_t v) {
            return walls.positions[v].z > room.z - 0.02f;
        };
        if (at_front(t.x) && at_front(t.y) && at_front(t.z)) continue;
        out.triangles.push_back(t);
        out.slots.push_back(walls.slots[i]);
    }
    return out;
}

/// Posts and rails along x from 0 to `width`.
void balustrade(MeshBuilder& b, float width) {
    constexpr float rail_height = 1.05f;
    const auto bar = [&](const vec3& from, const vec3& to, float radius) {
        const std::array<vec3, 2> path{from, to};
        b.tube(path, radius, 8);
    };
    const int posts = int(width / 0.125f);
    for (int i = 0; i <= posts; ++i) {
        const float x = width * float(i) / float(posts);
        bar({x, 0, 0}, {x, rail_height, 0}, i % 8 == 0 ? 0.02f : 0.007f);
    }
    bar({0, rail_height, 0}, {width, rail_height, 0}, 0.025f);
    bar({0, 0.08f, 0}, {width, 0.08f, 0}, 0.012f);
}

class Building {
public:
    SceneBundle make() {
        read_office();
        for (int storey = 0; storey < storeys; ++storey)
            for (int column = 0; column < columns; ++column)
                for (const bool opposite : {false, true}) add_room(column, storey, opposite);
        add_atrium();
        bundle_.scene.cameras.push_back({.name = "atrium",
                                         .eye = {0.6f, 1.35f * storey_pitch, room.z + 6.9f},
                                         .at = {12.5f, 1.9f * storey_pitch, room.z - 1.0f},
                                         .fov_y = 66});
        drop_unused_materials(bundle_.scene);
        bundle_.blobs.keep_only(blobs_of(bundle_.scene));
        return std::move(bundle_);
    }

private:
    /// Takes the office's materials and textures over, and its meshes to copy from.
    void read_office() {
        const SceneBundle office = generate_office();
        office_ = office.scene;
        for (const Object& object : office_.objects)
            meshes_.push_back(decode_mesh(*office.blobs.find(office_.meshes[object.mesh])));
        bundle_ = office;
        Scene& scene = bundle_.scene;
        scene.meshes.clear();
        scene.objects.clear();
        scene.instances.clear();
        scene.cameras.clear();
        for (const vec3& colour :
             {vec3(0.20f, 0.40f, 0.42f), vec3(0.55f, 0.30f, 0.18f), vec3(0.30f, 0.38f, 0.20f),
              vec3(0.45f, 0.20f, 0.25f), vec3(0.60f, 0.50f, 0.25f), vec3(0.25f, 0.30f, 0.45f)}) {
            wall_paints_.push_back(paint("wall", colour));
        }
    }

    std::uint32_t paint(const char* name, const vec3& colour) {
        return add_material(bundle_, {.name = name, .base_color = colour});
    }

    void add_room(int column, int storey, bool opposite);
    void add_atrium();

    SceneBundle bundle_;
    Scene office_;
    std::vector<Mesh> meshes_;  ///< of each of the office's objects
    std::vector<std::uint32_t> wall_paints_;
};

void Building::add_room(int column, int storey, bool opposite) {
    mat4 world_from_room = glm::translate(
        mat4(1), vec3(column_pitch * float(column) + 0.3f, storey_pitch * float(storey), 0));
    if (opposite)
        world_from_room = glm::translate(mat4(1), vec3(length_x, 0, 2 * room.z + atrium)) *
                          turned(pi) * world_from_room;
    const std::uint32_t seed =
        1000 * std::uint32_t((storey * columns + column) * 2 + int(opposite) + 1);
    Mesh furnished;
    for (std::uint32_t i = 0; i < office_.instances.size(); ++i) {
        const Instance& instance = office_.instances[i];
        const Object& object = office_.objects[instance.object];
        const Mesh& mesh = meshes_[instance.object];
        if (instance.name == "door") continue;
        if (!mesh.texcoords.empty()) {
            // Few triangles, and a mesh has texture coordinates everywhere or nowhere.
            const auto copy = add_object(bundle_, object.name, mesh, object.materials);
            add_instance(bundle_, instance.name, copy,
                         world_from_room * instance.world_from_object);
            continue;
        }
        if (instance.name == "walls") {
            std::vector<std::uint32_t> materials = object.materials;
            materials[1] = wall_paints_[std::size_t(random_between(seed, 0, 6))];
            append(furnished, opened(mesh), instance.world_from_object, materials);
            continue;
        }
        if (const auto change = disturbed(instance.name, seed + i))
            append(furnished, mesh, instance.world_from_object * *change, object.materials);
    }
    const std::vector<std::uint32_t> materials = number_slots(furnished);
    add_instance(bundle_, "room", add_object(bundle_, "room", furnished, materials),
                 world_from_room);
}

void Building::add_atrium() {
    const auto concrete = paint("concrete", {0.62f, 0.61f, 0.58f});
    const auto steel = add_material(
        bundle_, {.name = "rail", .base_color = vec3(0.55f), .metallic = 1, .roughness = 0.4f});
    const auto stone = paint("stone floor", {0.45f, 0.42f, 0.38f});
    const auto sky = add_material(
        bundle_, {.name = "skylight", .base_color = vec3(0), .emission = {2.0f, 2.2f, 2.5f}});
    constexpr float z0 = room.z, z1 = room.z + atrium;
    MeshBuilder b;
    // Slabs, and piers that close the gaps between rooms, on both sides of the atrium.
    for (const float z : {z0 - 0.05f, z1 - 0.15f}) {
        for (int storey = 0; storey <= storeys; ++storey) {
            const float y = storey_pitch * float(storey);
            b.box({0, y - 0.349f, z}, {length_x, y - 0.001f, z + 0.2f});
        }
        for (int column = 0; column <= columns; ++column) {
            const float x = std::clamp(column_pitch * float(column) + 0.05f, 0.0f, length_x - 0.3f);
            b.box({x - (column > 0 ? 0.25f : 0), 0, z + 0.01f}, {x + 0.3f, height, z + 0.19f});
        }
    }
    for (int column = 0; column < 2; ++column)
        for (const float z : {z0 + 2.2f, z1 - 2.2f})
            b.cylinder({column_pitch * float(column + 1), 0, z}, 0.3f, height, 48);
    // The ends.
    b.quad({0, 0, z1}, {0, 0, z0}, {0, height, z0}, {0, height, z1});
    b.quad({length_x, 0, z0}, {length_x, 0, z1}, {length_x, height, z1}, {length_x, height, z0});
    b.slot(1).quad({0, 0, z1}, {length_x, 0, z1}, {length_x, 0, z0}, {0, 0, z0});
    b.slot(2).quad({0, height, z0}, {length_x, height, z0}, {length_x, height, z1},
                   {0, height, z1});
    add_instance(bundle_, "atrium",
                 add_object(bundle_, "atrium", b.take(), {concrete, stone, sky}));
    MeshBuilder rail;
    balustrade(rail, length_x);
    const auto rail_object = add_object(bundle_, "balustrade", rail.take(), {steel});
    for (int storey = 1; storey < storeys; ++storey)
        for (const float z : {z0 + 0.1f, z1 - 0.1f})
            add_instance(bundle_, "balustrade", rail_object,
                         glm::translate(mat4(1), vec3(0, storey_pitch * float(storey), z)));
}

}  // namespace

SceneBundle generate_building() { return Building().make(); }

}  // namespace tessera
