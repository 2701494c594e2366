// Sixteen robots that walk around a square, of ten parts each, in a small town: 161 instances and
// 90,000 triangles, after the scene of that name in the BART suite (Lext, Assarsson and Moeller, "A
// Benchmark for Animated Ray Tracing", 2001), with which Wald's thesis measures motion in
// hierarchies.

#include <fmt/format.h>

#include <array>

#include "common/animate.h"
#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/motion_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr int robots = 16;
constexpr int rings = 4;
constexpr float innermost = 3;  // metres from the middle of the square
constexpr float ring_distance = 1.9f;
constexpr double walk_seconds = 24;  // once around
constexpr double step_seconds = 1.2;
constexpr int steps = 20;  // of two feet, in that time

constexpr float block = 11;  // metres from one house to the next
constexpr float house = 7;
constexpr float storey = 3;

const vec3 side(1, 0, 0);

/// A wall of windows on each side, and a roof. Slots: 0 wall, 1 windows.
void add_house(MeshBuilder& out, const vec3& at, int storeys) {
    const float height = float(storeys) * storey, half = house / 2;
    out.slot(0).box(at - vec3(half, 0, half), at + vec3(half, height, half));
    out.box(at + vec3(-half - 0.2f, height, -half - 0.2f),
            at + vec3(half + 0.2f, height + 0.3f, half + 0.2f));
    constexpr int windows = 4;
    for (int level = 0; level < storeys; ++level)
        for (int wall = 0; wall < 4; ++wall)
            for (int i = 0; i < windows; ++i) {
                const float along = house * ((float(i) + 0.5f) / windows - 0.5f);
                const vec3 out_of =
                    wall < 2 ? vec3(wall ? -1 : 1, 0, 0) : vec3(0, 0, wall == 2 ? 1 : -1);
                const vec3 across(out_of.z, 0, out_of.x);
                const vec3 centre = at + half * out_of + along * across +
                                    vec3(0, storey * (float(level) + 0.55f), 0);
                const vec3 size = 0.5f * abs(across) + vec3(0, 0.75f, 0);
                out.slot(1).box(centre - size - 0.04f * abs(out_of),
                                centre + size + 0.04f * abs(out_of));
                const vec3 sill = centre - vec3(0, 0.85f, 0);
                const vec3 of_sill = 0.6f * abs(across) + vec3(0, 0.06f, 0) + 0.12f * abs(out_of);
                out.slot(0).box(sill - of_sill, sill + of_sill);
            }
}

/// Houses around a square. Slots: 0 wall, 1 windows, 2 ground, 3 paving.
Mesh town() {
    MeshBuilder out;
    out.slot(2).quad({-60, 0, 60}, {60, 0, 60}, {60, 0, -60}, {-60, 0, -60});
    out.slot(3).cylinder({0, -0.98f, 0}, 11.5f, 1, 96);
    out.slot(3).cylinder({0, 0, 0}, 1.6f, 0.5f, 64);
    out.slot(1).ball({0, 1.4f, 0}, 0.9f, 64);
    constexpr int reach = 4;
    for (int x = -reach; x <= reach; ++x)
        for (int z = -reach; z <= reach; ++z) {
            if (std::max(std::abs(x), std::abs(z)) < 2) continue;
            const auto number = std::uint32_t(100 * (x + reach) + z + reach);
            const int storeys =
                2 + int(random_between(number, 0, 3.99f)) + std::max(std::abs(x), std::abs(z)) / 2;
            add_house(out, {block * float(x), 0, block * float(z)}, storeys);
        }
    return out.take();
}

/// A robot's parts, each around the joint by which it hangs.
enum Part {
    body,
    head,
    left_arm,
    right_arm,
    left_hand,
    right_hand,
    left_leg,
    right_leg,
    left_foot,
    right_foot,
    parts
};

