// tessera-bench: the benchmarks behind `tessera bench`. A program of its own, because they measure
// the worker's insides, which no client links.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <fstream>
#include <nlohmann/json.hpp>

#include "common/check.h"
#include "worker/bench/build_bench.h"
#include "worker/bench/light_stability.h"
#include "worker/bench/shading_bench.h"
#include "worker/bench/stability_bench.h"
#include "worker/bench/trace_bench.h"

namespace tessera {
namespace {

struct Options {
    std::vector<std::string> scenes{"cornell", "office"};
    std::string json;
    bool quick = false;
    bool flatten = false;
    bool incoherent = false;
    std::vector<std::string> kinds;
    bool kdtree = false;
    bool long_run = false;
    std::uint64_t rays = 200'000;
};

void write_json(const std::string& file, const nlohmann::json& results) {
    if (file.empty()) return;
    const nlohmann::json json = {{"version", TESSERA_VERSION}, {"results", results}};
    std::ofstream out(file);
    out << json.dump(2) << '\n';
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", file));
}

CLI::App* add_benchmark(CLI::App& app, Options& options, const char* name, const char* what) {
    CLI::App* command = app.add_subcommand(name, what);
    command->add_option("--json", options.json, "write the results to this file, too");
    return command;
}

void add_scenes(CLI::App* command, Options& options) {
    command
        ->add_option("SCENE", options.scenes, "files or generated scenes (default: cornell office)")
        ->expected(0, -1);
    command->add_flag("--quick", options.quick, "small and few: to see that it works");
}

void add_trace(CLI::App& app, Options& options) {
    CLI::App* command =
        add_benchmark(app, options, "trace", "Rays a second, ours beside Embree's best");
    add_scenes(command, options);
    command->add_flag("--flatten", options.flatten, "trace all instances as one object");
    command->add_flag("--incoherent", options.incoherent,
                      "never tell Embree that rays are coherent; then it misses fewer hits");
    command->add_option("--kind", options.kinds, "trace these rays only")
        ->check(CLI::IsMember(ray_kind_names()));
    command->add_flag("--kdtree", options.kdtree, "trace kd-trees instead of BVHs");
    command->callback([&options] {
        TraceBenchConfig config;
        if (options.quick) config = {.view = 128, .repetitions = 3, .vpls = 4};
        config.flatten = options.flatten;
        config.incoherent = options.incoherent;
        if (!options.kinds.empty()) config.kinds = options.kinds;
        if (options.kdtree) config.builder = TreeBuilder::kdtree;
        write_json(options.json, bench_trace(options.scenes, config));
    });
}

void add_build(CLI::App& app, Options& options) {
    CLI::App* command = add_benchmark(app, options, "build",
                                      "Build times, and what the strategies' trees are worth");
    add_scenes(command, options);
    command->callback([&options] {
        BuildBenchConfig config;
        if (options.quick) config = {.view = 64, .repetitions = 1};
        write_json(options.json, bench_build(options.scenes, config));
    });
}

void add_shading(CLI::App& app, Options& options) {
    CLI::App* command = add_benchmark(app, options, "shading",
                                      "What wood, marble and brick cost by virtual point lights");
    add_scenes(command, options);
    command->callback([&options] {
        ShadingBenchConfig config;
        if (options.quick) config = {.width = 64, .repetitions = 3, .vpls = {1, 32}};
        write_json(options.json, bench_shading(options.scenes, config));
    });
}

void add_stability(CLI::App& app, Options& options) {
    CLI::App* command = add_benchmark(app, options, "stability",
                                      "Wrong answers on hard cases, ours beside Embree's, and "
                                      "wrong light");
    command->add_option("--rays", options.rays, "rays of each case")
        ->check(CLI::Range(std::uint64_t(100), std::uint64_t(1) << 40))
        ->capture_default_str();
    command->add_flag("--long", options.long_run,
                      "100 million rays at shared edges and vertices: minutes a row");
    command->callback([&options] {
        nlohmann::json results = bench_stability(
            {.rays = options.rays, .edge_rays = options.long_run ? 100'000'000 : options.rays});
        const nlohmann::json light = bench_light_stability({});
        results.insert(results.end(), light.begin(), light.end());
        write_json(options.json, results);
    });
}

}  // namespace
}  // namespace tessera

int main(int argc, char** argv) {
    using namespace tessera;
    CLI::App app(
        "Benchmarks of the tracer. `tessera bench quality --help` tells of that of pictures.",
        "tessera bench");
    app.require_subcommand(1);
    Options options;
    add_trace(app, options);
    add_build(app, options);
    add_shading(app, options);
    add_stability(app, options);
    try {
        app.parse(argc, argv);
        return 0;
    } catch (const CLI::ParseError& error) {
        return app.exit(error) == 0 ? 0 : 2;
    } catch (const std::exception& error) {
        fmt::print(stderr, "tessera bench: {}\n", error.what());
    }
    return 1;
}
