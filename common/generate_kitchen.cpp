// A kitchen of mirrors: steel fronts, chrome pans and taps, a polished floor, and a toy train that
// goes round. 110,000 triangles in five objects under six point lights, after the scene of that
// name in the BART suite (Lext, Assarsson and Moeller, "A Benchmark for Animated Ray Tracing",
// 2001), in which reflections scatter rays every way.

#include <glm/gtc/matrix_transform.hpp>

#include "common/animate.h"
#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/motion_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"

namespace tessera {
namespace {

constexpr vec3 room{5.2f, 2.7f, 4.4f};
constexpr float worktop = 0.92f;  // metres above the floor
constexpr float depth = 0.62f;    // of cupboards
constexpr double round_seconds = 10;

/// Walls, and a checkered floor. Slots: 0 wall, 1 light tiles, 2 dark tiles, 3 ceiling.
Mesh shell() {
    MeshBuilder out;
    const vec3 b = room;
    constexpr int across = 13, along = 11;
    for (int i = 0; i < across; ++i)
        for (int j = 0; j < along; ++j) {
            const float x0 = b.x * float(i) / across, x1 = b.x * float(i + 1) / across;
            const float z0 = b.z * float(j) / along, z1 = b.z * float(j + 1) / along;
            out.slot((i + j) % 2 ? 1 : 2).quad({x0, 0, z1}, {x1, 0, z1}, {x1, 0, z0}, {x0, 0, z0});
        }
    out.slot(3).quad({0, b.y, 0}, {b.x, b.y, 0}, {b.x, b.y, b.z}, {0, b.y, b.z});
    out.slot(0).quad({0, 0, 0}, {b.x, 0, 0}, {b.x, b.y, 0}, {0, b.y, 0});
    out.quad({b.x, 0, b.z}, {0, 0, b.z}, {0, b.y, b.z}, {b.x, b.y, b.z});
    out.quad({0, 0, b.z}, {0, 0, 0}, {0, b.y, 0}, {0, b.y, b.z});
    out.quad({b.x, 0, 0}, {b.x, 0, b.z}, {b.x, b.y, b.z}, {b.x, b.y, 0});
    return out.take();
}

/// A cupboard's door with its handle. Slots: 0 front, 1 chrome.
void add_door(MeshBuilder& out, const vec3& lo, const vec3& hi) {
    out.slot(0).rounded_box(lo, hi, 0.008f, 3);
    const float z = hi.z + 0.025f, y = lo.y > 1.2f ? lo.y + 0.08f : hi.y - 0.08f;
    const vec3 handle[] = {{lo.x + 0.12f, y, z}, {hi.x - 0.12f, y, z}};
    out.slot(1).tube(handle, 0.008f, 16);
}

/// Cupboards below and above along the back wall, a fridge, a table with four stools.
/// Slots: 0 front, 1 chrome, 2 worktop, 3 wood, 4 mirror.
Mesh furniture() {
    MeshBuilder out;
    constexpr int doors = 7;
    const float width = (room.x - 1) / doors;
    for (int i = 0; i < doors; ++i) {
        const float x = 1 + width * float(i);
        add_door(out, {x + 0.006f, 0.1f, depth - 0.02f}, {x + width - 0.006f, 0.88f, depth});
        add_door(out, {x + 0.006f, 1.5f, 0.36f}, {x + width - 0.006f, 2.25f, 0.38f});
    }
    out.slot(0).box({1, 0.1f, 0.01f}, {room.x - 0.01f, 0.88f, depth - 0.02f});
    out.box({1, 1.5f, 0.01f}, {room.x - 0.01f, 2.25f, 0.36f});
    out.slot(2).rounded_box({0.98f, 0.88f, 0.01f}, {room.x - 0.01f, worktop, depth + 0.02f}, 0.012f,
                            4);
    out.slot(4).rounded_box({0.06f, 0.04f, 0.03f}, {0.92f, 2.1f, 0.72f}, 0.03f, 6);
    for (const float y : {0.95f, 1.35f}) {
        const vec3 handle[] = {{0.84f, y, 0.75f}, {0.84f, y + 0.3f, 0.75f}};
        out.slot(1).tube(handle, 0.012f, 20);
    }
    const vec3 table(2.9f, 0.74f, 2.7f);
    const vec2 top[] = {{0, -0.03f},     {0.66f, -0.03f}, {0.68f, -0.02f},
                        {0.68f, -0.01f}, {0.67f, 0},      {0, 0}};
    out.slot(3).lathe(table, top, 96);
    const vec2 foot[] = {{0.3f, -0.74f}, {0.3f, -0.72f}, {0.06f, -0.68f}, {0.05f, -0.03f}};
    out.slot(1).lathe(table, foot, 64);
    for (int i = 0; i < 4; ++i) {
        const float phi = 0.4f + 0.5f * pi * float(i);
        const vec3 stool = table + vec3(1.02f * std::cos(phi), -0.74f, 1.02f * std::sin(phi));
        const vec2 seat[] = {
            {0, 0.45f}, {0.17f, 0.45f}, {0.18f, 0.47f}, {0.17f, 0.49f}, {0, 0.49f}};
        out.slot(3).lathe(stool, seat, 48);
        const vec2 leg[] = {{0.16f, 0}, {0.16f, 0.01f}, {0.02f, 0.04f}, {0.02f, 0.45f}};
        out.slot(1).lathe(stool, leg, 40);
    }
    return out.take();
}

/// Pans, a kettle, a tap and a bowl on the worktop. One slot: chrome.
Mesh chrome() {
    MeshBuilder out;
    const vec2 pan[] = {{0, 0.004f},     {0.12f, 0.004f}, {0.13f, 0.02f}, {0.13f, 0.11f},
                        {0.138f, 0.11f}, {0.138f, 0.01f}, {0.125f, 0},    {0, 0}};
    for (int i = 0; i < 3; ++i) {
        const vec3 at(1.35f + 0.42f * float(i), worktop + 0.002f, 0.3f);
        out.lathe(at, pan, 192);
        const vec3 grip[] = {at + vec3(0.13f, 0.09f, 0), at + vec3(0.22f, 0.1f, 0.05f),
                             at + vec3(0.31f, 0.1f, 0.1f)};
        out.tube(grip, 0.012f, 24);
    }
    const vec2 kettle[] = {{0.1f, 0},      {0.115f, 0.02f}, {0.11f, 0.09f}, {0.08f, 0.15f},
                           {0.03f, 0.17f}, {0.02f, 0.19f},  {0.012f, 0.2f}, {0, 0.205f}};
    out.lathe({3.2f, worktop + 0.002f, 0.34f}, kettle, 256);
    std::vector<vec3> spout, handle, tap;
    for (int i = 0; i <= 40; ++i) {
        const float t = float(i) / 40, phi = pi * t;
        spout.push_back({3.3f + 0.12f * t, worktop + 0.06f + 0.12f * t * t, 0.34f});
        handle.push_back(
            {3.2f - 0.09f * std::cos(phi), worktop + 0.13f + 0.13f * std::sin(phi), 0.34f});
        tap.push_back(
            {4.25f, worktop + 0.25f + 0.11f * std::sin(phi), 0.24f - 0.11f * std::cos(phi)});
    }
    out.tube(spout, 0.014f, 40);
    out.tube(handle, 0.01f, 40);
    out.tube(tap, 0.014f, 40);
    out.cylinder({4.25f, worktop, 0.13f}, 0.014f, 0.26f, 40);
    const vec2 sink[] = {{0, 0.006f},    {0.2f, 0.008f}, {0.24f, 0.03f}, {0.26f, 0.05f},
                         {0.27f, 0.05f}, {0.25f, 0.02f}, {0.2f, 0.002f}, {0, 0.001f}};
    out.lathe({4.25f, worktop, 0.33f}, sink, 256);
    out.ball({2.9f, 0.86f, 2.7f}, 0.115f, 176);
    return out.take();
}

/// Plates on the table, cups and bottles on the worktop. Slots: 0 white, 1 red, 2 green.
Mesh crockery() {
    MeshBuilder out;
    const vec2 plate[] = {{0, 0.004f},      {0.08f, 0.004f}, {0.13f, 0.022f},
                          {0.132f, 0.019f}, {0.08f, 0},      {0, 0}};
    const vec2 cup[] = {{0, 0.006f},      {0.03f, 0.008f},  {0.04f, 0.085f},
                        {0.043f, 0.085f}, {0.034f, 0.001f}, {0, 0}};
    for (int i = 0; i < 4; ++i) {
        const float phi = 0.4f + 0.5f * pi * float(i);
        const vec3 at = vec3(2.9f + 0.45f * std::cos(phi), 0.741f, 2.7f + 0.45f * std::sin(phi));
        out.slot(0).lathe(at, plate, 96);
        out.slot(1).lathe(at + vec3(0.14f * std::cos(phi + 1), 0, 0.14f * std::sin(phi + 1)), cup,
                          64);
    }
    const vec2 bottle[] = {{0.04f, 0},      {0.042f, 0.01f}, {0.042f, 0.16f}, {0.03f, 0.2f},
                           {0.014f, 0.23f}, {0.014f, 0.28f}, {0, 0.281f}};
    for (int i = 0; i < 5; ++i)
        out.slot(i % 2 ? 1 : 2).lathe({2.5f + 0.11f * float(i), worktop, 0.14f}, bottle, 128);
    for (int i = 0; i < 6; ++i)
        out.slot(0).lathe({3.62f, worktop + 0.012f * float(i), 0.3f}, plate, 96);
    return out.take();
}

/// An engine and its waggon, driving towards +x. Slots: 0 paint, 1 chrome, 2 black.
Mesh train() {
    MeshBuilder out;
    const auto wheels = [&](float x) {
        for (const float z : {-0.055f, 0.055f}) {
            const vec3 axle[] = {{x, 0.03f, z - 0.008f}, {x, 0.03f, z + 0.008f}};
            out.slot(2).tube(axle, 0.03f, 48);
        }
    };
    out.slot(0).rounded_box({-0.12f, 0.035f, -0.05f}, {0.14f, 0.07f, 0.05f}, 0.008f, 4);
    const vec3 boiler[] = {{-0.04f, 0.11f, 0}, {0.12f, 0.11f, 0}};
    out.slot(1).tube(boiler, 0.042f, 64);
    out.ball({0.12f, 0.11f, 0}, 0.042f, 48);
    out.slot(0).rounded_box({-0.12f, 0.07f, -0.048f}, {-0.03f, 0.19f, 0.048f}, 0.008f, 4);
    const vec2 chimney[] = {{0.014f, 0}, {0.014f, 0.05f}, {0.022f, 0.07f}, {0, 0.07f}};
    out.slot(2).lathe({0.08f, 0.145f, 0}, chimney, 48);
    for (const float x : {-0.08f, 0.0f, 0.08f}) wheels(x);
    out.slot(0).rounded_box({-0.38f, 0.04f, -0.05f}, {-0.16f, 0.11f, 0.05f}, 0.008f, 4);
    out.slot(1).ball({-0.27f, 0.13f, 0}, 0.045f, 96);
    for (const float x : {-0.33f, -0.21f}) wheels(x);
    return out.take();
}

void add_train(SceneBundle& bundle, std::uint32_t object) {
    constexpr float radius = 1.55f;
    const vec3 middle(2.9f, 0, 2.7f);
    const Beat beat{.period = round_seconds, .times = 1, .keys = 120};
    Motion& motion = bundle.motion;
    const auto turn = [](float part) {
        return glm::angleAxis(-2 * pi * part - pi / 2, vec3(0, 1, 0));
    };
    const auto there = [&](float part) {
        return middle + radius * vec3(std::cos(2 * pi * part), 0, std::sin(2 * pi * part));
    };
    const mat4 place = glm::translate(mat4(1), there(0)) * glm::mat4_cast(turn(0));
    const std::uint32_t instance = add_instance(bundle, "train", object, place);
    carry(bundle, instance,
          add_node(motion, {.translation = there(0),
                            .rotation = turn(0),
                            .weights = {},
                            .translation_track = add_translations(motion, beat, there),
                            .rotation_track = add_rotations(motion, beat, turn)}));
}

}  // namespace

SceneBundle generate_kitchen() {
    SceneBundle bundle;
    const auto paint = [&](const char* name, const vec3& colour, float roughness = 1,
                           float specular = 0) {
        return add_material(
            bundle,
            {.name = name, .base_color = colour, .roughness = roughness, .specular = specular});
    };
    const auto metal = [&](const char* name, const vec3& colour, float roughness) {
        return add_material(
            bundle, {.name = name, .base_color = colour, .metallic = 1, .roughness = roughness});
    };
    const auto wall = paint("wall", {0.78f, 0.74f, 0.62f}), ceiling = paint("ceiling", vec3(0.85f)),
               light = paint("light tiles", vec3(0.75f), 0, 1),
               dark = paint("dark tiles", {0.05f, 0.06f, 0.08f}, 0, 1),
               front = paint("fronts", {0.16f, 0.32f, 0.36f}, 0.25f, 1),
               wood = paint("wood", {0.5f, 0.3f, 0.14f}, 0.35f, 1),
               stone = paint("worktop", {0.16f, 0.15f, 0.15f}, 0.1f, 1),
               white = paint("china", vec3(0.82f), 0.1f, 1),
               red = paint("red glaze", {0.6f, 0.06f, 0.04f}, 0.1f, 1),
               green = paint("green glaze", {0.06f, 0.35f, 0.1f}, 0.1f, 1),
               black = paint("black", vec3(0.03f), 0.4f, 1);
    const auto bright = metal("chrome", vec3(0.9f), 0), steel = metal("steel", vec3(0.75f), 0);
    add_instance(bundle, "room", add_object(bundle, "room", shell(), {wall, light, dark, ceiling}));
    add_instance(bundle, "furniture",
                 add_object(bundle, "furniture", furniture(), {front, bright, stone, wood, steel}));
    add_instance(bundle, "chrome", add_object(bundle, "chrome", chrome(), {bright}));
    add_instance(bundle, "crockery",
                 add_object(bundle, "crockery", crockery(), {white, red, green}));
    add_train(bundle, add_object(bundle, "train", train(), {red, bright, black}));
    for (int i = 0; i < 6; ++i)
        bundle.scene.lights.push_back(
            {.name = std::string("lamp ") + char('1' + i),
             .position = {0.9f + 1.7f * float(i % 3), room.y - 0.25f, i < 3 ? 1.3f : 3.3f},
             .intensity = {0.9f, 0.8f, 0.66f}});
    bundle.scene.cameras.push_back(
        {.name = "door", .eye = {4.75f, 1.62f, 4.15f}, .at = {2.35f, 0.88f, 1.2f}, .fov_y = 58});
    return bundle;
}

}  // namespace tessera