struct PartPlan {
    const char* name;
    int parent;   ///< -1: the place where it walks
    vec3 joint;   ///< in its parent
    float swing;  ///< radians, to and fro; negative: against the step
    float bent;   ///< radians, always
};

constexpr PartPlan plans[parts] = {
    {"body", -1, {0, 0.95f, 0}, 0, 0},
    {"head", body, {0, 0.62f, 0}, 0.1f, 0},
    {"left arm", body, {0.3f, 0.5f, 0}, 0.6f, 0},
    {"right arm", body, {-0.3f, 0.5f, 0}, -0.6f, 0},
    {"left hand", left_arm, {0, -0.36f, 0}, 0.25f, -0.35f},
    {"right hand", right_arm, {0, -0.36f, 0}, -0.25f, -0.35f},
    {"left leg", body, {0.14f, 0, 0}, -0.55f, 0},
    {"right leg", body, {-0.14f, 0, 0}, 0.55f, 0},
    {"left foot", left_leg, {0, -0.45f, 0}, 0.3f, 0.35f},
    {"right foot", right_leg, {0, -0.45f, 0}, -0.3f, 0.35f},
};

/// Slots: 0 shell, 1 joints, 2 eyes.
Mesh part_mesh(int part) {
    MeshBuilder out;
    switch (part) {
        case body:
            out.slot(0).rounded_box({-0.24f, 0.02f, -0.14f}, {0.24f, 0.56f, 0.14f}, 0.07f, 4);
            out.slot(1).ball({0, 0.3f, 0.13f}, 0.06f, 20);
            break;
        case head:
            out.slot(0).rounded_box({-0.13f, 0.02f, -0.12f}, {0.13f, 0.28f, 0.12f}, 0.05f, 4);
            out.slot(1).cylinder({0, -0.08f, 0}, 0.05f, 0.12f, 20);
            out.slot(2).ball({0.06f, 0.17f, 0.11f}, 0.035f, 16);
            out.ball({-0.06f, 0.17f, 0.11f}, 0.035f, 16);
            break;
        case left_arm:
        case right_arm:
            out.slot(1).ball(vec3(0), 0.075f, 16);
            out.slot(0).rounded_box({-0.055f, -0.34f, -0.055f}, {0.055f, -0.03f, 0.055f}, 0.025f,
                                    3);
            break;
        case left_hand:
        case right_hand:
            out.slot(1).ball(vec3(0), 0.06f, 16);
            out.slot(0).rounded_box({-0.05f, -0.32f, -0.05f}, {0.05f, -0.03f, 0.05f}, 0.025f, 3);
            out.slot(1).ball({0, -0.36f, 0}, 0.065f, 16);
            break;
        case left_leg:
        case right_leg:
            out.slot(1).ball(vec3(0), 0.09f, 16);
            out.slot(0).rounded_box({-0.075f, -0.43f, -0.075f}, {0.075f, -0.04f, 0.075f}, 0.03f, 3);
            break;
        default:
            out.slot(1).ball(vec3(0), 0.075f, 16);
            out.slot(0).rounded_box({-0.065f, -0.44f, -0.065f}, {0.065f, -0.04f, 0.065f}, 0.03f, 3);
            out.slot(0).rounded_box({-0.08f, -0.5f, -0.08f}, {0.08f, -0.42f, 0.18f}, 0.03f, 3);
            break;
    }
    return out.take();
}

/// Around the square, on a ring of its own radius; returns the node where it walks.
std::uint32_t add_walk(Motion& motion, int robot) {
    const auto angle = float(robot) / robots * 2 * pi * 1.618f;
    const float way = robot % 2 ? 1.0f : -1.0f;
    const Beat around{.period = walk_seconds, .times = 1, .keys = 8};
    const std::uint32_t pivot = add_node(
        motion, {.weights = {}, .rotation_track = add_rotations(motion, around, [&](float part) {
                                    return glm::angleAxis(angle + way * 2 * pi * part,
                                                          vec3(0, 1, 0));
                                })});
    MotionNode place{.parent = std::int32_t(pivot), .weights = {}};
    place.translation = {innermost + ring_distance * float(robot % rings), 0.02f, 0};
    place.rotation = glm::angleAxis(way > 0 ? pi : 0.0f, vec3(0, 1, 0));
    return add_node(motion, std::move(place));
}

