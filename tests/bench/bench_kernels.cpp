// The small kernels that a frame runs through on its way to the viewer, each with its output
// verified.
//   bench_kernels --benchmark_repetitions=5 --benchmark_report_aggregates_only
#include <benchmark/benchmark.h>

#include <bit>
#include <cstring>

#include "common/check.h"
#include "common/discontinuity.h"
#include "common/message_codec.h"
#include "common/tone_map.h"
#include "worker/sampling.h"

namespace tessera {
namespace {

constexpr ImageSize picture{1024, 768};

/// A wall that fills the picture, lit evenly: the filter must leave it as it is.
struct Wall {
    std::vector<float> irradiance = std::vector<float>(picture.pixels() * 3, 0.5f);
    std::vector<float> normal = std::vector<float>(picture.pixels() * 3);
    std::vector<float> depth = std::vector<float>(picture.pixels(), 2);
    std::vector<float> surface = std::vector<float>(picture.pixels(), std::bit_cast<float>(7u));

    Wall() {
        for (std::size_t i = 2; i < normal.size(); i += 3) normal[i] = 1;
    }
};

void filter_a_pass(benchmark::State& state) {
    const Wall wall;
    const Rect all{0, 0, picture.width, picture.height};
    const DiscontinuityFilter filter{
        .picture = picture, .camera = {}, .window = int(state.range(0))};
    std::vector<float> filtered(wall.irradiance.size());
    for (auto _ : state)
        filter_irradiance(filter, {all, wall.irradiance, wall.normal, wall.depth, wall.surface},
                          all, filtered);
    for (const float e : filtered) CHECK(std::abs(e - 0.5f) < 1e-6f);
    state.SetItemsProcessed(state.iterations() * std::int64_t(picture.pixels()));
}
BENCHMARK(filter_a_pass)->Arg(3)->Arg(5)->Arg(9)->Unit(benchmark::kMillisecond);

void tone_map_a_picture(benchmark::State& state) {
    Image image(picture, 3);
    std::fill(image.data.begin(), image.data.end(), 0.214041f);  // half way up in sRGB
    std::vector<std::uint8_t> rgb;
    for (auto _ : state) rgb = to_srgb8(image, {});
    for (const std::uint8_t value : rgb) CHECK(value == 127 || value == 128);
    state.SetItemsProcessed(state.iterations() * std::int64_t(picture.pixels()));
}
BENCHMARK(tone_map_a_picture)->Unit(benchmark::kMillisecond);

void send_and_receive_a_tile(benchmark::State& state) {
    TileResult tile{.task = {.frame = 1, .tile = 2, .first_pass = 3}, .data = {}};
    tile.data.assign(tile_size * tile_size * 14, 0.25f);
    TileResult received;
    for (auto _ : state) {
        const EncodedMessage sent = encode({tile, {}});
        const FrameHeader header =
            decode_header(std::span(sent.head).first<frame_header_bytes>(), {});
        const Message message =
            decode(header, std::span(sent.head).subspan(frame_header_bytes), sent.payload);
        received = *message.get<TileResult>();
    }
    CHECK(received == tile);
    state.SetItemsProcessed(state.iterations());
}
BENCHMARK(send_and_receive_a_tile);

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
