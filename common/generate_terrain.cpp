// Hills with 660 trees of two kinds that sway in the wind, each in its own way: 661 instances and
// ten million triangles under one light, after the outdoor scene with which Wald's thesis (2004,
// 9.8) measures what many moving instances cost.

#include <fmt/format.h>

#include <glm/gtc/matrix_transform.hpp>

#include "common/animate.h"
#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/motion_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr int trees = 660;
constexpr float land = 160;  // metres on a side, around the origin
constexpr int winds = 12;    // ways to sway
constexpr double gust_seconds = 6;

float height_at(float x, float z) {
    return 7 * std::sin(0.031f * x + 0.6f) * std::cos(0.027f * z) +
           2.2f * std::sin(0.083f * x - 0.061f * z) + 0.5f * std::sin(0.21f * z + 0.17f * x);
}

Mesh ground() {
    constexpr int cells = 220;
    MeshBuilder out;
    out.grid(cells + 1, cells + 1, [](int i, int j) {
        const float x = land * (float(i) / cells - 0.5f), z = land * (float(j) / cells - 0.5f);
        constexpr float d = 0.1f;
        const vec3 normal(height_at(x - d, z) - height_at(x + d, z), 2 * d,
                          height_at(x, z - d) - height_at(x, z + d));
        return MeshBuilder::Vertex{{x, height_at(x, z), z}, normal};
    });
    return out.take();
}

vec3 around(float phi) { return {std::cos(phi), 0, std::sin(phi)}; }

/// Two triangles that meet along a fold.
void add_leaf(MeshBuilder& out, const vec3& at, const vec3& along, const vec3& across) {
    const vec3 lift = 0.3f * length(across) * normalize(cross(across, along));
    out.quad(at, at + 0.5f * along + across + lift, at + along, at + 0.5f * along);
    out.quad(at, at + 0.5f * along, at + along, at + 0.5f * along - across + lift);
}

/// A spruce eight metres high. Slots: 0 bark, 1 needles.
Mesh spruce() {
    constexpr int whorls = 26, branches = 10, twigs = 6;
    MeshBuilder out;
    const vec2 trunk[] = {{0.19f, 0}, {0.13f, 2.5f}, {0.06f, 6}, {0.01f, 8}};
    out.slot(0).lathe({0, 0, 0}, trunk, 14);
    for (int w = 0; w < whorls; ++w) {
        const float up = (float(w) + 0.5f) / whorls, reach = 2.1f * (1 - up) + 0.1f;
        for (int b = 0; b < branches; ++b) {
            const auto seed = std::uint32_t(1000 + 64 * (w * branches + b));
            const vec3 out_of = around(2 * pi * (float(b) + 0.61f * float(w)) / branches +
                                       random_between(seed, -0.15f, 0.15f));
            const vec3 root(0, 0.9f + 7 * up, 0);
            const float droop = random_between(seed + 1, 0.15f, 0.35f);
            const vec3 along = reach * random_between(seed + 2, 0.8f, 1.1f) *
                               normalize(out_of - vec3(0, droop, 0));
            const vec3 path[] = {root, root + 0.5f * along, root + along};
            out.slot(0).tube(path, 0.012f + 0.012f * (1 - up), 4);
            const vec3 aside = normalize(cross(along, vec3(0, 1, 0)));
            for (int t = 0; t < twigs; ++t)
                for (const float hand : {-1.0f, 1.0f}) {
                    const float from = (float(t) + 1) / (twigs + 1);
                    const vec3 twig = reach * 0.3f * (1.15f - from) *
                                      normalize(hand * aside + 0.7f * normalize(along));
                    add_leaf(out.slot(1), root + from * along, twig,
                             0.18f * length(twig) * normalize(along));
                }
        }
    }
    return out.take();
}

/// A beech seven metres high: a trunk that forks four times. Slots: 0 bark, 1 leaves.
class Beech {
public:
    Mesh grow() {
        fork({0, 0, 0}, {0, 2.1f, 0}, 0.17f, 0);
        return out_.take();
    }

private:
    static constexpr int forks = 5;

    void fork(const vec3& root, const vec3& along, float radius, int depth) {
        const vec3 tip = root + along;
        const vec3 path[] = {root, root + 0.5f * along, tip};
        out_.slot(0).tube(path, radius, depth == 0 ? 12 : 4);
        if (depth >= 2) leaves(root, along, depth);
        if (depth == forks) return;
        const Frame frame(normalize(along));
        const int children = depth == 0 ? 6 : 3;
        for (int i = 0; i < children; ++i) {
            const float phi = 2 * pi * (float(i) + chance(-0.2f, 0.2f)) / float(children);
            const vec3 aside = std::cos(phi) * frame.s + std::sin(phi) * frame.t;
            const vec3 next =
                normalize(normalize(along) + chance(0.5f, 1.0f) * aside + vec3(0, 0.12f, 0));
            fork(tip, length(along) * chance(0.6f, 0.76f) * next, 0.6f * radius, depth + 1);
        }
    }

