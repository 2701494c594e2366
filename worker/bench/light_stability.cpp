#include "worker/bench/light_stability.h"

#include <fmt/format.h>
#include <tbb/parallel_for.h>

#include <array>
#include <nlohmann/json.hpp>
#include <optional>

#include "common/discontinuity.h"
#include "worker/bench/render_fixture.h"

namespace tessera {
namespace {

/// One tile, so that a task's result is the whole picture.
constexpr ImageSize picture{tile_size, tile_size};
constexpr int seeds = 8;
constexpr int interleave = 3;

struct LightCase {
    std::string name;
    SceneBundle scene{};
    Camera camera{};
    std::optional<double> exact{};  ///< mean radiance; none: as the path tracer says
};

// ---- Scenes -------------------------------------------------------------------------------------

Camera look_from(const vec3& eye, const vec3& at, float fov_y) {
    Camera camera;
    camera.eye = eye;
    camera.at = at;
    camera.up = std::abs(normalize(at - eye).y) > 0.99f ? vec3(0, 0, -1) : vec3(0, 1, 0);
    camera.fov_y = fov_y;
    return camera;
}

Material mirror() {
    Material m = lambert(vec3(0.9f));
    m.metallic = 1;
    m.roughness = 0;
    return m;
}

Material glass() {
    Material m = lambert(vec3(1));
    m.transmission = 1;
    m.roughness = 0;
    return m;
}

SceneBundle lit_room(const vec3& albedo, const vec3& radiance = vec3(5)) {
    SceneBundle bundle;
    add_shape(bundle, room(vec3(-1), vec3(1)), lambert(albedo));
    add_shape(bundle, square(0.4f, 0.99f, false), emitter(radiance));
    return bundle;
}

/// A plate over the floor, and a view into the gap.
LightCase gap_of_a_millimetre() {
    LightCase out{"receivers within 1 mm of VPLs", lit_room(vec3(0.7f)),
                  look_from({-0.2f, -0.9f, 0.6f}, {0, -1, 0.3f}, 20)};
    MeshBuilder plate;
    plate.box({-0.3f, -0.999f, -0.3f}, {0.3f, -0.99f, 0.3f});
    add_shape(out.scene, plate.take(), lambert(vec3(0.8f)));
    return out;
}

/// The lamp hangs below the ceiling, its back to it.
LightCase lamp_at_the_ceiling() {
    LightCase out{"lamp 1 mm from a wall", {}, look_from({0, 0, 0}, {0.35f, 1, 0.1f}, 40)};
    add_shape(out.scene, room(vec3(-1), vec3(1)), lambert(vec3(0.7f)));
    Material both_sides = emitter(vec3(5));
    both_sides.two_sided_emission = true;
    add_shape(out.scene, square(0.4f, 0.999f, false), both_sides);
    return out;
}

/// The room's only lamp is inside a ball of glass.
LightCase only_through_glass() {
    LightCase out{"lit through glass alone", {}, at_ball()};
    add_shape(out.scene, room(vec3(-1), vec3(1)), lambert(vec3(0.6f)));
    MeshBuilder bowl, flame;
    bowl.ball({0, 0.2f, 0}, 0.4f, 48);
    flame.ball({0, 0.5f, 0}, 0.15f, 24);
    add_shape(out.scene, bowl.take(), glass());
    add_shape(out.scene, flame.take(), emitter(vec3(10)));
    return out;
}

LightCase only_by_mirror() {
    LightCase out{"lit by a mirror alone", {}, look_from({0.2f, -0.2f, 0.6f}, {-0.2f, -1, 0}, 70)};
    add_shape(out.scene, room(vec3(-1), vec3(1)), lambert(vec3(0)));
    out.scene.scene.materials.back() = mirror();
    add_shape(out.scene, square(0.999f, -0.99f), lambert(vec3(0.6f)));
    // The lamp faces the mirrors above, and hides from the floor behind its own back.
    add_shape(out.scene, square(0.3f, 0), emitter(vec3(5)));
    return out;
}

LightCase sun_in_the_sky() {
    LightCase out{"a sun of 1e5 in the sky", {}, at_ball()};
    Texture sky{.width = 32, .height = 16, .rgba = {}};
    for (std::uint32_t i = 0; i < 32 * 16; ++i)
        sky.radiance.emplace_back(0.3f, 0.4f, i < 256 ? 0.6f : 0.1f);
    sky.radiance[3 * 32 + 13] = vec3(1e5f);
    out.scene.scene.environment = {.radiance = vec3(1),
                                   .texture = std::int32_t(add_texture(out.scene, sky)),
                                   .rotation = 0.4f};
    add_shape(out.scene, square(2, -0.8f), lambert(vec3(0.5f)));
    MeshBuilder ball;
    ball.ball({-0.4f, -0.4f, -0.4f}, 0.4f, 32);
    add_shape(out.scene, ball.take(), lambert({0.9f, 0.6f, 0.3f}));
    return out;
}

LightCase not_a_number_in_a_texture() {
    LightCase out{"NaN and infinity in textures", lit_room(vec3(0.6f)), at_ball()};
    const Texture texels{.width = 2,
                         .height = 2,
                         .rgba = {},
                         .radiance = {vec3(NAN), vec3(4), vec3(infinity), vec3(2)}};
    Material lamp = emitter(vec3(1));
    lamp.emission_map.texture = std::int32_t(add_texture(out.scene, texels));
    add_shape(out.scene, square(0.3f, 0.9f, false), lamp);
    return out;
}

/// Wires thinner than a pixel before a bright wall.
LightCase thin_wires() {
    LightCase out{"filter at thin wires", lit_room(vec3(0.6f)),
                  look_from(vec3(0, 0, 0.9f), vec3(0, 0, -1), 60)};
    MeshBuilder wires;
    for (int i = 0; i < 12; ++i) {
        const float x = -0.55f + 0.1f * float(i);
        wires.cylinder({x, -0.9f, 0.02f * float(i % 3)}, 0.005f, 1.8f, 8);
    }
    add_shape(out.scene, wires.take(), lambert({0.1f, 0.2f, 0.8f}));
    return out;
}

LightCase thousands_of_hidden_lamps() {
    LightCase out{"4,096 lamps, all hidden", {}, look_from({3, 3, 0.1f}, {3, 0, 0}, 40), 0.0};
    add_shape(out.scene, square(10, 0), lambert(vec3(0.5f)));
    add_shape(out.scene, room({-1, 1, -1}, {1, 2, 1}), lambert(vec3(0.9f)));
    for (int i = 0; i < 4096; ++i) {
        mat4 place(1);
        place[3] = vec4(0.03f * float(i % 64) - 0.95f, 1.9f, 0.03f * float(i / 64) - 0.95f, 1);
        add_shape(out.scene, square(0.01f, 0, false), emitter(vec3(10)), place);
    }
    return out;
}

std::vector<LightCase> light_cases() {
    const Camera at_corner = look_from({-0.98f, -0.97f, -0.96f}, vec3(-1), 60);
    const Camera at_edge = look_from({0.1f, -0.97f, -0.97f}, {0, -1, -1}, 60);
    std::vector<LightCase> out{
        gap_of_a_millimetre(),
        {"VPLs in corners", lit_room(vec3(0.7f)), at_corner},
        {"VPLs on edges", lit_room(vec3(0.7f)), at_edge},
        lamp_at_the_ceiling(),
        {"slit of 1e-3 between rooms", two_rooms(1e-3f, false),
         look_from({-0.6f, -0.5f, 0}, {-0.6f, -1, 0}, 0.5f)},
        {"albedo 0", lit_room(vec3(0)), at_ball()},
        {"albedo 1", lit_room(vec3(1)), at_ball()},
        {"albedo 3, clamped", lit_room(vec3(3)), at_ball()},
        {"light of 1e-6", lit_room(vec3(0.6f), vec3(1e-6f)), at_ball()},
        {"light of 1e9", lit_room(vec3(0.6f), vec3(1e9f)), at_ball()},
        thousands_of_hidden_lamps(),
        only_through_glass(),
        only_by_mirror(),
        sun_in_the_sky(),
        {"filter at silhouettes", room_with_ball(lambert(vec3(0.5f)), lambert({0.9f, 0.2f, 0.1f})),
         at_ball()},
        {"filter at mirrors", room_with_ball(lambert(vec3(0.5f)), mirror()), at_ball()},
        thin_wires(),
        not_a_number_in_a_texture()};
    return out;
}

// ---- Measuring ----------------------------------------------------------------------------------

struct Measured {
    double mean = 0;
    double error = 0;     ///< standard, of the mean
    double filtered = 0;  ///< mean radiance behind the discontinuity filter
    std::uint64_t not_finite = 0;
    std::uint64_t sanitised = 0;
};

/// What is asked of one picture, in one pass.
struct Sums {
    double mean = 0;
    double filtered = 0;
    std::uint64_t not_finite = 0;
    std::uint64_t sanitised = 0;
};

std::span<const float> channel_of(const FrameSpec& spec, const TileResult& result,
                                  Channel channel) {
    return std::span(result.data)
        .subspan(channel_offset(spec, channel, picture.pixels()),
                 picture.pixels() * std::size_t(floats_per_pixel(channel)));
}

double mean_of(std::span<const float> radiance, std::span<const float> albedo,
               std::span<const float> irradiance) {
    double sum = 0;
    for (std::size_t i = 0; i < radiance.size(); ++i)
        sum += double(radiance[i]) +
               (albedo.empty() ? 0 : double(albedo[i]) / double(pi) * double(irradiance[i]));
    return sum / double(radiance.size());
}

void add(const FrameSpec& spec, const TileResult& result, Sums& sums) {
    for (const Channel c : {Channel::radiance, Channel::irradiance, Channel::albedo})
        if (tile_channels(spec).has(c))
            for (const float v : channel_of(spec, result, c)) sums.not_finite += !std::isfinite(v);
    sums.sanitised += result.sanitised;
    const auto radiance = channel_of(spec, result, Channel::radiance);
    if (spec.settings.integrator == Integrator::path) {
        sums.mean += mean_of(radiance, {}, {});
        return;
    }
    const auto albedo = channel_of(spec, result, Channel::albedo);
    const auto irradiance = channel_of(spec, result, Channel::irradiance);
    const Rect all{0, 0, picture.width, picture.height};
    std::vector<float> filtered(irradiance.size());
    filter_irradiance({.picture = picture, .camera = spec.camera, .window = interleave},
                      {.area = all,
                       .irradiance = irradiance,
                       .normal = channel_of(spec, result, Channel::normal),
                       .depth = channel_of(spec, result, Channel::depth),
                       .surface = channel_of(spec, result, Channel::surface)},
                      all, filtered);
    sums.mean += mean_of(radiance, albedo, irradiance);
    sums.filtered += mean_of(radiance, albedo, filtered);
}

/// Pictures with independent seeds, side by side.
Measured measure(Renderer& renderer, const LightCase& one, Integrator integrator,
                 std::uint32_t passes) {
    std::array<Sums, seeds> sums;
    tbb::parallel_for(0, seeds, [&](int i) {
        FrameSpec spec = frame_of(integrator, picture, one.camera, passes);
        spec.frame = spec.settings.seed = std::uint32_t(i + 1);
        spec.settings.interleave = interleave;
        renderer.begin_frame(spec);
        for (const TileTask& task : tasks_of(spec))
            add(spec, *renderer.render(task), sums[std::size_t(i)]);
        renderer.end_frame(spec.frame);
    });
    Measured out;
    double squares = 0;
    for (const Sums& s : sums) {
        const double mean = s.mean / passes;
        out.mean += mean / seeds;
        squares += mean * mean / seeds;
        out.filtered += s.filtered / passes / seeds;
        out.not_finite += s.not_finite;
        out.sanitised += s.sanitised;
    }
    out.error = std::sqrt(std::max(squares - out.mean * out.mean, 0.0) / (seeds - 1));
    return out;
}

/// Equal within a hundredth, or within what the noise allows.
bool agrees(const Measured& igi, const Measured& expected) {
    const double off = std::abs(igi.mean - expected.mean);
    return off <= 0.01 * expected.mean || off <= 4 * std::hypot(igi.error, expected.error);
}

std::string percent(double part, double whole) {
    return whole > 0 ? fmt::format("{:.2f}", 100 * part / whole) : "-";
}

nlohmann::json run_and_print(const LightCase& one, std::uint32_t passes) {
    Renderer renderer(one.scene.scene, one.scene.blobs, {});
    const Measured igi = measure(renderer, one, Integrator::igi, passes);
    const Measured path = measure(renderer, one, Integrator::path, 4 * passes);
    const Measured expected = one.exact ? Measured{.mean = *one.exact} : path;
    const double noise = std::hypot(igi.error, expected.error);
    const std::uint64_t not_finite = igi.not_finite + path.not_finite;
    const std::uint64_t sanitised = igi.sanitised + path.sanitised;
    const bool wrong = !agrees(igi, expected) || not_finite > 0;
    fmt::print("{:<32} {:>11.4g} {:>11.4g} {:>8} {:>8} {:>8} {:>10} {:>9}{}\n", one.name, igi.mean,
               expected.mean, percent(igi.mean - expected.mean, expected.mean),
               percent(noise, expected.mean), percent(igi.filtered - igi.mean, igi.mean),
               not_finite, sanitised, wrong ? "  WRONG" : "");
    std::fflush(stdout);
    return {{"case", one.name},       {"igi", igi.mean},          {"expected", expected.mean},
            {"noise", noise},         {"filtered", igi.filtered}, {"not_finite", not_finite},
            {"sanitised", sanitised}, {"wrong", int(wrong)}};
}

}  // namespace

nlohmann::json bench_light_stability(const LightStabilityConfig& config) {
    fmt::print("\n{:<32} {:>11} {:>11} {:>8} {:>8} {:>8} {:>10} {:>9}\n", "light, mean radiance",
               "igi", "expected", "off %", "+- %", "filter %", "not finite", "sanitised");
    nlohmann::json results = nlohmann::json::array();
    for (const LightCase& one : light_cases()) results.push_back(run_and_print(one, config.passes));
    return results;
}

}  // namespace tessera
