// Small scenes that are hard on a tracer, and rays that are hard on it: for the tests and for
// `tessera bench stability`.
#pragma once

#include <cmath>
#include <glm/gtc/matrix_transform.hpp>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include "common/mesh.h"
#include "common/scene.h"
#include "worker/tracer.h"

namespace tessera {

struct TestScene {
    std::string name;
    std::vector<Mesh> meshes;
    std::vector<TracerInstance> instances;

    std::vector<TracerObject> objects() const {
        std::vector<TracerObject> out;
        for (const Mesh& mesh : meshes) out.push_back({mesh.positions, mesh.triangles});
        return out;
    }
};

inline TestScene scene_of(std::string name, Mesh mesh) {
    return {std::move(name), {std::move(mesh)}, {{0, mat4(1)}}};
}

/// The geometry of a whole scene.
inline TestScene test_scene(std::string name, const SceneBundle& bundle) {
    TestScene out{std::move(name), {}, {}};
    for (const Object& object : bundle.scene.objects)
        out.meshes.push_back(decode_mesh(*bundle.blobs.find(bundle.scene.meshes[object.mesh])));
    for (const Instance& instance : bundle.scene.instances)
        out.instances.push_back({instance.object, instance.world_from_object});
    return out;
}

/// All instances as one object in world space.
inline TestScene flattened(const TestScene& scene) {
    Mesh all;
    for (const TracerInstance& instance : scene.instances) {
        const Mesh& mesh = scene.meshes[instance.object];
        const auto first = std::uint32_t(all.positions.size());
        for (const vec3& p : mesh.positions)
            all.positions.push_back(vec3(instance.world_from_object * vec4(p, 1)));
        for (const uvec3& t : mesh.triangles) all.triangles.push_back(first + t);
    }
    return scene_of(scene.name, std::move(all));
}

using Random = std::mt19937;

inline float uniform(Random& random, float lo, float hi) {
    // The high bits of one draw; std's distributions differ between libraries.
    return lo + (hi - lo) * (float(random() >> 8) * 0x1p-24f);
}
inline vec3 uniform_point(Random& random, const Box& box) {
    const float x = uniform(random, box.lo.x, box.hi.x);
    const float y = uniform(random, box.lo.y, box.hi.y);
    return {x, y, uniform(random, box.lo.z, box.hi.z)};
}
inline vec3 uniform_direction(Random& random) {
    const float z = uniform(random, -1, 1), phi = uniform(random, 0, 2 * pi);
    const float r = std::sqrt(1 - z * z);
    return {r * std::cos(phi), r * std::sin(phi), z};
}

inline void add_triangle(Mesh& mesh, const vec3& a, const vec3& b, const vec3& c) {
    const auto first = std::uint32_t(mesh.positions.size());
    mesh.positions.insert(mesh.positions.end(), {a, b, c});
    mesh.triangles.emplace_back(first, first + 1, first + 2);
}

/// The six sides of a box, two triangles each, corners shared.
inline void add_box(Mesh& mesh, const Box& box) {
    const auto first = std::uint32_t(mesh.positions.size());
    for (int i = 0; i < 8; ++i)
        mesh.positions.emplace_back(i & 1 ? box.hi.x : box.lo.x, i & 2 ? box.hi.y : box.lo.y,
                                    i & 4 ? box.hi.z : box.lo.z);
    constexpr int sides[6][4] = {{0, 2, 6, 4}, {1, 5, 7, 3}, {0, 4, 5, 1},
                                 {2, 3, 7, 6}, {0, 1, 3, 2}, {4, 6, 7, 5}};
    for (const auto& s : sides) {
        mesh.triangles.push_back(first + uvec3(s[0], s[1], s[2]));
        mesh.triangles.push_back(first + uvec3(s[0], s[2], s[3]));
    }
}

/// An axis-aligned room with furniture: every triangle invites a flat cell.
inline Mesh room_mesh() {
    Random random(1);
    Mesh mesh;
    add_box(mesh, {vec3(0), vec3(8, 3, 6)});
    for (int i = 0; i < 24; ++i) {
        // Coordinates on a coarse grid, so that faces of different boxes share planes.
        const vec3 lo = floor(uniform_point(random, {vec3(0), vec3(28, 8, 20)})) * 0.25f;
        const vec3 size = floor(uniform_point(random, {vec3(1), vec3(6)})) * 0.25f;
        add_box(mesh, {lo, min(lo + size, vec3(8, 3, 6))});
    }
    return mesh;
}

inline Mesh soup_mesh(int count, float size) {
    Random random(2);
    Mesh mesh;
    const auto jitter = [&] { return size * uniform_direction(random); };
    for (int i = 0; i < count; ++i) {
        const vec3 p = uniform_point(random, {vec3(-1), vec3(1)});
        const vec3 a = p + jitter(), b = p + jitter();
        add_triangle(mesh, a, b, p + jitter());
    }
    return mesh;
}

/// A closed surface around the origin, lumpy enough to have no symmetry. Vertices are shared.
inline Mesh sphere_mesh(int stacks, int slices, float radius, vec3 centre = vec3(0)) {
    Mesh mesh;
    const auto vertex = [&](int stack, int slice) {
        if (stack == 0) return 0u;
        if (stack == stacks) return 1u;
        return 2 + std::uint32_t((stack - 1) * slices + slice % slices);
    };
    mesh.positions = {centre + vec3(0, 0, radius), centre - vec3(0, 0, radius)};
    for (int i = 1; i < stacks; ++i)
        for (int k = 0; k < slices; ++k) {
            const float theta = pi * float(i) / float(stacks);
            const float phi = 2 * pi * float(k) / float(slices);
            const float r = radius * (1 + 0.07f * std::sin(5 * theta) * std::cos(3 * phi));
            mesh.positions.push_back(centre + r * vec3(std::sin(theta) * std::cos(phi),
                                                       std::sin(theta) * std::sin(phi),
                                                       std::cos(theta)));
        }
    for (int i = 0; i < stacks; ++i)
        for (int k = 0; k < slices; ++k) {
            const uvec3 quad[2] = {{vertex(i, k), vertex(i + 1, k), vertex(i + 1, k + 1)},
                                   {vertex(i, k), vertex(i + 1, k + 1), vertex(i, k + 1)}};
            if (i + 1 < stacks) mesh.triangles.push_back(quad[0]);
            if (i > 0) mesh.triangles.push_back(quad[1]);
            if (i + 1 == stacks) mesh.triangles.back() = quad[1];
        }
    return mesh;
}

inline Mesh sliver_mesh(float width = 1e-4f) {
    Random random(3);
    Mesh mesh;
    for (int i = 0; i < 300; ++i) {
        const vec3 p = uniform_point(random, {vec3(-1), vec3(1)});
        const vec3 along = uniform_direction(random);
        const vec3 across = width * uniform_direction(random);
        add_triangle(mesh, p, p + along, p + 0.5f * along + across);
    }
    return mesh;
}

/// Triangles of a grid in one plane, each there twice, and once more with its corners turned.
inline Mesh coplanar_mesh() {
    Mesh mesh;
    for (int copy = 0; copy < 3; ++copy)
        for (int i = 0; i < 8; ++i)
            for (int k = 0; k < 8; ++k) {
                const vec3 p(0.25f * float(i) - 1, 0.5f, 0.25f * float(k) - 1);
                const vec3 x(0.25f, 0, 0), z(0, 0, 0.25f);
                if (copy < 2)
                    add_triangle(mesh, p, p + x, p + z);
                else
                    add_triangle(mesh, p + z, p, p + x);
            }
    add_box(mesh, {vec3(-1, 0, -1), vec3(1, 1, 1)});
    return mesh;
}

/// A sphere among triangles that are none: zero area, not finite, index repeated.
inline Mesh broken_mesh() {
    Mesh mesh = sphere_mesh(12, 17, 1);
    const float nan = std::numeric_limits<float>::quiet_NaN();
    for (int i = 0; i < 20; ++i) {
        const vec3 p(0.1f * float(i));
        add_triangle(mesh, p, p, p);
        add_triangle(mesh, p, p + vec3(1, 0, 0), p + vec3(2, 0, 0));
        add_triangle(mesh, p, vec3(nan), p + vec3(0, 1, 0));
        add_triangle(mesh, p, vec3(infinity, 0, 0), p + vec3(0, 1, 0));
        mesh.triangles.emplace_back(0, 2, 2);
    }
    return mesh;
}

/// Squares at 2^-i: each split of the tree takes one off.
inline Mesh shrinking_mesh() {
    Mesh mesh;
    for (int i = 0; i < 300; ++i) {
        const float x = std::ldexp(1.0f, -i / 3) * (1 + 0.25f * float(i % 3));
        add_triangle(mesh, vec3(x, 0, 0), vec3(x, x, 0), vec3(x, 0, x));
    }
    return mesh;
}

/// Objects turned, mirrored, sheared, stretched, flattened to nothing and left empty.
inline TestScene instanced_scene() {
    TestScene scene{"instances", {sphere_mesh(10, 13, 0.6f), room_mesh(), Mesh{}}, {}};
    const mat4 one(1);
    const auto place = [&](std::uint32_t object, const vec3& at, const mat4& m) {
        scene.instances.push_back({object, translate(one, at) * m});
    };
    mat4 shear(1);
    shear[1][0] = 0.8f;
    shear[2][1] = -0.5f;
    place(0, vec3(0), one);
    place(0, vec3(0), one);  // the same again: ties
    place(0, vec3(2, 0, 0), scale(one, vec3(-1, 1, 1)));
    place(0, vec3(0, 2, 0), shear);
    place(0, vec3(0, 0, 2), scale(one, vec3(3, 0.1f, 0.5f)));
    place(0, vec3(1), scale(one, vec3(1, 0, 1)));
    place(1, vec3(-3), rotate(one, 0.7f, vec3(1, 2, 3)));
    place(1, vec3(-1, -1, 0), scale(shear, vec3(0.2f, -0.3f, 0.2f)));
    place(2, vec3(0), one);
    place(0, vec3(infinity), one);
    Random random(5);
    for (int i = 0; i < 40; ++i)
        place(0, uniform_point(random, {vec3(-4), vec3(4)}),
              rotate(scale(one, vec3(uniform(random, 0.1f, 0.8f))), uniform(random, 0, 6),
                     uniform_direction(random)));
    return scene;
}

inline std::vector<TestScene> small_scenes() {
    Mesh far = room_mesh();
    for (vec3& p : far.positions) p += vec3(1e4f, -2e4f, 3e4f);
    Mesh single;
    add_triangle(single, vec3(0), vec3(1, 0, 0), vec3(0, 1, 0));
    return {scene_of("room", room_mesh()),
            scene_of("soup", soup_mesh(1000, 0.2f)),
            scene_of("dust", soup_mesh(3000, 0.01f)),
            scene_of("sphere", sphere_mesh(24, 31, 1)),
            scene_of("slivers", sliver_mesh()),
            scene_of("coplanar", coplanar_mesh()),
            scene_of("broken", broken_mesh()),
            scene_of("shrinking", shrinking_mesh()),
            scene_of("far", far),
            scene_of("single", single),
            scene_of("empty", Mesh{}),
            instanced_scene()};
}

/// Makes rays of one kind after another through a scene.
class RayMaker {
public:
    RayMaker(const TestScene& scene, const Box& bounds, std::uint32_t seed)
        : scene_(scene), box_(bounds), random_(seed) {
        if (box_.empty()) box_ = {vec3(-1), vec3(1)};
        const vec3 margin = 0.25f * box_.extent() + 1e-3f;
        box_ = {box_.lo - margin, box_.hi + margin};
        for (const TracerInstance& instance : scene.instances)
            if (std::isfinite(instance.world_from_object[3].x) &&
                !scene.meshes[instance.object].triangles.empty())
                targets_.push_back(&instance);
    }