    void leaves(const vec3& root, const vec3& along, int depth) {
        const int count = depth == forks ? 3 : 4;
        for (int i = 0; i < count; ++i) {
            const float z = chance(-1, 1), phi = chance(0, 2 * pi);
            const vec3 way(std::sqrt(1 - z * z) * std::cos(phi), z,
                           std::sqrt(1 - z * z) * std::sin(phi));
            const vec3 leaf = chance(0.16f, 0.28f) * way;
            add_leaf(out_.slot(1), root + chance(0.2f, 1) * along, leaf,
                     0.08f * normalize(cross(leaf, vec3(0.3f, 1, 0.2f))));
        }
    }

    float chance(float lo, float hi) { return random_between(next_++, lo, hi); }

    MeshBuilder out_;
    std::uint32_t next_ = 900000;
};

/// Ways to sway: to and fro along some direction, not twice alike within a gust.
std::vector<std::int32_t> add_winds(Motion& motion) {
    std::vector<std::int32_t> out;
    for (int i = 0; i < winds; ++i) {
        const auto seed = std::uint32_t(5000 + 8 * i);
        const float phase = random_between(seed, 0, 2 * pi);
        const vec3 axis = around(random_between(seed + 1, -0.6f, 0.6f));
        out.push_back(add_rotations(
            motion, {.period = gust_seconds, .times = 1, .keys = 48}, [&](float part) {
                const float lean = 0.03f * std::sin(2 * pi * part + phase) +
                                   0.015f * std::sin(6 * pi * part + 2 * phase) + 0.02f;
                return glm::angleAxis(lean, axis);
            }));
    }
    return out;
}

}  // namespace

SceneBundle generate_terrain() {
    SceneBundle bundle;
    const auto paint = [&](const char* name, const vec3& colour) {
        return add_material(bundle, {.name = name, .base_color = colour});
    };
    const auto bark = paint("bark", {0.16f, 0.11f, 0.08f}),
               needles = paint("needles", {0.06f, 0.16f, 0.07f}),
               leaves = paint("leaves", {0.22f, 0.38f, 0.07f}),
               meadow = paint("meadow", {0.2f, 0.26f, 0.08f});
    const std::uint32_t kinds[] = {add_object(bundle, "spruce", spruce(), {bark, needles}),
                                   add_object(bundle, "beech", Beech().grow(), {bark, leaves})};
    add_instance(bundle, "ground", add_object(bundle, "ground", ground(), {meadow}));
    const std::vector<std::int32_t> sways = add_winds(bundle.motion);
    for (int i = 0; i < trees; ++i) {
        // Each in its own cell of a grid, so that no two stand in each other.
        constexpr int columns = 30;
        constexpr float pitch = land / columns;
        const auto seed = std::uint32_t(100 + 8 * i);
        const float x =
            pitch * (float(i % columns) + random_between(seed, 0.15f, 0.85f)) - land / 2;
        const float z =
            pitch * (float(i / columns) + random_between(seed + 1, 0.15f, 0.85f)) - land / 2;
        const vec3 foot(x, height_at(x, z) - 0.05f, z);
        mat4 place = glm::translate(mat4(1), foot);
        place = glm::rotate(place, random_between(seed + 2, 0, 2 * pi), vec3(0, 1, 0));
        place = glm::scale(place, vec3(random_between(seed + 3, 0.7f, 1.2f)));
        const std::uint32_t instance = add_instance(bundle, fmt::format("tree {}", i + 1),
                                                    kinds[random_unit(seed + 4) < 0.45f], place);
        const auto sway = sways[std::size_t(random_unit(seed + 5) * winds)];
        carry(
            bundle, instance,
            add_node(bundle.motion, {.translation = foot, .weights = {}, .rotation_track = sway}));
    }
    bundle.scene.environment.radiance = {0.5f, 0.7f, 1.0f};
    bundle.scene.lights.push_back({.name = "sun",
                                   .kind = LightKind::directional,
                                   .direction = normalize(vec3(-0.6f, -0.55f, -0.35f)),
                                   .intensity = {3.6f, 3.1f, 2.3f}});
    const vec3 eye(10, height_at(10, 52) + 7, 52);
    bundle.scene.cameras.push_back(
        {.name = "hilltop", .eye = eye, .at = eye + vec3(-9, -4.5f, -30), .fov_y = 50});
    return bundle;
}

}  // namespace tessera
