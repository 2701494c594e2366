// A furnished office, after the scene of that name in Wald's thesis (2004: 34,000 triangles, three
// lights), whose file is not public: chairs, books, desks and lamps are instances of a few meshes.
// Sizes are in metres as one would measure them; the window wall is x = 0, the shelves stand at
// z = 0.

#include <algorithm>
#include <array>
#include <glm/gtc/matrix_transform.hpp>

#include "common/generators.h"
#include "common/mesh_builder.h"
#include "common/motion_builder.h"
#include "common/random_number.h"
#include "common/scene_builder.h"
#include "common/tone_map.h"

namespace tessera {
namespace {

constexpr vec3 room{6, 2.8f, 5};

/// Where in the world, turned by `degrees` around the vertical.
mat4 placed(const vec3& at, float degrees = 0) {
    return glm::rotate(glm::translate(mat4(1), at), glm::radians(degrees), vec3(0, 1, 0));
}

// Textures ------------------------------------------------------------------------------------

using Shader = vec3 (*)(const vec2& uv);  // linear colour at uv in [0, 1)

Texture painted(std::uint32_t width, std::uint32_t height, Shader shader) {
    Texture texture{.width = width, .height = height, .rgba = {}};
    texture.rgba.reserve(4 * std::size_t(width) * height);
    for (std::uint32_t y = 0; y < height; ++y)
        for (std::uint32_t x = 0; x < width; ++x) {
            const vec3 colour =
                shader({(float(x) + 0.5f) / float(width), (float(y) + 0.5f) / float(height)});
            for (int c = 0; c < 3; ++c)
                texture.rgba.push_back(
                    std::uint8_t(255 * srgb_from_linear(std::clamp(colour[c], 0.0f, 1.0f)) + 0.5f));
            texture.rgba.push_back(255);
        }
    return texture;
}

/// Oak strips: 12 to the tile, each cut into boards at its own offset.
vec3 parquet(const vec2& uv) {
    constexpr float strips = 12;
    constexpr float boards = 2;
    const float across = uv.x * strips;
    const auto strip = std::uint32_t(across);
    const float along = (uv.y + random_unit(strip)) * boards;
    const std::uint32_t board = strip * 64 + std::uint32_t(along) % std::uint32_t(boards);
    const float tone = random_between(board + 1000, 0.75f, 1.1f);
    const auto fibre = std::uint32_t(across * 9 + 3 * random_unit(board));
    const float grain =
        0.93f + 0.07f * random_unit(fibre * 131 + board + 7919 * std::uint32_t(along * 5));
    const float to_joint =
        std::min(std::min(across - float(strip), float(strip) + 1 - across) * 3,
                 std::min(along - std::floor(along), std::floor(along) + 1 - along) * 20);
    const float joint = to_joint < 0.09f ? 0.55f : 1;
    return vec3(0.44f, 0.27f, 0.135f) * (tone * grain * joint);
}

/// A painting: the sun low over three ranges of hills.
vec3 landscape(const vec2& uv) {
    vec3 colour = glm::mix(vec3(0.16f, 0.32f, 0.50f), vec3(0.95f, 0.55f, 0.25f), uv.y * 1.3f);
    if (length((uv - vec2(0.62f, 0.46f)) * vec2(1.5f, 1)) < 0.13f) colour = {1, 0.85f, 0.5f};
    const vec3 hills[] = {{0.45f, 0.26f, 0.26f}, {0.22f, 0.17f, 0.24f}, {0.06f, 0.09f, 0.12f}};
    for (int i = 0; i < 3; ++i) {
        const float phase = float(i) * 2.1f;
        const float ridge = 0.52f + 0.15f * float(i) + 0.07f * std::sin(uv.x * 7 + phase) +
                            0.03f * std::sin(uv.x * 17 + 3 * phase);
        if (uv.y > ridge) colour = hills[i];
    }
    return colour;
}

// Furniture: each function makes a mesh that stands at its origin and faces +z ------------------

/// Slots: 0 fabric, 1 plastic, 2 metal.
Mesh swivel_chair() {
    MeshBuilder b;
    b.slot(0).rounded_box({-0.25f, 0.44f, -0.24f}, {0.25f, 0.53f, 0.25f}, 0.043f, 3);
    // A back rest that is bent around the sitter.
    constexpr int columns = 15;
    constexpr int rows = 13;
    for (const float side : {-1.0f, 1.0f})
        b.grid(columns, rows, [&](int i, int j) {
            const float u = 2 * float(i) / (columns - 1) - 1;
            const float v = 2 * float(j) / (rows - 1) - 1;
            // A superellipse, so that the two faces meet in a round rim.
            const float rim = std::max(0.0f, 1 - u * u * u * u * u * u) *
                              std::max(0.0f, 1 - v * v * v * v * v * v);
            const float z = -0.27f + 0.07f * u * u - 0.05f * v + side * 0.03f * std::sqrt(rim);
            return MeshBuilder::Vertex{{0.23f * u, 0.86f + 0.25f * v, z},
                                       {-0.6f * u, 0.2f * v, side}};
        });
    b.slot(1).rounded_box({-0.035f, 0.40f, -0.34f}, {0.035f, 0.85f, -0.305f}, 0.012f, 1);
    b.rounded_box({-0.035f, 0.40f, -0.33f}, {0.035f, 0.435f, 0.1f}, 0.012f, 1);
    for (const float side : {-1.0f, 1.0f}) {
        const float x = side * 0.29f;
        const std::array<vec3, 5> arm{{{side * 0.2f, 0.425f, 0.02f},
                                       {x - side * 0.02f, 0.43f, 0.02f},
                                       {x, 0.46f, 0.02f},
                                       {x, 0.58f, 0.0f},
                                       {x, 0.68f, -0.02f}}};
        b.tube(arm, 0.014f, 8);
        b.rounded_box({x - 0.032f, 0.675f, -0.15f}, {x + 0.032f, 0.70f, 0.13f}, 0.012f, 2);
    }
    b.slot(2).cylinder({0, 0.08f, 0}, 0.028f, 0.33f, 20);
    for (int i = 0; i < 5; ++i) {
        const float angle = 2 * pi * float(i) / 5;
        const vec3 out{std::sin(angle), 0, std::cos(angle)};
        const std::array<vec3, 4> leg{{vec3(0, 0.115f, 0), out * 0.1f + vec3(0, 0.11f, 0),
                                       out * 0.22f + vec3(0, 0.09f, 0),
                                       out * 0.31f + vec3(0, 0.075f, 0)}};
        b.slot(2).tube(leg, 0.021f, 8);
        b.slot(1).ball(out * 0.305f + vec3(0, 0.031f, 0), 0.031f, 10);
    }
    return b.take();
}

/// Slots: 0 top, 1 legs, 2 drawers.
Mesh desk() {
    MeshBuilder b;
    b.slot(0).rounded_box({-0.8f, 0.71f, -0.4f}, {0.8f, 0.74f, 0.4f}, 0.008f, 2);
    b.slot(1);
    for (const float x : {-0.74f, 0.74f})
        for (const float z : {-0.34f, 0.34f}) b.cylinder({x, 0, z}, 0.025f, 0.712f, 16);
    b.box({-0.74f, 0.66f, -0.35f}, {0.74f, 0.71f, -0.33f});
    b.slot(2).box({0.25f, 0.12f, -0.3f}, {0.67f, 0.66f, 0.33f});
    for (int i = 0; i < 3; ++i) {
        const float y = 0.13f + 0.175f * float(i);
        b.slot(2).rounded_box({0.255f, y, 0.325f}, {0.665f, y + 0.165f, 0.345f}, 0.005f, 1);
        const std::array<vec3, 4> handle{{{0.40f, y + 0.12f, 0.34f},
                                          {0.405f, y + 0.12f, 0.37f},
                                          {0.515f, y + 0.12f, 0.37f},
                                          {0.52f, y + 0.12f, 0.34f}}};
        b.slot(1).tube(handle, 0.006f, 8);
    }
    return b.take();
}

/// Two bays of `shelf_heights`, 1.8 m wide, open to +z.
constexpr std::array<float, 5> shelf_heights{0.06f, 0.44f, 0.80f, 1.16f, 1.52f};
constexpr float bay_width = 0.87f;

Mesh bookcase() {
    MeshBuilder b;
    constexpr float top = 1.88f;
    for (const float x : {-0.9f, -0.01f, 0.88f}) b.box({x, 0, 0}, {x + 0.02f, top, 0.3f});
    for (const float bay : {-0.88f, 0.01f}) {
        for (const float y : shelf_heights)
            b.box({bay, y - 0.02f, 0.012f}, {bay + bay_width, y, 0.295f});
        b.box({bay, 0, 0}, {bay + bay_width, top, 0.012f});
    }
    b.rounded_box({-0.92f, top, -0.0f}, {0.92f, top + 0.03f, 0.315f}, 0.006f, 1);
    return b.take();
}

/// A closed book of unit size standing upright, its spine at z = 0 and the pages behind it.
/// Slots: 0 cover, 1 pages.
Mesh book() {
    MeshBuilder b;
    b.box({0, 0, -1}, {0.09f, 1, -0.04f});
    b.box({0.91f, 0, -1}, {1, 1, -0.04f});
    constexpr int steps = 6;
    b.grid(steps + 1, 2, [&](int i, int j) {
        const float angle = pi * float(i) / steps;
        return MeshBuilder::Vertex{
            {0.5f - 0.5f * std::cos(angle), float(j), -0.04f + 0.04f * std::sin(angle)},
            {-0.1f * std::cos(angle), 0, std::sin(angle)}};
    });
    b.slot(1).box({0.09f, 0.02f, -0.98f}, {0.91f, 0.97f, -0.04f});
    return b.take();
}

/// Slots: 0 casing, 1 screen.
Mesh monitor() {
    MeshBuilder b;
    b.rounded_box({-0.3f, 0.12f, -0.02f}, {0.3f, 0.49f, 0.015f}, 0.01f, 1);
    b.rounded_box({-0.12f, 0, -0.11f}, {0.12f, 0.014f, 0.09f}, 0.006f, 1);
    b.rounded_box({-0.03f, 0.01f, -0.06f}, {0.03f, 0.3f, -0.02f}, 0.01f, 1);
    b.slot(1).quad({-0.287f, 0.135f, 0.0155f}, {0.287f, 0.135f, 0.0155f}, {0.287f, 0.477f, 0.0155f},
                   {-0.287f, 0.477f, 0.0155f});
    return b.take();
}

/// Slots: 0 body, 1 keys.
Mesh keyboard() {
    MeshBuilder b;
    b.rounded_box({-0.2f, 0, -0.07f}, {0.2f, 0.015f, 0.07f}, 0.005f, 1);
    b.slot(1);
    for (int row = 0; row < 4; ++row)
        for (int column = 0; column < 15; ++column) {
            const vec3 lo{-0.187f + 0.025f * float(column), 0.0145f, -0.058f + 0.025f * float(row)};
            b.box(lo, lo + vec3(0.021f, 0.007f, 0.021f));
        }
    b.box({-0.09f, 0.0145f, 0.042f}, {0.09f, 0.0215f, 0.062f});
    return b.take();
}

Mesh mouse() {
    MeshBuilder b;
    b.rounded_box({-0.03f, 0, -0.05f}, {0.03f, 0.032f, 0.05f}, 0.0155f, 2);
    return b.take();
}

/// Slots: 0 outside, 1 coffee.
Mesh cup() {
    constexpr std::array<vec2, 9> profile{{{0, 0},
                                           {0.028f, 0},
                                           {0.034f, 0.008f},
                                           {0.037f, 0.045f},
                                           {0.040f, 0.09f},
                                           {0.0385f, 0.093f},
                                           {0.037f, 0.09f},
                                           {0.034f, 0.045f},
                                           {0.032f, 0.02f}}};
    MeshBuilder b;
    b.lathe(vec3(0), profile, 24);
    std::array<vec3, 9> handle;
    for (int i = 0; i < 9; ++i) {
        const float angle = pi * (float(i) / 8 - 0.5f);
        handle[i] = {0.036f + 0.026f * std::cos(angle), 0.048f + 0.026f * std::sin(angle), 0};
    }
    b.tube(handle, 0.0055f, 8);
    constexpr std::array<vec2, 2> coffee{{{0.036f, 0.075f}, {0, 0.075f}}};
    b.slot(1).lathe(vec3(0), coffee, 24);
    return b.take();
}

/// A desk lamp whose head hangs over +z. Slots: 0 body, 1 bulb.
constexpr vec3 lamp_head{0, 0.40f, 0.26f};

Mesh desk_lamp() {
    MeshBuilder b;
    constexpr std::array<vec2, 6> foot{
        {{0, 0}, {0.085f, 0}, {0.085f, 0.012f}, {0.075f, 0.022f}, {0.02f, 0.03f}, {0, 0.03f}}};
    b.lathe(vec3(0), foot, 28);
    std::array<vec3, 14> arm;
    for (int i = 0; i < 14; ++i) {
        const float angle = pi * 0.8f * float(i) / 13;
        arm[i] = {0, 0.02f + 0.30f * float(i) / 13 + 0.165f * std::sin(angle),
                  0.13f * (1 - std::cos(angle))};
    }
    b.tube(arm, 0.009f, 10);
    constexpr std::array<vec2, 7> shade{{{0.094f, -0.062f},
                                         {0.096f, -0.060f},
                                         {0.078f, -0.01f},
                                         {0.045f, 0.03f},
                                         {0.02f, 0.04f},
                                         {0.02f, 0.06f},
                                         {0, 0.065f}}};
    b.lathe(lamp_head, shade, 28);
    constexpr std::array<vec2, 4> inside{
        {{0, 0.033f}, {0.04f, 0.025f}, {0.074f, -0.012f}, {0.094f, -0.062f}}};
    b.lathe(lamp_head, inside, 28);
    b.slot(1).ball(lamp_head + vec3(0, -0.022f, 0), 0.032f, 14);
    return b.take();
}

Mesh waste_basket() {
    constexpr std::array<vec2, 6> profile{
        {{0, 0}, {0.11f, 0}, {0.14f, 0.3f}, {0.136f, 0.303f}, {0.132f, 0.3f}, {0.105f, 0.01f}}};
    MeshBuilder b;
    b.lathe(vec3(0), profile, 28);
    return b.take();
}

/// Slots: 0 pot, 1 soil.
Mesh plant_pot() {
    constexpr std::array<vec2, 9> profile{{{0, 0},
                                           {0.12f, 0},
                                           {0.13f, 0.01f},
                                           {0.17f, 0.26f},
                                           {0.185f, 0.27f},
                                           {0.185f, 0.31f},
                                           {0.175f, 0.313f},
                                           {0.168f, 0.31f},
                                           {0.165f, 0.26f}}};
    constexpr std::array<vec2, 2> soil{{{0.168f, 0.28f}, {0, 0.29f}}};
    MeshBuilder b;
    b.lathe(vec3(0), profile, 32);
    b.slot(1).lathe(vec3(0), soil, 32);
    return b.take();
}

/// A long leaf that rises from its origin and bends over towards +z; both sides are modelled, as
/// our surfaces have no thickness. Unit length.
Mesh leaf() {
    constexpr int steps = 9;
    MeshBuilder b;
    for (const float side : {1.0f, -1.0f})
        b.grid(3, steps, [&](int i, int j) {
            const float t = float(j) / (steps - 1);
            const float width =
                0.012f + 0.11f * std::sin(pi * std::min(1.0f, 0.08f + 0.92f * t)) * (1 - 0.45f * t);
            const float x = float(i - 1);
            const vec3 spine{0, std::sin(1.9f * t) * 0.75f, 0.62f * t * t};
            const vec3 fold{0, 0.25f * width * x * x, 0};
            const vec3 up{0.35f * -x, 1 - t, -1.2f * (1 - t) - 0.1f};
            const float tip = j + 1 == steps ? 0.0f : width;
            // The under side lies a hair lower, so that no ray meets both at once.
            const vec3 under{0, side > 0 ? 0.0f : -0.002f, 0};
            return MeshBuilder::Vertex{spine + fold + under + vec3(x * tip, 0, 0),
                                       side * vec3(up.x, std::max(up.y, 0.2f), up.z * 0.5f)};
        });
    return b.take();
}

Mesh radiator() {
    MeshBuilder b;
    for (int i = 0; i < 11; ++i) {
        const float z = -0.5f + 0.1f * float(i);
        b.rounded_box({0.03f, 0.12f, z - 0.04f}, {0.11f, 0.66f, z + 0.04f}, 0.018f, 1);
    }
    for (const float y : {0.2f, 0.58f}) b.box({0.05f, y, -0.5f}, {0.09f, y + 0.04f, 0.5f});
    return b.take();
}

/// A frame around the rectangle [-width/2, width/2] x [0, height] at z = 0. Slots: 0 frame, 1 what
/// it holds.
Mesh framed(float width, float height) {
    constexpr float rim = 0.035f;
    const float x = width / 2;
    MeshBuilder b;
    b.rounded_box({-x - rim, -rim, 0}, {x + rim, 0, 0.03f}, 0.006f, 1);
    b.rounded_box({-x - rim, height, 0}, {x + rim, height + rim, 0.03f}, 0.006f, 1);
    b.rounded_box({-x - rim, -rim, 0}, {-x, height + rim, 0.03f}, 0.006f, 1);
    b.rounded_box({x, -rim, 0}, {x + rim, height + rim, 0.03f}, 0.006f, 1);
    b.slot(1).quad({-x, 0, 0.012f}, {x, 0, 0.012f}, {x, height, 0.012f}, {-x, height, 0.012f});
    return b.take_textured();
}

/// Slots: 0 rim, 1 face, 2 hands.
Mesh wall_clock() {
    MeshBuilder b;
    std::vector<vec3> circle;
    for (int i = 0; i < 32; ++i) {
        const float angle = 2 * pi * float(i) / 32;
        circle.push_back({0.15f * std::cos(angle), 0.15f * std::sin(angle), 0.015f});
    }
    b.tube(circle, 0.014f, 8, true);
    b.slot(1).grid(33, 2, [&](int i, int j) {
        const vec3 p = circle[i % 32] * float(j);
        return MeshBuilder::Vertex{{p.x, p.y, 0.015f}, {0, 0, 1}};
    });
    b.slot(2).box({-0.006f, -0.02f, 0.018f}, {0.006f, 0.085f, 0.022f});
    b.box({-0.02f, -0.005f, 0.018f}, {0.115f, 0.005f, 0.022f});
    return b.take();
}

/// Slots: 0 frame, 1 the panel that shines down.
Mesh ceiling_panel() {
    constexpr float x = 0.6f;
    constexpr float z = 0.3f;
    MeshBuilder b;
    b.box({-x - 0.03f, -0.05f, -z - 0.03f}, {x + 0.03f, 0, -z});
    b.box({-x - 0.03f, -0.05f, z}, {x + 0.03f, 0, z + 0.03f});
    b.box({-x - 0.03f, -0.05f, -z}, {-x, 0, z});
    b.box({x, -0.05f, -z}, {x + 0.03f, 0, z});
    b.slot(1).quad({-x, -0.035f, -z}, {x, -0.035f, -z}, {x, -0.035f, z}, {-x, -0.035f, z});
    return b.take();
}

/// Slots: 0 leaf and frame, 1 handle.
Mesh door() {
    MeshBuilder b;
    b.box({-0.5f, 0, 0}, {-0.44f, 2.1f, 0.05f});
    b.box({0.44f, 0, 0}, {0.5f, 2.1f, 0.05f});
    b.box({-0.5f, 2.1f, 0}, {0.5f, 2.16f, 0.05f});
    b.box({-0.44f, 0, 0}, {0.44f, 2.1f, 0.02f});
    for (const float y : {0.2f, 1.15f})
        b.rounded_box({-0.32f, y, 0.015f}, {0.32f, y + 0.75f, 0.03f}, 0.006f, 1);
    const std::array<vec3, 4> handle{{{-0.36f, 1.02f, 0.02f},
                                      {-0.36f, 1.02f, 0.06f},
                                      {-0.35f, 1.02f, 0.07f},
                                      {-0.25f, 1.02f, 0.07f}}};
    b.slot(1).tube(handle, 0.009f, 10);
    return b.take();
}

// The room -------------------------------------------------------------------------------------

struct Window {
    float z0, z1;
    float y0 = 0.9f, y1 = 2.35f;
};
constexpr std::array<Window, 2> windows{{{0.75f, 1.95f}, {2.65f, 3.85f}}};
constexpr float reveal = 0.22f;

/// A rectangle of the window wall, facing into the room.
void wall_piece(MeshBuilder& b, float z0, float z1, float y0, float y1) {
    b.quad({0, y0, z1}, {0, y0, z0}, {0, y1, z0}, {0, y1, z1});
}

void window_wall(MeshBuilder& b) {
    float z = 0;
    for (const Window& w : windows) {
        wall_piece(b, z, w.z0, 0, room.y);
        wall_piece(b, w.z0, w.z1, 0, w.y0);
        wall_piece(b, w.z0, w.z1, w.y1, room.y);
        z = w.z1;
        // The reveal: sill, lintel and the two sides of the opening.
        b.quad({-reveal, w.y0, w.z1}, {0, w.y0, w.z1}, {0, w.y0, w.z0}, {-reveal, w.y0, w.z0});
        b.quad({-reveal, w.y1, w.z0}, {0, w.y1, w.z0}, {0, w.y1, w.z1}, {-reveal, w.y1, w.z1});
        b.quad({-reveal, w.y0, w.z0}, {0, w.y0, w.z0}, {0, w.y1, w.z0}, {-reveal, w.y1, w.z0});
        b.quad({0, w.y0, w.z1}, {-reveal, w.y0, w.z1}, {-reveal, w.y1, w.z1}, {0, w.y1, w.z1});
    }
    wall_piece(b, z, room.z, 0, room.y);
}

/// Slots: 0 plaster, 1 the coloured wall, 2 ceiling, 3 skirting and sills.
Mesh walls() {
    MeshBuilder b;
    window_wall(b);
    b.quad({room.x, 0, 0}, {room.x, 0, room.z}, {room.x, room.y, room.z}, {room.x, room.y, 0});
    b.quad({room.x, 0, room.z}, {0, 0, room.z}, {0, room.y, room.z}, {room.x, room.y, room.z});
    b.slot(1).quad({0, 0, 0}, {room.x, 0, 0}, {room.x, room.y, 0}, {0, room.y, 0});
    b.slot(2).quad({0, room.y, 0}, {room.x, room.y, 0}, {room.x, room.y, room.z},
                   {0, room.y, room.z});
    constexpr float high = 0.09f;
    constexpr float thick = 0.015f;
    b.slot(3).box({0, 0, 0}, {thick, high, room.z});
    b.box({room.x - thick, 0, 0}, {room.x, high, room.z});
    b.box({thick, 0, 0}, {room.x - thick, high, thick});
    b.box({thick, 0, room.z - thick}, {room.x - thick, high, room.z});
    for (const Window& w : windows)
        b.rounded_box({-reveal + 0.02f, w.y0 - 0.01f, w.z0 - 0.04f},
                      {0.05f, w.y0 + 0.02f, w.z1 + 0.04f}, 0.008f, 1);
    return b.take();
}

Mesh floor_boards() {
    MeshBuilder b;
    b.quad({0, 0, room.z}, {room.x, 0, room.z}, {room.x, 0, 0}, {0, 0, 0});
    return b.take_textured();
}

/// Casement and sky of one window. Slots: 0 casement, 1 sky.
Mesh window_pane(const Window& w) {
    constexpr float x0 = -0.17f;
    constexpr float x1 = -0.12f;
    constexpr float bar = 0.05f;
    const float middle = (w.z0 + w.z1) / 2;
    MeshBuilder b;
    b.box({x0, w.y0, w.z0}, {x1, w.y0 + bar, w.z1});
    b.box({x0, w.y1 - bar, w.z0}, {x1, w.y1, w.z1});
    for (const float z : {w.z0, middle - bar / 2, w.z1 - bar})
        b.box({x0, w.y0 + bar, z}, {x1, w.y1 - bar, z + bar});
    b.slot(1).quad({-reveal, w.y0, w.z1}, {-reveal, w.y0, w.z0}, {-reveal, w.y1, w.z0},
                   {-reveal, w.y1, w.z1});
    return b.take();
}

// Putting it together ---------------------------------------------------------------------------

/// The office as it is furnished: the palette, then room by room what stands where.
class Office {
public:
    SceneBundle make() {
        build_room();
        build_lights();
        furnish_desks();
        furnish_wall();
        fill_bookcase();
        put_plant({4.7f, 0, 0.85f});
        add_camera();
        add_motion();
        return std::move(bundle_);
    }

private:
    std::uint32_t paint(const char* name, const vec3& colour) {
        return add_material(bundle_, {.name = name, .base_color = colour});
    }
    std::uint32_t metal(const char* name, const vec3& colour, float roughness) {
        return add_material(
            bundle_, {.name = name, .base_color = colour, .metallic = 1, .roughness = roughness});
    }
    std::uint32_t glow(const char* name, const vec3& radiance) {
        return add_material(bundle_, {.name = name, .base_color = vec3(0), .emission = radiance});
    }
    std::uint32_t textured(const char* name, const Texture& texture, const vec2& repeats) {
        return add_material(
            bundle_, {.name = name,
                      .base_color = vec3(1),
                      .base_color_map = {.texture = std::int32_t(add_texture(bundle_, texture)),
                                         .scale = repeats}});
    }
    std::uint32_t object(const char* name, const Mesh& mesh, std::vector<std::uint32_t> materials) {
        return add_object(bundle_, name, mesh, std::move(materials));
    }
    void place(const char* name, std::uint32_t object_index, const mat4& world_from_object) {
        add_instance(bundle_, name, object_index, world_from_object);
    }

