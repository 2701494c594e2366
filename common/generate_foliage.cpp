// A thicket of leaves that point every way, in sun and under a bright sky: no two neighbouring
// pixels are alike, the worst case for filters that average over smooth surfaces.

#include <glm/gtc/matrix_transform.hpp>

#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr int greens = 3;
constexpr int leaves_per_bush = 400;
constexpr int bushes = 300;

vec3 random_direction(std::uint32_t seed) {
    const float z = random_between(2 * seed, -1, 1);
    const float phi = random_between(2 * seed + 1, 0, 2 * pi);
    const float r = std::sqrt(1 - z * z);
    return {r * std::cos(phi), z, r * std::sin(phi)};
}

/// A leaf: a diamond folded along its length.
void add_leaf(MeshBuilder& out, const vec3& place, std::uint32_t seed) {
    const vec3 along = random_between(seed, 0.06f, 0.12f) * random_direction(3 * seed + 1);
    const Frame frame(normalize(along));
    const float turn = random_between(seed + 7, 0, 2 * pi);
    const vec3 across = 0.03f * (std::cos(turn) * frame.s + std::sin(turn) * frame.t);
    const vec3 lift = 0.012f * normalize(cross(along, across));
    const vec3 tip = place + along, middle = place + 0.5f * along;
    out.slot(std::uint16_t(seed % greens));
    out.quad(place, middle + across + lift, tip, middle);
    out.quad(place, middle, tip, middle - across + lift);
}

/// A ball of leaves of radius 0.5 around the origin.
Mesh bush(std::uint32_t seed) {
    MeshBuilder out;
    for (std::uint32_t i = 0; i < leaves_per_bush; ++i) {
        const std::uint32_t number = seed * leaves_per_bush + i;
        const float radius = 0.5f * std::cbrt(random_unit(5 * number));
        add_leaf(out, radius * random_direction(number), number);
    }
    return out.take();
}

}  // namespace

SceneBundle generate_foliage() {
    SceneBundle bundle;
    std::vector<std::uint32_t> leaves;
    for (const vec3& green :
         {vec3(0.2f, 0.42f, 0.08f), vec3(0.34f, 0.5f, 0.12f), vec3(0.12f, 0.3f, 0.1f)})
        leaves.push_back(add_material(bundle, {.name = "leaf", .base_color = green}));
    std::vector<std::uint32_t> kinds;
    for (std::uint32_t kind = 0; kind < 8; ++kind)
        kinds.push_back(add_object(bundle, "bush", bush(kind), leaves));
    for (std::uint32_t i = 0; i < bushes; ++i) {
        const vec3 place(random_between(4 * i, -3.5f, 3.5f), random_between(4 * i + 1, 0, 3.5f),
                         random_between(4 * i + 2, -2, 0.5f));
        const mat4 turned =
            glm::rotate(mat4(1), random_between(4 * i + 3, 0, 2 * pi), vec3(0, 1, 0));
        add_instance(bundle, "bush", kinds[i % kinds.size()],
                     glm::translate(mat4(1), place) * turned);
    }
    MeshBuilder sky;
    sky.quad({-8, 9, -8}, {8, 9, -8}, {8, 9, 8}, {-8, 9, 8});
    const auto glow = add_material(
        bundle, {.name = "sky", .base_color = vec3(0), .emission = {2.7f, 3.3f, 4.2f}});
    add_instance(bundle, "sky", add_object(bundle, "sky", sky.take(), {glow}));
    bundle.scene.lights.push_back({.name = "sun",
                                   .kind = LightKind::directional,
                                   .direction = normalize(vec3(-0.5f, -0.8f, -0.6f)),
                                   .intensity = {12, 11, 9.5f}});
    bundle.scene.cameras.push_back(
        {.name = "front", .eye = {0, 1.7f, 4.5f}, .at = {0, 1.7f, 0}, .fov_y = 40});
    return bundle;
}

}  // namespace tessera
