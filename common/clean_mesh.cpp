#include "common/clean_mesh.h"

#include <fmt/format.h>

#include <algorithm>
#include <limits>

#include "common/check.h"

namespace tessera {
namespace {

constexpr std::uint32_t unused = std::numeric_limits<std::uint32_t>::max();

/// Twice the area as a vector, in double so that no small triangle's area underflows.
glm::dvec3 area_vector(const Mesh& mesh, const uvec3& t) {
    const glm::dvec3 a = mesh.positions[t.x];
    return cross(glm::dvec3(mesh.positions[t.y]) - a, glm::dvec3(mesh.positions[t.z]) - a);
}

bool is_finite(const Mesh& mesh, const uvec3& t) {
    return tessera::is_finite(mesh.positions[t.x]) && tessera::is_finite(mesh.positions[t.y]) &&
           tessera::is_finite(mesh.positions[t.z]);
}

void drop_bad_triangles(Mesh& mesh, MeshCleaning& cleaning) {
    std::size_t kept = 0;
    for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
        const uvec3 t = mesh.triangles[i];
        if (!is_finite(mesh, t)) {
            ++cleaning.not_finite;
        } else if (t.x == t.y || t.y == t.z || t.z == t.x ||
                   area_vector(mesh, t) == glm::dvec3(0)) {
            ++cleaning.degenerate;
        } else {
            mesh.triangles[kept] = t;
            if (!mesh.slots.empty()) mesh.slots[kept] = mesh.slots[i];
            ++kept;
        }
    }
    mesh.triangles.resize(kept);
    if (!mesh.slots.empty()) mesh.slots.resize(kept);
}

/// Moves the used entries to the front, in the order of `new_index`.
template <class T>
void compact(std::vector<T>& values, const std::vector<std::uint32_t>& new_index,
             std::uint32_t used) {
    if (values.empty()) return;
    for (std::size_t i = 0; i < values.size(); ++i)
        if (new_index[i] != unused) values[new_index[i]] = values[i];
    values.resize(used);
    values.shrink_to_fit();
}

void drop_unused_vertices(Mesh& mesh) {
    std::vector<std::uint32_t> new_index(mesh.positions.size(), unused);
    for (const uvec3& t : mesh.triangles)
        for (int k = 0; k < 3; ++k) new_index[t[k]] = 0;
    std::uint32_t used = 0;
    for (std::uint32_t& index : new_index)
        if (index != unused) index = used++;
    if (used == mesh.positions.size()) return;
    compact(mesh.positions, new_index, used);
    compact(mesh.normals, new_index, used);
    compact(mesh.texcoords, new_index, used);
    for (uvec3& t : mesh.triangles) t = {new_index[t.x], new_index[t.y], new_index[t.z]};
}

bool is_direction(const vec3& n) { return tessera::is_finite(n) && n != vec3(0); }

void repair_attributes(Mesh& mesh, MeshCleaning& cleaning) {
    if (!mesh.normals.empty())
        for (const uvec3& t : mesh.triangles)
            for (int k = 0; k < 3; ++k)
                if (!is_direction(mesh.normals[t[k]])) {
                    mesh.normals[t[k]] = vec3(normalize(area_vector(mesh, t)));
                    ++cleaning.bad_attributes;
                }
    for (vec2& uv : mesh.texcoords)
        if (!std::isfinite(uv.x) || !std::isfinite(uv.y)) {
            uv = vec2(0);
            ++cleaning.bad_attributes;
        }
}

template <class T>
std::vector<T> per_corner(const std::vector<T>& values, const std::vector<uvec3>& triangles) {
    std::vector<T> out;
    if (values.empty()) return out;
    out.reserve(3 * triangles.size());
    for (const uvec3& t : triangles)
        for (int k = 0; k < 3; ++k) out.push_back(values[t[k]]);
    return out;
}

/// Splits all vertices and gives each the normal of its triangle.
void add_flat_normals(Mesh& mesh) {
    mesh.positions = per_corner(mesh.positions, mesh.triangles);
    mesh.texcoords = per_corner(mesh.texcoords, mesh.triangles);
    for (std::uint32_t i = 0; i < mesh.triangles.size(); ++i) {
        mesh.triangles[i] = uvec3(3 * i, 3 * i + 1, 3 * i + 2);
        const vec3 normal(normalize(area_vector(mesh, mesh.triangles[i])));
        mesh.normals.insert(mesh.normals.end(), 3, normal);
    }
}

template <class T>
void append_values(std::vector<T>& to, const std::vector<T>& from) {
    to.insert(to.end(), from.begin(), from.end());
}

}  // namespace

MeshCleaning& MeshCleaning::operator+=(const MeshCleaning& other) {
    degenerate += other.degenerate;
    not_finite += other.not_finite;
    bad_attributes += other.bad_attributes;
    empty_meshes += other.empty_meshes;
    return *this;
}

MeshCleaning clean_mesh(Mesh& mesh) {
    MeshCleaning cleaning;
    drop_bad_triangles(mesh, cleaning);
    drop_unused_vertices(mesh);
    repair_attributes(mesh, cleaning);
    const auto is_zero = [](std::uint16_t slot) { return slot == 0; };
    if (std::all_of(mesh.slots.begin(), mesh.slots.end(), is_zero)) mesh.slots.clear();
    if (mesh.triangles.empty()) cleaning.empty_meshes = 1;
    return cleaning;
}

std::vector<std::string> describe(const MeshCleaning& cleaning) {
    std::vector<std::string> notes;
    const auto say = [&](std::size_t count, const char* sentence) {
        if (count > 0) notes.push_back(fmt::format(fmt::runtime(sentence), count));
    };
    say(cleaning.degenerate, "dropped {} triangles without area");
    say(cleaning.not_finite, "dropped {} triangles with vertices that are not finite");
    say(cleaning.bad_attributes, "repaired {} normals or texture coordinates that are not usable");
    say(cleaning.empty_meshes, "dropped {} empty meshes");
    return notes;
}

void append(Mesh& mesh, Mesh part) {
    if (part.triangles.empty()) return;
    if (mesh.triangles.empty()) {
        mesh = std::move(part);
        return;
    }
    if (mesh.normals.empty() != part.normals.empty())
        add_flat_normals(mesh.normals.empty() ? mesh : part);
    if (!mesh.texcoords.empty() || !part.texcoords.empty()) {
        mesh.texcoords.resize(mesh.positions.size());
        part.texcoords.resize(part.positions.size());
    }
    CHECK(mesh.positions.size() + part.positions.size() <= unused);
    const auto first = std::uint32_t(mesh.positions.size());
    append_values(mesh.positions, part.positions);
    append_values(mesh.normals, part.normals);
    append_values(mesh.texcoords, part.texcoords);
    if (!mesh.slots.empty() || !part.slots.empty()) {
        mesh.slots.resize(mesh.triangles.size());
        part.slots.resize(part.triangles.size());
        append_values(mesh.slots, part.slots);
    }
    for (const uvec3& t : part.triangles) mesh.triangles.push_back(t + first);
}

}  // namespace tessera
