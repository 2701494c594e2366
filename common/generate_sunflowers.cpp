// A field of 28,000 sunflowers, after the scene of that name in Wald's thesis (2004): instances of
// ten flowers of about 36,000 triangles each, a billion triangles in all. It asks for a level of
// instances that is built fast and traced deep. Lengths in metres; the rows run along z and the
// flowers look at the sun.

#include <array>
#include <glm/gtc/matrix_transform.hpp>

#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr int kinds = 10;
constexpr int rows = 140;
constexpr int flowers_in_row = 200;
constexpr float row_pitch = 0.9f;
constexpr float flower_pitch = 0.6f;
constexpr float field_x = rows * row_pitch;
constexpr float field_z = flowers_in_row * flower_pitch;
constexpr float golden_angle = 2.39996f;  // radians

/// Low hills.
float ground_height(float x, float z) {
    return 1.1f * std::sin(0.045f * x + 0.6f) * std::cos(0.038f * z) + 0.004f * z;
}

/// A blade along `along`, as wide as `width(t)` times `across`, bent by `bend(t)` times `up`; both
/// sides, as our surfaces have no thickness. Slot as set.
struct Blade {
    vec3 root, along, across, up;
    float length, width, bend;
    int steps;
};

void add_blade(MeshBuilder& b, const Blade& blade) {
    for (const float side : {1.0f, -1.0f})
        b.grid(5, blade.steps, [&](int i, int j) {
            const float t = float(j) / float(blade.steps - 1), x = float(i - 2) / 2;
            const float half = blade.width * std::pow(std::sin(pi * (0.06f + 0.94f * t)), 0.8f);
            const float fold = 0.25f * half * x * x - blade.bend * t * t;
            // The under side lies a hair lower, so that no ray meets both at once.
            const float under = side > 0 ? 0 : -0.001f;
            const vec3 p = blade.root + blade.along * (blade.length * t) +
                           blade.across * (half * x) + blade.up * (fold + under);
            const vec3 n = blade.up + blade.along * (2 * blade.bend * t / blade.length) -
                           blade.across * (0.5f * x);
            return MeshBuilder::Vertex{p, side * n};
        });
}