    static constexpr int kinds = 5;
    static const char* name(int kind) {
        constexpr const char* names[] = {"random", "axis-parallel", "in-plane", "edge", "segment"};
        return names[kind];
    }

    Ray ray(int kind) {
        switch (kind) {
            case 0:
                return {uniform_point(random_, box_), 0, uniform_direction(random_), infinity};
            case 1:
                return {uniform_point(random_, box_), 0, axis_direction(), infinity};
            case 2:
                return in_plane();
            case 3: {
                const vec3 org = uniform_point(random_, box_);
                return {org, 0, edge_point() - org, infinity};
            }
            default: {
                const vec3 a = uniform_point(random_, box_), b = uniform_point(random_, box_);
                return {a, uniform(random_, 0, 0.3f), b - a, uniform(random_, 0.3f, 1)};
            }
        }
    }

private:
    float zero() { return random_() & 1 ? 0.0f : -0.0f; }

    vec3 axis_direction() {
        vec3 d(zero(), zero(), zero());
        d[int(random_() % 3)] = random_() & 1 ? 1.0f : -1.0f;
        return d;
    }

    /// Runs in an axis plane through a vertex, so often in a split plane: along an axis or askew.
    Ray in_plane() {
        const vec3 p = vertex();
        const int axis = int(random_() % 3);
        Ray ray{uniform_point(random_, box_), 0, uniform_direction(random_), infinity};
        if (random_() & 1) ray.dir = axis_direction();
        ray.org[axis] = p[axis];
        ray.dir[axis] = zero();
        if (random_() & 1) ray.org[(axis + 1) % 3] = p[(axis + 1) % 3];
        if (ray.dir == vec3(0)) ray.dir[(axis + 2) % 3] = 1;
        return ray;
    }

    vec3 edge_point() {
        const vec3 a = vertex();
        if (random_() % 3 == 0) return a;
        const vec3 b = corner(next_corner_);
        return a + uniform(random_, 0, 1) * (b - a);
    }

    /// A random finite vertex in the world.
    vec3 vertex() {
        for (int attempt = 0; attempt < 10 && !targets_.empty(); ++attempt) {
            target_ = targets_[random_() % targets_.size()];
            const Mesh& mesh = scene_.meshes[target_->object];
            triangle_ = mesh.triangles[random_() % mesh.triangles.size()];
            const int k = int(random_() % 3);
            next_corner_ = (k + 1) % 3;
            if (is_finite(corner(k)) && is_finite(corner(next_corner_))) return corner(k);
        }
        return vec3(0);
    }
    vec3 corner(int k) const {
        if (!target_) return vec3(1);
        const vec3& p = scene_.meshes[target_->object].positions[triangle_[k]];
        return vec3(target_->world_from_object * vec4(p, 1));
    }

    const TestScene& scene_;
    Box box_;
    Random random_;
    std::vector<const TracerInstance*> targets_;
    const TracerInstance* target_ = nullptr;
    uvec3 triangle_{0};
    int next_corner_ = 0;
};

}  // namespace tessera