void add_robot(SceneBundle& bundle, int robot, const std::array<std::uint32_t, parts>& objects) {
    Motion& motion = bundle.motion;
    const std::uint32_t place = add_walk(motion, robot);
    const Beat beat{.period = step_seconds, .times = steps, .keys = 8};
    const auto phase = float(robot) / robots;
    const auto wave = [&](float part) { return std::sin(2 * pi * (part + phase)); };
    std::array<std::uint32_t, parts> nodes;
    for (int p = 0; p < parts; ++p) {
        const PartPlan& plan = plans[p];
        MotionNode node{.weights = {}};
        node.parent = std::int32_t(plan.parent < 0 ? place : nodes[std::size_t(plan.parent)]);
        node.translation = plan.joint;
        if (p == body)
            node.translation_track = add_translations(motion, beat, [&](float part) {
                const float w = wave(part);
                return plan.joint - vec3(0, 0.03f * w * w, 0);
            });
        else
            node.rotation_track = add_rotations(motion, beat, [&](float part) {
                return glm::angleAxis(plan.bent + plan.swing * wave(part), side);
            });
        nodes[std::size_t(p)] = add_node(motion, std::move(node));
        const std::uint32_t instance =
            add_instance(bundle, fmt::format("{} {}", plan.name, robot), objects[std::size_t(p)]);
        carry(bundle, instance, nodes[std::size_t(p)]);
    }
}

}  // namespace

SceneBundle generate_robots() {
    SceneBundle bundle;
    const auto paint = [&](const char* name, const vec3& colour) {
        return add_material(bundle, {.name = name, .base_color = colour});
    };
    const std::vector<std::uint32_t> of_town = {
        paint("wall", {0.62f, 0.5f, 0.4f}), paint("window", {0.08f, 0.1f, 0.13f}),
        paint("ground", {0.22f, 0.24f, 0.2f}), paint("paving", {0.42f, 0.4f, 0.38f})};
    add_instance(bundle, "town", add_object(bundle, "town", town(), of_town));
    const auto shell = add_material(
        bundle,
        {.name = "shell", .base_color = {0.85f, 0.32f, 0.06f}, .roughness = 0.4f, .specular = 1});
    const auto joint = add_material(
        bundle, {.name = "joint", .base_color = vec3(0.35f), .metallic = 1, .roughness = 0.45f});
    const auto eye =
        add_material(bundle, {.name = "eye", .base_color = vec3(0), .emission = {4, 6, 8}});
    std::array<std::uint32_t, parts> objects;
    for (int p = 0; p < parts; ++p) {
        const std::vector<std::uint32_t> all = {shell, joint, eye};
        objects[std::size_t(p)] = add_object(bundle, plans[p].name, part_mesh(p),
                                             {all.begin(), all.begin() + (p == head ? 3 : 2)});
    }
    for (int robot = 0; robot < robots; ++robot) add_robot(bundle, robot, objects);
    bundle.scene.lights.push_back({.name = "sun",
                                   .kind = LightKind::directional,
                                   .direction = normalize(vec3(-0.5f, -0.8f, -0.35f)),
                                   .intensity = vec3(3, 2.8f, 2.4f)});
    bundle.scene.environment.radiance = {0.45f, 0.6f, 0.85f};
    bundle.scene.cameras.push_back(
        {.name = "corner", .eye = {9.5f, 4.2f, 10.5f}, .at = {0, 0.9f, 0}, .fov_y = 48});
    bundle.scene = bundle_at(bundle, 0).scene;
    return bundle;
}

}  // namespace tessera