/// Slots: 0 stem and leaves, 1 petals, 2 seeds. The head looks at +z and up.
Mesh sunflower(std::uint32_t kind) {
    const auto chance = [&](std::uint32_t i, float lo, float hi) {
        return random_between(kind * 10'000 + i, lo, hi);
    };
    const float height = chance(0, 1.35f, 1.75f);
    const float lean = chance(1, 0.05f, 0.16f);
    const float radius = chance(2, 0.085f, 0.115f);
    MeshBuilder b;
    std::array<vec3, 14> stem;
    for (int i = 0; i < 14; ++i) {
        const float t = float(i) / 13;
        stem[std::size_t(i)] = {0.03f * std::sin(3 * t + chance(3, 0, 6)),
                                height * t - 0.06f * t * t * t * t, lean * t * t * t};
    }
    b.slot(0).tube(stem, 0.014f, 12);
    for (std::uint32_t i = 0; i < 14; ++i) {
        const float t = 0.2f + 0.05f * float(i);
        const float phi = golden_angle * float(i) + chance(20 + i, -0.3f, 0.3f);
        const vec3 out(std::cos(phi), 0, std::sin(phi));
        const vec3 along = normalize(out + vec3(0, 0.45f, 0));
        const vec3 across = normalize(cross(vec3(0, 1, 0), out));
        add_blade(b, {.root = {0, height * t, lean * t * t * t},
                      .along = along,
                      .across = across,
                      .up = normalize(cross(along, across)),
                      .length = chance(40 + i, 0.22f, 0.38f) * (1.2f - 0.5f * t),
                      .width = 0.085f,
                      .bend = chance(60 + i, 0.08f, 0.2f),
                      .steps = 17});
    }

    // The head: a dish, seeds on Vogel's spiral, petals around.
    const vec3 n = normalize(vec3(0, 0.35f, 1));
    const vec3 right(1, 0, 0), top = cross(n, right);
    const vec3 centre = stem.back() + 0.02f * n;
    const auto around = [&](float phi) { return right * std::cos(phi) + top * std::sin(phi); };
    b.slot(0).grid(33, 6, [&](int i, int j) {
        const float r = float(j) / 5, phi = 2 * pi * float(i % 32) / 32;
        return MeshBuilder::Vertex{
            centre + radius * (1.1f * r * around(phi) - 0.35f * (1 - r * r) * n),
            r * around(phi) - n};
    });
    constexpr int seeds = 440;
    for (int i = 0; i < seeds; ++i) {
        const float r = radius * std::sqrt((float(i) + 0.5f) / seeds);
        const vec3 at = centre + r * around(golden_angle * float(i)) +
                        0.12f * radius * (1 - r * r / (radius * radius)) * n;
        b.slot(2).ball(at, 0.62f * radius / std::sqrt(float(seeds)) * 1.5f, 8);
    }
    for (std::uint32_t i = 0; i < 44; ++i) {
        const bool inner = i % 2 == 1;
        const float phi = 2 * pi * (float(i) + chance(100 + i, -0.3f, 0.3f)) / 44;
        const float rise = inner ? chance(200 + i, 0.15f, 0.4f) : chance(200 + i, -0.1f, 0.15f);
        const vec3 along = normalize(around(phi) + rise * n);
        const vec3 across = normalize(cross(n, around(phi)));
        add_blade(b.slot(1), {.root = centre + 0.95f * radius * around(phi),
                              .along = along,
                              .across = across,
                              .up = normalize(cross(along, across)),
                              .length = chance(300 + i, 0.085f, 0.125f),
                              .width = 0.022f,
                              .bend = chance(400 + i, -0.03f, 0.03f),
                              .steps = 13});
    }
    return b.take();
}

Mesh ground() {
    constexpr int cells = 160;
    constexpr float margin = 60;
    MeshBuilder b;
    b.grid(cells + 1, cells + 1, [&](int i, int j) {
        const float x = -margin + (field_x + 2 * margin) * float(i) / cells;
        const float z = -margin + (field_z + 2 * margin) * float(j) / cells;
        return MeshBuilder::Vertex{{x, ground_height(x, z), z}, {0, 1, 0}};
    });
    return b.take();
}

/// Seen from inside.
Mesh sky_dome() {
    constexpr float radius = 400;
    const vec3 centre(field_x / 2, -20, field_z / 2);
    MeshBuilder b;
    b.grid(49, 13, [&](int i, int j) {
        const float phi = 2 * pi * float(i % 48) / 48, theta = pi / 2 * float(j) / 12;
        const vec3 d(std::cos(theta) * std::cos(phi), std::sin(theta),
                     std::cos(theta) * std::sin(phi));
        return MeshBuilder::Vertex{centre + radius * d, -d};
    });
    return b.take();
}

void plant(SceneBundle& bundle, const std::vector<std::uint32_t>& flowers) {
    for (std::uint32_t i = 0; i < rows * flowers_in_row; ++i) {
        const auto chance = [&](std::uint32_t k, float lo, float hi) {
            return random_between(100'000 + 8 * i + k, lo, hi);
        };
        const float x = row_pitch * (float(i / flowers_in_row) + chance(0, -0.18f, 0.18f));
        const float z = flower_pitch * (float(i % flowers_in_row) + chance(1, -0.3f, 0.3f));
        mat4 m = glm::translate(mat4(1), vec3(x, ground_height(x, z) - 0.02f, z));
        m = glm::rotate(m, chance(2, -0.5f, 0.5f), vec3(0, 1, 0));
        m = glm::rotate(m, chance(3, -0.06f, 0.06f), vec3(0, 0, 1));
        m = glm::scale(m, vec3(chance(4, 0.8f, 1.15f)));
        add_instance(bundle, "sunflower", flowers[std::size_t(chance(5, 0, kinds))], m);
    }
}

}  // namespace

SceneBundle generate_sunflowers() {
    SceneBundle bundle;
    const auto paint = [&](const char* name, const vec3& colour) {
        return add_material(bundle, {.name = name, .base_color = colour});
    };
    const auto green = paint("leaf", {0.13f, 0.30f, 0.06f});
    const auto yellow = paint("petal", {0.90f, 0.58f, 0.03f});
    const auto brown = paint("seed", {0.11f, 0.055f, 0.025f});
    const auto soil = paint("soil", {0.23f, 0.16f, 0.10f});
    const auto sky = add_material(
        bundle, {.name = "sky", .base_color = vec3(0), .emission = {0.45f, 0.65f, 1.0f}});
    std::vector<std::uint32_t> flowers;
    for (std::uint32_t kind = 0; kind < kinds; ++kind)
        flowers.push_back(add_object(bundle, "sunflower", sunflower(kind), {green, yellow, brown}));
    plant(bundle, flowers);
    add_instance(bundle, "ground", add_object(bundle, "ground", ground(), {soil}));
    add_instance(bundle, "sky", add_object(bundle, "sky", sky_dome(), {sky}));
    bundle.scene.lights.push_back({.name = "sun",
                                   .kind = LightKind::directional,
                                   .direction = normalize(vec3(-0.35f, -0.75f, -0.55f)),
                                   .intensity = vec3(3.2f, 2.9f, 2.4f)});
    bundle.scene.cameras.push_back({.name = "path",
                                    .eye = {field_x / 2, 3.6f, field_z + 4},
                                    .at = {field_x / 2 - 6, 1.2f, field_z - 20},
                                    .fov_y = 50});
    return bundle;
}

}  // namespace tessera
