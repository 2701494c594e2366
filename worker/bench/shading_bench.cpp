#include "worker/bench/shading_bench.h"

#include <fmt/format.h>

#include <nlohmann/json.hpp>

#include "common/scene_io.h"
#include "worker/bench/measure.h"
#include "worker/renderer.h"

namespace tessera {
namespace {

/// The scene with `shader` on all that does not emit; the coats go, so that wood and what it
/// replaces are both as plain as can be.
SceneBundle dressed(SceneBundle bundle, const std::string& shader) {
    for (Material& m : bundle.scene.materials)
        m = {.name = m.name,
             .base_color = m.base_color,
             .emission = m.emission,
             .shader = m.emission == vec3(0) ? shader : ""};
    return bundle;
}

FrameSpec frame_of(const Scene& scene, const ShadingBenchConfig& config, std::uint32_t vpls) {
    FrameSpec spec;
    spec.frame = 1;
    spec.size = {config.width, config.width * 3 / 4};
    if (scene.cameras.empty()) throw std::runtime_error("the scene has no camera");
    spec.camera = scene.cameras[0];
    spec.settings.passes = 1;
    spec.settings.vpls = vpls;
    return spec;
}

/// Seconds of one thread for a pass of the whole picture, with what it needs once a frame.
double seconds_of_pass(Renderer& renderer, const FrameSpec& spec) {
    const double start = thread_seconds();
    renderer.begin_frame(spec);
    for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
        renderer.render({spec.frame, tile, 0, 1});
    renderer.end_frame(spec.frame);
    return thread_seconds() - start;
}

}  // namespace

nlohmann::json bench_shading(const std::vector<std::string>& scenes,
                             const ShadingBenchConfig& config) {
    nlohmann::json results = nlohmann::json::array();
    fmt::print("{:<10} {:<8} {:>5} {:>12} {:>12} {:>8} {:>8}\n", "scene", "shader", "vpls",
               "plain ms", "shaded ms", "cost %", "spread");
    for (const std::string& name : scenes) {
        const SceneBundle bundle = load_scene(name).bundle;
        const SceneBundle bare = dressed(bundle, "");
        Renderer plain(bare.scene, bare.blobs, {});
        for (const char* shader : {"wood", "marble", "brick"}) {
            const SceneBundle worn = dressed(bundle, shader);
            Renderer shaded(worn.scene, worn.blobs, {}, &plain);
            for (const std::uint32_t vpls : config.vpls) {
                const FrameSpec spec = frame_of(bundle.scene, config, vpls);
                std::vector<double> without, with, ratios;
                // In turns, so that both meet the same weather.
                for (int i = 0; i <= config.repetitions; ++i) {
                    const double a = seconds_of_pass(plain, spec);
                    const double b = seconds_of_pass(shaded, spec);
                    if (i == 0) continue;  // builds the tracers
                    without.push_back(a);
                    with.push_back(b);
                    ratios.push_back(b / a);
                }
                const Spread cost = spread_of(ratios);
                fmt::print("{:<10} {:<8} {:>5} {:>12.1f} {:>12.1f} {:>8.1f} {:>8.1f}\n", name,
                           shader, vpls, 1e3 * median(without), 1e3 * median(with),
                           100 * (cost.median - 1), 100 * cost.mad);
                results.push_back({{"scene", name},
                                   {"shader", shader},
                                   {"vpls", vpls},
                                   {"plain_seconds", median(without)},
                                   {"shaded_seconds", median(with)},
                                   {"cost", cost.median - 1},
                                   {"spread", cost.mad}});
            }
        }
    }
    return results;
}

}  // namespace tessera
