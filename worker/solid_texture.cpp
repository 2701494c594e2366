#include "worker/solid_texture.h"

#include <array>

#include "worker/sampling.h"

namespace tessera {
namespace {

vec3 vec(const float (&v)[3]) { return {v[0], v[1], v[2]}; }
void put(const vec3& v, float (&out)[3]) {
    for (int c = 0; c < 3; ++c) out[c] = v[c];
}

/// The cell that x lies in, and where in there. Far away floats have no fraction left.
struct Cell {
    std::uint32_t index;
    float part;

    explicit Cell(float x) {
        constexpr float limit = 0x1p30f;
        const float low = std::floor(std::clamp(x, -limit, limit));
        index = std::uint32_t(std::int32_t(low));
        part = std::clamp(x - low, 0.0f, 1.0f);
    }
};

/// Perlin's weight of the far corner, and how it grows.
vec2 fade(float t) { return {t * t * t * (t * (t * 6 - 15) + 10), 30 * t * t * (t * (t - 2) + 1)}; }

/// How much of something of that period can be drawn for a pixel of that width.
float drawable(float width, float period) { return std::clamp(2 - 4 * width / period, 0.0f, 1.0f); }

/// noise() of period `period`, as far as the pixel's width lets see it.
Slope filtered_noise(const vec3& p, float period, float width) {
    const float share = drawable(width, period);
    if (share == 0) return {};
    const Slope s = noise(p / period);
    return {share * s.value, s.gradient * (share / period)};
}

/// Noise of several octaves, each half as strong as that of twice its period.
Slope turbulence(const vec3& p, float period, int octaves, float width) {
    Slope sum;
    float strength = 1;
    for (int i = 0; i < octaves; ++i) {
        // Shifted, so that the octaves' lattices do not meet.
        const Slope s = filtered_noise(p + float(i) * 7.31f * period, period, width);
        sum.value += strength * s.value;
        sum.gradient += strength * s.gradient;
        strength *= 0.5f;
        period *= 0.5f;
    }
    return sum;
}

/// A wave along a function of the place.
Slope along(const Wave& wave, const Slope& x, float width) {
    const float slope = std::sqrt(dot(x.gradient, x.gradient));
    const vec2 mean = wave.mean(x.value, width * slope);
    return {mean.x, mean.y * x.gradient};
}

/// Sets colour and slope: `t` of the way from the material's own colour to `other`.
void paint(const Slope& t, const vec3& other, float bump, tessera_shading& point) {
    put(glm::mix(vec(point.base_color), other, t.value), point.base_color);
    put(bump * t.gradient, point.slope);
}

// ---- wood ---------------------------------------------------------------------------------------

enum WoodParameter { wood_color, wood_ring, wood_wobble, wood_grain, wood_bump };

constexpr tessera_shader_parameter wood_parameters[] = {
    {"color", {0.28f, 0.13f, 0.05f}},       // of late wood, dark
    {"ring", {0.02f, 0.02f, 0.02f}},        // width of a year's ring
    {"wobble", {1.5f, 1.5f, 1.5f}},         // how far rings stray, in rings
    {"grain", {0.3f, 0.3f, 0.3f}},          // share of the pores in the contrast, 0 to 1
    {"bump", {0.0002f, 0.0002f, 0.0002f}},  // height between early and late wood
};

/// The trunk lies along x, a little askew and below the object's origin.
void shade_wood(const float (*v)[3], tessera_shading* point) {
    const float ring = std::max(v[wood_ring][0], 1e-6f);
    const float grain = std::clamp(v[wood_grain][0], 0.0f, 1.0f);
    const vec3 p = vec(point->position);
    const float width = point->footprint;

    // Rings: distance from the trunk's middle, which strays slowly along it.
    constexpr float askew = 0.04f;
    const vec2 off(p.y + askew * p.x + 9.3f * ring, p.z + 2.7f * ring);
    const float radius = std::sqrt(dot(off, off));
    const vec2 out = radius > 0 ? off / radius : vec2(0);
    const Slope stray = filtered_noise(vec3(0.15f * p.x, p.y, p.z), 6 * ring, width);
    const float wobble = v[wood_wobble][0];
    const Slope rings{
        radius / ring + wobble * stray.value,
        vec3(askew * out.x, out.x, out.y) / ring + wobble * stray.gradient * vec3(0.15f, 1, 1)};
    Slope t = along(Wave{0.8f}, rings, width);

    // Pores: long threads.
    const float thread = 0.12f * ring;
    const Slope pores = filtered_noise(vec3(0.03f * p.x, p.y, p.z), thread, width);
    t.value = (1 - grain) * t.value + grain * (0.5f + 0.5f * pores.value);
    t.gradient = (1 - grain) * t.gradient + 0.5f * grain * pores.gradient * vec3(0.03f, 1, 1);
    paint(t, vec(v[wood_color]), v[wood_bump][0], *point);
}

// ---- marble -------------------------------------------------------------------------------------

enum MarbleParameter { marble_color, marble_vein, marble_turbulence, marble_bump };

constexpr tessera_shader_parameter marble_parameters[] = {
    {"color", {0.16f, 0.15f, 0.19f}},    // of the veins
    {"vein", {0.25f, 0.25f, 0.25f}},     // distance between veins
    {"turbulence", {1.2f, 1.2f, 1.2f}},  // how far veins stray, in distances between them
    {"bump", {0, 0, 0}},                 // height of the veins; marble is polished
};

void shade_marble(const float (*v)[3], tessera_shading* point) {
    const float vein = std::max(v[marble_vein][0], 1e-6f);
    const vec3 p = vec(point->position);
    const float width = point->footprint;
    const vec3 across(0.68f, 0.59f, 0.43f);
    const Slope stray = turbulence(p, 2 * vein, 5, width);
    const float strength = v[marble_turbulence][0];
    const Slope layers{dot(across, p) / vein + strength * stray.value,
                       across / vein + strength * stray.gradient};
    // Thin veins with broad halos.
    const Slope halo = along(Wave{0.5f}, layers, width);
    const Slope thin = along(Wave{0.9f}, {2 * layers.value + 0.3f, 2.0f * layers.gradient}, width);
    const Slope t{0.35f * halo.value + 0.45f * thin.value,
                  0.35f * halo.gradient + 0.45f * thin.gradient};
    paint(t, vec(v[marble_color]), v[marble_bump][0], *point);
}

// ---- brick --------------------------------------------------------------------------------------

enum BrickParameter {
    brick_color,
    brick_length,
    brick_height,
    brick_joint,
    brick_varied,
    brick_bump
};

constexpr tessera_shader_parameter brick_parameters[] = {
    {"color", {0.55f, 0.52f, 0.47f}},      // of the mortar
    {"length", {0.25f, 0.25f, 0.25f}},     // from brick to brick
    {"height", {0.075f, 0.075f, 0.075f}},  // from row to row
    {"joint", {0.012f, 0.012f, 0.012f}},   // width of the mortar
    {"varied", {0.35f, 0.35f, 0.35f}},     // how much bricks differ in colour, 0 to 1
    {"bump", {0.004f, 0.004f, 0.004f}},    // depth of the mortar
};

/// Share of the `width` around x that lies on a brick rather than in a joint: 0 to `joint` of each
/// `period`. The slope is that of the ramp between them, half a joint wide at each side.
vec2 pulse(float x, float width, float period, float joint) {
    const auto integral = [&](float at) {
        const float whole = std::floor(at / period);
        const float part = at - whole * period;
        const float ramp = 0.5f * joint;
        // 0 in the joint, up along the ramp, 1, and down again along the ramp at the end.
        const float up = std::clamp(part - joint, 0.0f, ramp);
        const float top = std::clamp(part - joint - ramp, 0.0f, period - joint - 2 * ramp);
        const float down = std::clamp(part - (period - ramp), 0.0f, ramp);
        const float each = period - joint - ramp;
        return whole * each + 0.5f * up * up / ramp + top + down - 0.5f * down * down / ramp;
    };
    const auto height = [&](float at) {
        const float part = at - std::floor(at / period) * period;
        const float ramp = 0.5f * joint;
        return std::clamp(std::min(part - joint, period - part) / ramp, 0.0f, 1.0f);
    };
    const float w = std::max(width, 0.05f * joint);
    const float near = x - std::floor(x / period) * period;
    const float a = near - 0.5f * w, b = near + 0.5f * w;
    return {(integral(b) - integral(a)) / w, (height(b) - height(a)) / w};
}

/// The axes along and across rows for a wall, or a floor, of that normal.
ivec2 brick_axes(const vec3& n) {
    const vec3 a = glm::abs(n);
    if (a.y >= a.x && a.y >= a.z) return {0, 2};
    return a.x >= a.z ? ivec2(2, 1) : ivec2(0, 1);
}

void shade_brick(const float (*v)[3], tessera_shading* point) {
    const float brick = std::max(v[brick_length][0], 1e-6f);
    const float row_height = std::max(v[brick_height][0], 1e-6f);
    const float joint = std::clamp(v[brick_joint][0], 1e-3f * std::min(brick, row_height),
                                   0.4f * std::min(brick, row_height));
    const float width = point->footprint;
    const ivec2 axes = brick_axes(vec(point->normal));
    const vec3 p = vec(point->position);

    // Which brick: rows are shifted by half a brick in turn.
    const Cell row(p[axes.y] / row_height);
    const float along_row = p[axes.x] + ((row.index & 1) != 0 ? 0.5f * brick : 0.0f);
    const Cell column(along_row / brick);

    const vec2 u = pulse(along_row, width, brick, joint);
    const vec2 w = pulse(p[axes.y], width, row_height, joint);
    const float on_brick = u.x * w.x;

    // Each brick's own shade, and a little roughness within.
    const float seen = drawable(width, 2 * row_height);
    const float own = unit_float(hash(hash(row.index, column.index), std::uint32_t(axes.x))) - 0.5f;
    const Slope rough = filtered_noise(p, 0.3f * row_height, width);
    const float varied = std::clamp(v[brick_varied][0], 0.0f, 1.0f);
    const float shade = 1 + varied * (1.2f * seen * own + 0.3f * rough.value);
    const vec3 fired = vec(point->base_color) * shade;
    put(glm::mix(vec(v[brick_color]), fired, on_brick), point->base_color);
    const float bump = v[brick_bump][0];
    point->slope[axes.x] = bump * u.y * w.x;
    point->slope[axes.y] = bump * u.x * w.y;
    for (int i = 0; i < 3; ++i) point->slope[i] += 0.1f * bump * on_brick * rough.gradient[i];
    point->roughness = glm::mix(1.0f, point->roughness, on_brick);
}

template <std::size_t count>
constexpr tessera_shader shader_of(const char* name, std::uint32_t changes,
                                   const tessera_shader_parameter (&parameters)[count],
                                   decltype(tessera_shader::shade) shade) {
    return {TESSERA_SHADER_VERSION, changes, name, std::uint32_t(count), parameters, shade};
}

constexpr tessera_shader textures[] = {
    shader_of("wood", 0, wood_parameters, shade_wood),
    shader_of("marble", 0, marble_parameters, shade_marble),
    shader_of("brick", TESSERA_SHADER_ROUGHENS, brick_parameters, shade_brick),
};

}  // namespace

Slope noise(const vec3& p) {
    const Cell cell[3] = {Cell(p.x), Cell(p.y), Cell(p.z)};
    const vec2 weight[3] = {fade(cell[0].part), fade(cell[1].part), fade(cell[2].part)};

    // Corner i has bit k set where it is the far one along axis k. Arrays over the corners, which
    // compilers turn into vectors.
    float gx[8], gy[8], gz[8];
    for (std::uint32_t i = 0; i < 8; ++i) {
        const std::uint32_t h = hash((cell[0].index + (i & 1)) * 0x9e3779b1u +
                                     (cell[1].index + (i >> 1 & 1)) * 0x85ebca77u +
                                     (cell[2].index + (i >> 2)) * 0xc2b2ae3du);
        constexpr float scale = 1.0f / 512;
        gx[i] = float(std::int32_t(h & 1023)) * scale - 1;
        gy[i] = float(std::int32_t(h >> 10 & 1023)) * scale - 1;
        gz[i] = float(std::int32_t(h >> 20 & 1023)) * scale - 1;
    }
    float value = 0, dx = 0, dy = 0, dz = 0;
    float ax = 0, ay = 0, az = 0;  // of the weights
    for (std::uint32_t i = 0; i < 8; ++i) {
        const bool far[3] = {(i & 1) != 0, (i & 2) != 0, (i & 4) != 0};
        float w[3], s[3], d[3];
        for (int k = 0; k < 3; ++k) {
            w[k] = far[k] ? weight[k].x : 1 - weight[k].x;
            s[k] = far[k] ? weight[k].y : -weight[k].y;
            d[k] = cell[k].part - (far[k] ? 1.0f : 0.0f);
        }
        const float at = gx[i] * d[0] + gy[i] * d[1] + gz[i] * d[2];
        const float whole = w[0] * w[1] * w[2];
        value += whole * at;
        dx += whole * gx[i];
        dy += whole * gy[i];
        dz += whole * gz[i];
        ax += s[0] * w[1] * w[2] * at;
        ay += w[0] * s[1] * w[2] * at;
        az += w[0] * w[1] * s[2] * at;
    }
    return {value, vec3(dx + ax, dy + ay, dz + az)};
}

vec2 Wave::mean(float x, float width) const {
    const auto value = [&](float at) {
        const float part = at - std::floor(at);
        return part < peak ? part / peak : (1 - part) / (1 - peak);
    };
    const auto integral = [&](float at) {
        const float whole = std::floor(at);
        const float part = at - whole;
        if (part < peak) return 0.5f * (whole + part * part / peak);
        return 0.5f * (whole + 1 - (1 - part) * (1 - part) / (1 - peak));
    };
    const float w = std::max(width, 0.01f);
    // Near 0, where floats are fine: a difference of integrals far away has no digits.
    const float base = std::floor(x);
    const float a = x - base - 0.5f * w, b = x - base + 0.5f * w;
    return {(integral(b) - integral(a)) / w, (value(b) - value(a)) / w};
}

std::span<const tessera_shader> solid_textures() { return textures; }

}  // namespace tessera
