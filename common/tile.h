// What scheduler, frame assembler and renderer share: settings, frames, 16x16 tiles and their
// quarters, and their results, all as values.
//
// A *pass* traces one eye ray per pixel, jittered inside the pixel, with light samples of its own.
// A frame is the mean of its passes, always added up in the order of their numbers, so that the
// picture is the same bits whoever renders which tile. A *task* is one tile, or a quarter of one,
// in a run of consecutive passes; how tiles are cut changes no bit either.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "common/image.h"
#include "common/scene.h"

namespace tessera {

inline constexpr int tile_size = 16;  ///< pixels; Wald 2004, 8.1.2.1
inline constexpr int quarter_size = tile_size / 2;
inline constexpr std::uint32_t quarters = 4;  ///< of a tile that is cut

enum class Integrator : std::uint8_t { igi, path };
enum class TracerKind : std::uint8_t { kdtree, embree };
/// Where the discontinuity filter runs. Today: on the server after assembly, or not at all.
enum class FilterPlace : std::uint8_t { server, off };

struct RenderSettings {
    Integrator integrator = Integrator::igi;
    TracerKind tracer = TracerKind::kdtree;
    FilterPlace filter = FilterPlace::server;
    std::uint32_t passes = 4;      ///< eye rays per pixel
    std::uint32_t vpls = 2;        ///< igi: virtual point lights per pixel and pass, on average
    std::uint32_t interleave = 9;  ///< igi: n, for n x n interleaved sets of VPLs
    std::uint32_t bounces = 64;    ///< indirect bounces at most; Russian roulette ends most earlier
    std::uint32_t seed = 0;
    bool track_lights = true;  ///< igi, with many lights: find those that matter to the view

    bool operator==(const RenderSettings&) const = default;
};

/// What a tile carries per pixel. A frame's picture is radiance + albedo / pi * irradiance, where
/// only the irradiance is filtered (Wald 2004, 13.1.5).
enum class Channel : std::uint8_t {
    radiance,    ///< rgb: what needs no filter; path integrator: everything
    irradiance,  ///< rgb: at the first diffuse hit
    albedo,      ///< rgb: there, times the throughput of mirrors on the way
    normal,  ///< xyz: shading normal there, world space, facing the eye; zero where nothing was hit
    depth,   ///< path length from the eye to there; infinite where nothing was hit
    surface,  ///< bits of a uint32: instance, object and path length there; 0 where nothing was hit
    direct,   ///< rgb: radiance of emission and direct light
    indirect,     ///< rgb: radiance of everything else
    path_length,  ///< segments of the path from the eye to the first diffuse hit: 1 and one for
                  ///< each mirror and glass; 0 where nothing was hit
    // Of these the server knows by itself:
    error,  ///< standard error of the mean, RMS over colours, as far as it is visible within [0,
            ///< 1]; infinite before there are two runs of passes
    owner,  ///< number of the worker whose tile it was in the newest run of passes
};
inline constexpr int channel_count = 11;

constexpr int floats_per_pixel(Channel c) {
    return c == Channel::depth || c == Channel::surface || c >= Channel::path_length ? 1 : 3;
}

/// A set of channels as bits.
struct ChannelSet {
    std::uint32_t bits = 0;

    constexpr bool has(Channel c) const { return bits >> unsigned(c) & 1; }
    constexpr ChannelSet with(Channel c) const { return {bits | 1u << unsigned(c)}; }
    constexpr ChannelSet with(ChannelSet o) const { return {bits | o.bits}; }
    constexpr ChannelSet without(ChannelSet o) const { return {bits & ~o.bits}; }
    bool operator==(const ChannelSet&) const = default;
};

constexpr int floats_per_pixel(ChannelSet set) {
    int n = 0;
    for (int c = 0; c < channel_count; ++c)
        if (set.has(Channel(c))) n += floats_per_pixel(Channel(c));
    return n;
}

/// What one light sends into a picture: the radiance of its pixels, mean of the components, summed.
struct LightEstimate {
    std::uint32_t light = 0;  ///< numbered by the scene version
    float radiance = 0;

    bool operator==(const LightEstimate&) const = default;
};

/// Adds to `sum` what lights send into one more part of it; both by number. In the order of parts a
/// tile gets the same bits whole and cut.
inline void add_estimates(std::span<const LightEstimate> part, std::vector<LightEstimate>& sum) {
    for (const LightEstimate& e : part) {
        const auto at = std::ranges::lower_bound(sum, e.light, {}, &LightEstimate::light);
        if (at != sum.end() && at->light == e.light)
            at->radiance += e.radiance;
        else
            sum.insert(at, e);
    }
}

/// One picture to be made: scene version, camera, size, settings and what was found out before
/// decide every bit of it.
struct FrameSpec {
    std::uint64_t frame = 0;  ///< unique on one server
    std::string scene;        ///< name of the scene on the server
    std::uint64_t version = 0;
    ImageSize size;
    Camera camera;
    RenderSettings settings;
    ChannelSet extra;                     ///< channels wanted beside the picture
    std::vector<LightEstimate> lights{};  ///< by an earlier frame of the view; by number

