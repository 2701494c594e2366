// The small kernels that a frame runs through on its way to the viewer, each with its output
// verified.
//   bench_kernels --benchmark_repetitions=5 --benchmark_report_aggregates_only
#include <benchmark/benchmark.h>

#include <bit>
#include <cstring>

#include "common/check.h"
#include "common/discontinuity.h"
#include "common/generator.h"
#include "common/message_codec.h"
#include "common/tile_codec.h"
#include "common/tone_map.h"
#include "worker/renderer.h"
#include "worker/sampling.h"

namespace tessera {
namespace {

constexpr ImageSize picture{1920, 1080};

void tone_map_a_picture(benchmark::State& state) {
    Image image(picture, 3);
    std::fill(image.data.begin(), image.data.end(), 0.214041f);  // half way up in sRGB
    std::vector<std::uint8_t> rgb;
    for (auto _ : state) rgb = to_srgb8(image, {});
    for (const std::uint8_t value : rgb) CHECK(value == 127 || value == 128);
    state.SetItemsProcessed(state.iterations() * std::int64_t(picture.pixels()));
}
BENCHMARK(tone_map_a_picture)->Unit(benchmark::kMillisecond);

/// A tile as most are: noise in radiance, irradiance and depth, a few surfaces in the rest.
std::vector<float> usual_tile(ChannelSet channels) {
    std::vector<float> data;
    for (int c = 0; c < channel_count; ++c) {
        if (!channels.has(Channel(c))) continue;
        const bool noisy = Channel(c) <= Channel::irradiance || Channel(c) == Channel::depth;
        const int floats = floats_per_pixel(Channel(c));
        for (int i = 0; i < tile_size * tile_size * floats; ++i)
            data.push_back(float(noisy ? hash(std::uint32_t(i), 1) : i / (80 * floats)));
    }
    return data;
}

void pack_and_unpack_a_tile(benchmark::State& state) {
    const ChannelSet channels = tile_channels({});
    const Rect tile{0, 0, tile_size, tile_size};
    const std::vector<float> data = usual_tile(channels);
    std::vector<float> unpacked(data.size());
    for (auto _ : state)
        unpack_tile(channels, pack_tile(channels, tile.pixels(), data), tile,
                    {tile_size, tile_size}, unpacked);
    CHECK(unpacked == data);
    state.SetItemsProcessed(state.iterations());
}
BENCHMARK(pack_and_unpack_a_tile);

/// As many tiles as lie ready when they are cheap, without their pixels.
void send_and_receive_tiles(benchmark::State& state) {
    TileResults tiles;
    for (std::uint32_t tile = 0; tile < std::uint32_t(state.range(0)); ++tile)
        tiles.tiles.push_back({.task = {.frame = 1, .tile = tile}, .rays = 1000, .seconds = 1e-4f});
    TileResults received;
    for (auto _ : state) {
        const EncodedMessage sent = encode({tiles, {}});
        const FrameHeader header =
            decode_header(std::span(sent.head).first<frame_header_bytes>(), {});
        const Message message =
            decode(header, std::span(sent.head).subspan(frame_header_bytes), sent.payload);
        received = *message.get<TileResults>();
    }
    CHECK(received == tiles);
    state.SetItemsProcessed(state.iterations() * state.range(0));
}
BENCHMARK(send_and_receive_tiles)->Arg(1)->Arg(20);

FrameSpec first_view(const SceneBundle& bundle, ImageSize size, std::uint32_t vpls) {
    FrameSpec spec;
    spec.frame = 1;
    spec.size = size;
    spec.camera = bundle.scene.cameras.at(0);
    spec.settings.vpls = vpls;
    return spec;
}

/// What all pixels' bits add up to, in any order.
std::uint64_t render_tiles(const Renderer& renderer, const FrameSpec& spec, bool cut) {
    std::uint64_t sum = 0;
    for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
        for (std::uint32_t part = cut; part <= (cut ? quarters : 0); ++part) {
            const auto result = renderer.render({spec.frame, tile, 0, 1, part});
            CHECK(result.has_value());
            for (const float v : result->data) sum += std::bit_cast<std::uint32_t>(v);
        }
    return sum;
}

/// A picture whole tile by whole tile (0), or in quarters (1): cutting costs what is more.
void render_a_picture(benchmark::State& state, const char* scene) {
    const SceneBundle bundle = *generate_scene(scene);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const FrameSpec spec = first_view(bundle, {320, 240}, 8);
    renderer.begin_frame(spec);
    const std::uint64_t expected = render_tiles(renderer, spec, false);
    std::uint64_t sum = 0;
    for (auto _ : state) sum = render_tiles(renderer, spec, state.range(0) == 1);
    CHECK_EQ(sum, expected);
    state.SetItemsProcessed(state.iterations() * std::int64_t(spec.size.pixels()));
}
BENCHMARK_CAPTURE(render_a_picture, cornell, "cornell")->Arg(0)->Arg(1);
BENCHMARK_CAPTURE(render_a_picture, office, "office")->Arg(0)->Arg(1);
BENCHMARK_CAPTURE(render_a_picture, kitchen, "kitchen")->Arg(0)->Arg(1);

/// What a frame's workers send for the filter, whole.
void filter_a_pass(benchmark::State& state, const char* scene) {
    const SceneBundle bundle = *generate_scene(scene);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const FrameSpec spec = first_view(bundle, picture, 1);
    renderer.begin_frame(spec);
    const ChannelSet channels = tile_channels(spec);
    std::vector<float> planes(spec.size.pixels() * std::size_t(floats_per_pixel(channels)));
    for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile) {
        const Rect rect = tile_rect(spec.size, tile);
        const auto result = renderer.render({spec.frame, tile, 0, 1, 0});
        unpack_tile(channels, pack_tile(channels, rect.pixels(), result->data), rect, spec.size,
                    planes);
    }
    const auto plane = [&](std::size_t first, std::size_t floats) {
        return std::span(planes).subspan(first * spec.size.pixels(), floats * spec.size.pixels());
    };
    const PassView pass{{0, 0, spec.size.width, spec.size.height},
                        plane(3, 3),
                        plane(9, 3),
                        plane(12, 1),
                        plane(13, 1)};
    const DiscontinuityFilter filter{
        .picture = spec.size, .camera = spec.camera, .window = int(state.range(0))};
    std::vector<float> filtered(3 * spec.size.pixels());
    for (auto _ : state) filter_irradiance(filter, pass, pass.area, filtered);
    for (const float e : filtered) CHECK(std::isfinite(e));
    state.SetItemsProcessed(state.iterations() * std::int64_t(spec.size.pixels()));
}
BENCHMARK_CAPTURE(filter_a_pass, cornell, "cornell")->Arg(9)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(filter_a_pass, building, "building:1")->Arg(9)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(filter_a_pass, kitchen, "kitchen")->Arg(9)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(filter_a_pass, office, "office")->Arg(9)->Unit(benchmark::kMillisecond);

void draw_sample_points(benchmark::State& state) {
    vec2 sum(0);
    std::uint32_t index = 0;
    for (auto _ : state) sum += sobol_point(index++, 3, 5);
    const vec2 mean = sum / float(state.iterations());
    CHECK(state.iterations() < 1000 || std::abs(mean.x - 0.5f) < 0.05f);
    state.SetItemsProcessed(state.iterations());
}
BENCHMARK(draw_sample_points);

}  // namespace
}  // namespace tessera

BENCHMARK_MAIN();
