// What tests of loaders and generators ask of any scene.
#pragma once

#include <gtest/gtest.h>

#include <array>
#include <set>
#include <string>
#include <vector>

#include "common/check.h"
#include "common/scene.h"

namespace tessera {

/// The message of the UserError that `act` must throw.
template <class Act>
std::string user_error(Act act) {
    try {
        act();
    } catch (const UserError& error) {
        return error.what();
    }
    ADD_FAILURE() << "no UserError was thrown";
    return {};
}

inline Mesh mesh_of(const SceneBundle& bundle, std::uint32_t index) {
    const auto blob = bundle.blobs.find(bundle.scene.meshes.at(index));
    EXPECT_NE(blob, nullptr);
    return decode_mesh(*blob);
}

inline Texture texture_of(const SceneBundle& bundle, std::int32_t index) {
    const auto blob = bundle.blobs.find(bundle.scene.textures.at(std::size_t(index)));
    EXPECT_NE(blob, nullptr);
    return decode_texture(*blob);
}

struct WorldTriangle {
    std::array<vec3, 3> points;
    std::string material;
    vec3 emission{0};
    std::string instance;

    float area() const {
        return 0.5f * length(cross(points[1] - points[0], points[2] - points[0]));
    }
};

/// Every triangle of every instance, in world space.
inline std::vector<WorldTriangle> world_triangles(const SceneBundle& bundle) {
    std::vector<Mesh> meshes;
    for (std::uint32_t i = 0; i < bundle.scene.meshes.size(); ++i)
        meshes.push_back(mesh_of(bundle, i));
    std::vector<WorldTriangle> triangles;
    for (const Instance& instance : bundle.scene.instances) {
        const Object& object = bundle.scene.objects.at(instance.object);
        const Mesh& mesh = meshes.at(object.mesh);
        for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
            const std::size_t slot = mesh.slots.empty() ? 0 : mesh.slots[i];
            const Material& material = bundle.scene.materials.at(object.materials.at(slot));
            WorldTriangle t{.points = {},
                            .material = material.name,
                            .emission = material.emission,
                            .instance = instance.name};
            for (int k = 0; k < 3; ++k)
                t.points[k] = vec3(instance.world_from_object *
                                   vec4(mesh.positions[mesh.triangles[i][k]], 1));
            triangles.push_back(t);
        }
    }
    return triangles;
}

/// The scene with one instance of each object: enough to check meshes, however often they repeat.
inline SceneBundle without_repeats(SceneBundle bundle) {
    std::set<std::uint32_t> seen;
    std::erase_if(bundle.scene.instances,
                  [&](const Instance& instance) { return !seen.insert(instance.object).second; });
    return bundle;
}

/// Valid indices, finite values, meshes that decode and whose triangles have an area, and a
/// material for every slot.
inline void expect_sound(const SceneBundle& bundle) {
    EXPECT_NO_THROW(validate(bundle.scene));
    for (std::uint32_t i = 0; i < bundle.scene.meshes.size(); ++i) {
        const Mesh mesh = mesh_of(bundle, i);
        EXPECT_FALSE(mesh.triangles.empty());
        for (const vec3& p : mesh.positions) ASSERT_TRUE(is_finite(p));
        for (const vec3& n : mesh.normals) ASSERT_TRUE(is_finite(n) && n != vec3(0));
        for (const uvec3& t : mesh.triangles) {
            const glm::dvec3 a(mesh.positions[t.x]);
            ASSERT_NE(
                cross(glm::dvec3(mesh.positions[t.y]) - a, glm::dvec3(mesh.positions[t.z]) - a),
                glm::dvec3(0));
        }
    }
    for (std::size_t i = 0; i < bundle.scene.textures.size(); ++i)
        EXPECT_GT(texture_of(bundle, std::int32_t(i)).width, 0u);
    EXPECT_NO_THROW(world_triangles(without_repeats(bundle)));
}

/// Whether one of `notes` contains `text`.
inline bool has_note(const std::vector<std::string>& notes, const std::string& text) {
    for (const std::string& note : notes)
        if (note.find(text) != std::string::npos) return true;
    return false;
}

}  // namespace tessera