    void build_room();
    void build_lights();
    void furnish_desks();
    void furnish_wall();
    void fill_bookcase();
    void fill_shelf(float left, float y, std::uint32_t seed);
    void put_plant(const vec3& at);
    void add_camera();
    void add_motion();
    void turn_around(const char* name, const vec3& pivot, std::int32_t rotations,
                     std::int32_t translations);

    SceneBundle bundle_;
    const std::uint32_t white_ = paint("white", {0.80f, 0.79f, 0.76f});
    const std::uint32_t black_ = paint("black plastic", {0.035f, 0.035f, 0.04f});
    const std::uint32_t grey_ = paint("grey", {0.45f, 0.46f, 0.48f});
    const std::uint32_t oak_ = paint("oak", {0.56f, 0.37f, 0.20f});
    const std::uint32_t steel_ = metal("brushed steel", {0.60f, 0.60f, 0.62f}, 0.35f);
    const std::uint32_t mirror_ = metal("mirror", {0.93f, 0.94f, 0.94f}, 0);
    const std::uint32_t cream_ = paint("paper", {0.82f, 0.78f, 0.66f});
    const std::uint32_t orange_ = paint("orange", {0.72f, 0.24f, 0.06f});
    std::vector<std::uint32_t> book_objects_;
};

void Office::build_room() {
    const auto plaster = paint("plaster", {0.80f, 0.77f, 0.71f});
    const auto teal = paint("teal wall", {0.20f, 0.40f, 0.42f});
    const auto ceiling = paint("ceiling", {0.86f, 0.86f, 0.84f});
    const auto parquet_floor =
        textured("parquet", painted(384, 384, parquet), vec2(room.x, room.z) / 1.5f);
    place("walls", object("walls", walls(), {plaster, teal, ceiling, white_}), mat4(1));
    place("floor", object("floor", floor_boards(), {parquet_floor}), mat4(1));
    MeshBuilder rug;
    rug.rounded_box({0.75f, 0, 1.1f}, {3.15f, 0.012f, 3.95f}, 0.005f, 1);
    place("rug", object("rug", rug.take(), {paint("rug", {0.42f, 0.43f, 0.50f})}), mat4(1));
    place("door", object("door", door(), {oak_, steel_}), placed({4.6f, 0, room.z}, 180));
    const auto heater = object("radiator", radiator(), {white_});
    for (const Window& w : windows) place("radiator", heater, placed({0, 0, (w.z0 + w.z1) / 2}));
}

void Office::build_lights() {
    const auto sky = glow("sky", {2.7f, 3.3f, 4.2f});
    const auto panel =
        object("ceiling panel", ceiling_panel(), {white_, glow("warm light", {9.5f, 8.5f, 7.0f})});
    for (const Window& w : windows)
        place("window", object("window", window_pane(w), {white_, sky}), mat4(1));
    place("ceiling panel", panel, placed({1.8f, room.y, 2.4f}));
    place("ceiling panel", panel, placed({4.2f, room.y, 2.4f}));
}

void Office::furnish_desks() {
    const auto desk_object = object("desk", desk(), {oak_, steel_, white_});
    const Mesh chair = swivel_chair();
    const auto orange_chair = object("orange chair", chair, {orange_, black_, steel_});
    const auto blue_chair =
        object("blue chair", chair, {paint("blue", {0.08f, 0.16f, 0.36f}), black_, steel_});
    const auto screen =
        object("monitor", monitor(), {black_, paint("screen", {0.03f, 0.04f, 0.06f})});
    const auto keys = object("keyboard", keyboard(), {grey_, black_});
    const auto mouse_object = object("mouse", mouse(), {grey_});
    const auto coffee = paint("coffee", {0.07f, 0.03f, 0.015f});
    const Mesh cup_mesh = cup();
    const auto white_cup = object("white cup", cup_mesh, {white_, coffee});
    const auto red_cup = object("red cup", cup_mesh, {paint("red", {0.60f, 0.05f, 0.04f}), coffee});
    const Mesh lamp_mesh = desk_lamp();
    const auto lamp_on = object("lit lamp", lamp_mesh, {orange_, glow("bulb", {60, 46, 28})});
    const auto lamp_off = object("lamp", lamp_mesh, {steel_, white_});

    // Each workplace is laid out in the space of its desk, whose user sits at +z.
    struct Workplace {
        mat4 world_from_desk;
        std::uint32_t chair, cup, lamp;
        float chair_turn;  // degrees
    };
    const Workplace workplaces[] = {
        {placed({1.9f, 0, 2.95f}), orange_chair, red_cup, lamp_off, 205},
        {placed({1.9f, 0, 2.12f}, 180), blue_chair, white_cup, lamp_off, 170},
        {placed({3.35f, 0, 0.45f}), orange_chair, white_cup, lamp_on, 150},
    };
    for (const Workplace& w : workplaces) {
        const auto put = [&](const char* name, std::uint32_t what, const vec3& at, float turn) {
            place(name, what, w.world_from_desk * placed(at, turn));
        };
        constexpr float top = 0.74f;
        put("desk", desk_object, vec3(0), 0);
        put("chair", w.chair, {-0.1f, 0, 0.72f}, w.chair_turn);
        put("monitor", screen, {-0.12f, top, -0.22f}, 4);
        put("keyboard", keys, {-0.12f, top, 0.16f}, 0);
        put("mouse", mouse_object, {0.18f, top, 0.17f}, -12);
        put("cup", w.cup, {0.42f, top, 0.12f}, 40);
        put(w.lamp == lamp_on ? "lit lamp" : "lamp", w.lamp, {0.62f, top, -0.26f}, -35);
    }
    MeshBuilder ball;
    ball.ball({0, 0.07f, 0}, 0.07f, 32);
    place("mirror ball", object("mirror ball", ball.take(), {mirror_}),
          placed({2.52f, 0.74f, 2.72f}));
    place("waste basket", object("waste basket", waste_basket(), {grey_}), placed({3.1f, 0, 3.0f}));
}

void Office::furnish_wall() {
    const auto picture = textured("landscape", painted(192, 128, landscape), {1, 1});
    place("picture", object("picture", framed(0.9f, 0.6f), {black_, picture}),
          placed({2.75f, 1.42f, 0.002f}));
    place("mirror", object("mirror", framed(0.62f, 0.95f), {oak_, mirror_}),
          placed({3.78f, 1.22f, 0.002f}));
    place("clock", object("clock", wall_clock(), {black_, white_, orange_}),
          placed({0.002f, 1.9f, 2.3f}, 90));
}

/// One shelf of one bay: books of every size, until a gap is left at the right.
void Office::fill_shelf(float left, float y, std::uint32_t seed) {
    const float end = left + bay_width - random_between(seed, 0.02f, 0.25f);
    float x = left + 0.005f;
    for (std::uint32_t i = seed * 100; x < end - 0.05f; ++i) {
        const vec3 size{random_between(8 * i, 0.022f, 0.05f),
                        random_between(8 * i + 1, 0.20f, 0.29f),
                        random_between(8 * i + 2, 0.15f, 0.21f)};
        const auto colour = std::size_t(random_unit(8 * i + 3) * float(book_objects_.size()));
        const float front = 0.27f - random_between(8 * i + 4, 0, 0.02f);
        place("book", book_objects_[colour], glm::scale(placed({x, y, front}), size));
        x += size.x + 0.0015f;
    }
}

void Office::fill_bookcase() {
    constexpr float at_x = 1.2f;
    place("bookcase", object("bookcase", bookcase(), {white_}), placed({at_x, 0, 0.016f}));
    const Mesh book_mesh = book();
    const vec3 colours[] = {{0.50f, 0.08f, 0.06f}, {0.08f, 0.22f, 0.38f}, {0.10f, 0.30f, 0.16f},
                            {0.65f, 0.46f, 0.12f}, {0.20f, 0.10f, 0.22f}, {0.62f, 0.58f, 0.50f},
                            {0.06f, 0.07f, 0.09f}, {0.58f, 0.24f, 0.09f}};
    for (const vec3& colour : colours)
        book_objects_.push_back(object("book", book_mesh, {paint("cloth", colour), cream_}));
    // Every other bay of the upper shelves is left to a bowl.
    MeshBuilder bowl;
    constexpr std::array<vec2, 7> profile{{{0, 0},
                                           {0.05f, 0},
                                           {0.11f, 0.06f},
                                           {0.125f, 0.11f},
                                           {0.12f, 0.112f},
                                           {0.10f, 0.06f},
                                           {0, 0.012f}}};
    bowl.lathe(vec3(0), profile, 28);
    const auto bowl_object =
        object("bowl", bowl.take(), {paint("turquoise", {0.10f, 0.45f, 0.45f})});
    for (std::uint32_t shelf = 0; shelf < shelf_heights.size(); ++shelf)
        for (std::uint32_t bay = 0; bay < 2; ++bay) {
            const float left = at_x + (bay == 0 ? -0.88f : 0.01f);
            const float y = shelf_heights[shelf];
            if (shelf == 3 + bay)
                place("bowl", bowl_object, placed({left + bay_width / 2, y, 0.16f}));
            else
                fill_shelf(left, y, 1 + shelf * 2 + bay);
        }
    // Three books lie on the desk by the wall.
    for (std::uint32_t i = 0; i < 3; ++i) {
        mat4 lying = placed({2.68f, 0.74f + 0.035f * float(i + 1), 0.35f}, 60 + 25 * float(i));
        lying = glm::rotate(lying, -pi / 2, vec3(0, 0, 1));
        place(i == 2 ? "top book" : "book", book_objects_[i + 1],
              glm::scale(lying, vec3(0.035f, 0.24f, 0.17f)));
    }
}

void Office::put_plant(const vec3& at) {
    place(
        "pot",
        object("pot", plant_pot(),
               {paint("terracotta", {0.55f, 0.22f, 0.12f}), paint("soil", {0.06f, 0.04f, 0.03f})}),
        placed(at));
    const auto leaf_object = object("leaf", leaf(), {paint("leaf", {0.10f, 0.32f, 0.07f})});
    for (std::uint32_t i = 0; i < 34; ++i) {
        const float length = random_between(i + 500, 0.55f, 1.05f);
        const float turn = 137.5f * float(i);  // degrees: the golden angle of phyllotaxis
        const vec3 root = at + vec3(0, 0.27f, 0);
        mat4 m = placed(root, turn) * glm::translate(mat4(1), vec3(0, 0, 0.02f));
        m = glm::rotate(m, random_between(i + 600, -0.15f, 0.35f), vec3(1, 0, 0));
        place("leaf", leaf_object, glm::scale(m, vec3(length)));
    }
}

void Office::add_camera() {
    bundle_.scene.cameras.push_back(
        {.name = "door", .eye = {5.55f, 1.55f, 4.55f}, .at = {2.2f, 0.92f, 1.3f}, .fov_y = 48});
}

/// Lets the thing of that name turn around `pivot`, which moves by the translations.
void Office::turn_around(const char* name, const vec3& pivot, std::int32_t rotations,
                         std::int32_t translations) {
    Motion& motion = bundle_.motion;
    MotionNode turning{.weights = {}};
    turning.rotation_track = rotations;
    turning.translation_track = translations;
    MotionNode back{.parent = std::int32_t(add_node(motion, std::move(turning))), .weights = {}};
    back.translation = -pivot;
    const std::uint32_t node = add_node(motion, std::move(back));
    const auto& instances = bundle_.scene.instances;
    const auto instance = std::ranges::find(instances, name, &Instance::name);
    carry(bundle_, std::uint32_t(instance - instances.begin()), node);
}

/// As in the thesis, the desk lamp and a book move: the lamp to and fro, the book up and around.
void Office::add_motion() {
    const Beat beat{.period = 6, .times = 1, .keys = 48};
    const vec3 lamp(3.97f, 0.74f, 0.19f), book(2.68f, 0.845f, 0.35f), up(0, 1, 0);
    const auto rise = [](float part) { return 0.5f - 0.5f * std::cos(2 * pi * part); };
    turn_around("lit lamp", lamp,
                add_rotations(bundle_.motion, beat,
                              [&](float part) { return glm::angleAxis(0.9f * rise(part), up); }),
                add_translations(bundle_.motion, beat, [&](float part) {
                    return lamp + rise(part) * vec3(-0.18f, 0, 0.12f);
                }));
    turn_around("top book", book,
                add_rotations(bundle_.motion, beat,
                              [&](float part) { return glm::angleAxis(2 * pi * part, up); }),
                add_translations(bundle_.motion, beat, [&](float part) {
                    return book + rise(part) * vec3(0, 0.45f, 0.1f);
                }));
}

}  // namespace

SceneBundle generate_office() { return Office().make(); }

}  // namespace tessera