    bool operator==(const FrameSpec&) const = default;
};

/// Channels that no worker sends.
inline constexpr ChannelSet server_channels =
    ChannelSet{}.with(Channel::error).with(Channel::owner);

/// Channels that workers send for a frame: what the picture and its filter need, and what was asked
/// for.
constexpr ChannelSet tile_channels(const FrameSpec& spec) {
    ChannelSet set = ChannelSet{}.with(Channel::radiance);
    if (spec.settings.integrator == Integrator::igi) {
        set = set.with(Channel::irradiance).with(Channel::albedo);
        if (spec.settings.filter != FilterPlace::off)
            set = set.with(Channel::normal).with(Channel::depth).with(Channel::surface);
    }
    return set.with(spec.extra).without(server_channels);
}

/// Passes that one task traces: a filtered pass travels alone, others are summed on the worker.
constexpr std::uint32_t passes_per_task(const RenderSettings& s) {
    return s.integrator == Integrator::igi ? 1 : 16;
}

/// A rectangle of pixels, x0 <= x < x1.
struct Rect {
    int x0 = 0, y0 = 0, x1 = 0, y1 = 0;

    int width() const { return x1 - x0; }
    int height() const { return y1 - y0; }
    std::size_t pixels() const { return std::size_t(width()) * std::size_t(height()); }
    bool operator==(const Rect&) const = default;
};

inline std::uint32_t tiles_across(ImageSize s) {
    return std::uint32_t((s.width + tile_size - 1) / tile_size);
}
inline std::uint32_t tile_count(ImageSize s) {
    return tiles_across(s) * std::uint32_t((s.height + tile_size - 1) / tile_size);
}
/// Tiles are numbered row by row; those at the right and lower border are cut to the picture.
inline Rect tile_rect(ImageSize s, std::uint32_t tile) {
    const int x = int(tile % tiles_across(s)) * tile_size;
    const int y = int(tile / tiles_across(s)) * tile_size;
    return {x, y, std::min(x + tile_size, s.width), std::min(y + tile_size, s.height)};
}

/// Quarters 1 to 4 of a tile, row by row; 0 is all of it.
inline Rect part_rect(ImageSize s, std::uint32_t tile, std::uint32_t part) {
    const Rect whole = tile_rect(s, tile);
    if (part == 0) return whole;
    const int x = whole.x0 + int(part - 1) % 2 * quarter_size;
    const int y = whole.y0 + int(part - 1) / 2 * quarter_size;
    return {x, y, std::min(x + quarter_size, whole.x1), std::min(y + quarter_size, whole.y1)};
}
/// Whether every quarter has pixels.
inline bool can_be_cut(ImageSize s, std::uint32_t tile) {
    const Rect whole = tile_rect(s, tile);
    return whole.width() > quarter_size && whole.height() > quarter_size;
}
/// The quarter in which a pixel of the picture lies, from 0.
inline std::uint32_t quarter_of(int x, int y) {
    return std::uint32_t(x / quarter_size % 2 + y / quarter_size % 2 * 2);
}

/// One tile, or a quarter, in the passes first_pass .. first_pass + pass_count - 1 of a frame.
struct TileTask {
    std::uint64_t frame = 0;
    std::uint32_t tile = 0;
    std::uint32_t first_pass = 0;
    std::uint32_t pass_count = 1;
    std::uint32_t part = 0;  ///< 0: the whole tile; quarters only of tiles that can be cut

    auto operator<=>(const TileTask&) const = default;
};
inline Rect rect_of(ImageSize s, const TileTask& task) {
    return part_rect(s, task.tile, task.part);
}

/// The answer to a task as it is rendered; common/tile_codec.h packs it. `data` holds the channels
/// of tile_channels(spec) in order, each planar by channel and interleaved within (rgbrgb...), rows
/// of the tile's rect from the top. Values are sums over the task's passes, except `surface`,
/// `normal`, `depth` and `path_length`, which are those of the task's first pass.
struct TileResult {
    TileTask task;
    std::uint64_t rays = 0;
    std::uint64_t sanitised = 0;  ///< values that were not finite and were replaced by zero
    float seconds = 0;            ///< time spent rendering
    std::vector<float> data;
    std::vector<LightEstimate> lights{};  ///< into the tile, where lights are tracked; by number
    std::uint32_t active_lights = 0;      ///< that the view gets something of; 0: not tracked

    bool operator==(const TileResult&) const = default;
};

/// What a worker says of a finished task, beside its pixels.
struct TileReport {
    TileTask task;
    std::uint64_t rays = 0;
    std::uint64_t sanitised = 0;
    float seconds = 0;                    ///< spent rendering
    std::uint32_t pixel_bytes = 0;        ///< of its pixels, packed
    std::vector<LightEstimate> lights{};  ///< as in TileResult
    std::uint32_t active_lights = 0;

    bool operator==(const TileReport&) const = default;
};

}  // namespace tessera
