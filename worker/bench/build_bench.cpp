#include "worker/bench/build_bench.h"

#include <fmt/format.h>
#include <tbb/task_arena.h>

#include <functional>
#include <nlohmann/json.hpp>
#include <thread>

#include "worker/bench/bench_scene.h"
#include "worker/bench/embree_rebuild.h"
#include "worker/bench/measure.h"
#include "worker/bench/strategy_bench.h"
#include "worker/kernels.h"

namespace tessera {
namespace {

using Build = std::function<void()>;

/// What is built, by whom.
struct Contest {
    std::string scene;
    std::string what;  ///< is built: all, the top level alone...
    std::size_t triangles = 0, instances = 0;
    std::string peer;  ///< Embree's quality
    int threads = 1;
    Build ours, embree;
};

/// With one thread CPU time, which other processes do not disturb; with more, what a user waits.
double build_clock(int threads) {
    if (threads > 1) return wall_seconds();
    timespec now{};
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

/// Of one build: short ones are repeated until there is something to measure.
double seconds_of(int threads, const Build& build) {
    constexpr double measurable = 2e-3;
    for (int repetitions = 1;; repetitions *= 4) {
        const double start = build_clock(threads);
        for (int i = 0; i < repetitions; ++i) build();
        const double seconds = build_clock(threads) - start;
        if (seconds > measurable) return seconds / repetitions;
    }
}

nlohmann::json time_builds(const Contest& contest, int repetitions) {
    constexpr double enough_seconds = 20;  // large scenes build less often
    std::vector<double> ours, embree;
    double total = 0;
    for (int i = 0; i < repetitions && total < enough_seconds; ++i) {
        ours.push_back(seconds_of(contest.threads, contest.ours));
        embree.push_back(seconds_of(contest.threads, contest.embree));
        total += ours.back() + embree.back();
    }
    const Spread our_spread = spread_of(ours), embree_spread = spread_of(embree);
    return {{"scene", contest.scene},
            {"what", contest.what},
            {"triangles", contest.triangles},
            {"instances", contest.instances},
            {"threads", contest.threads},
            {"embree_quality", contest.peer},
            {"repetitions", ours.size()},
            {"ours_seconds", our_spread.median},
            {"ours_spread", our_spread.relative()},
            {"embree_seconds", embree_spread.median},
            {"embree_spread", embree_spread.relative()},
            {"ratio", our_spread.median / embree_spread.median}};
}

void print_heading(int repetitions) {
    fmt::print(
        "Milliseconds to build, median of up to {} and its spread (MAD); ratio ours / Embree's.\n"
        "{:<14} {:<10} {:>9} {:>9} {:>7} {:>10} {:>6} {:>10} {:>6} {:<7} {:>6}\n",
        repetitions, "scene", "built", "triangles", "instances", "threads", "ours", "+-", "Embree",
        "+-", "quality", "ratio");
}

void print_build(const nlohmann::json& r) {
    const auto number = [&](const char* field) { return r[field].get<double>(); };
    const auto count = [&](const char* field) { return r[field].get<std::size_t>(); };
    fmt::print(
        "{:<14} {:<10} {:>9} {:>9} {:>7} {:>10.3f} {:>5.1f}% {:>10.3f} {:>5.1f}% {:<7} {:>6.2f}\n",
        r["scene"].get<std::string>(), r["what"].get<std::string>(), count("triangles"),
        count("instances"), count("threads"), 1e3 * number("ours_seconds"),
        100 * number("ours_spread"), 1e3 * number("embree_seconds"), 100 * number("embree_spread"),
        r["embree_quality"].get<std::string>(), number("ratio"));
    std::fflush(stdout);
}

Contest contest_of(const BenchScene& scene, const char* what, const char* peer, int threads) {
    return {scene.geometry.name,
            what,
            scene.triangles(),
            scene.geometry.instances.size(),
            peer,
            threads,
            {},
            {}};
}

/// Everything, as a new scene needs it.
Contest whole_scene(const BenchScene& scene, int threads) {
    Contest out = contest_of(scene, "all", "HIGH", threads);
    out.ours = [&scene, threads] { scene.build_ours(threads); };
    out.embree = [&scene, threads] { scene.build_embree(threads); };
    return out;
}

/// `build` in an arena of so many threads, which lives as long as the builds go on.
Build in_arena(int threads, Build build) {
    const auto arena = std::make_shared<tbb::task_arena>(threads);
    return [arena, build = std::move(build)] { arena->execute(build); };
}

/// Calls `f` with the width that this machine traces best, as a type.
template <class F>
auto with_width(F&& f) {
    switch (width_of(chosen_isa())) {
        case 4:
            return f(std::integral_constant<int, 4>());
        case 8:
            return f(std::integral_constant<int, 8>());
        default:
            return f(std::integral_constant<int, 16>());
    }
}

/// A mesh whose vertices have all moved.
Contest deforming_mesh(const BenchScene& scene, RTCBuildQuality quality, int threads) {
    const char* const peer = quality == RTC_BUILD_QUALITY_LOW ? "LOW" : "REFIT";
    Contest out = contest_of(scene, "object", peer, threads);
    const TracerObject object = scene.geometry.objects()[0];
    out.ours = with_width([&]<int width>(std::integral_constant<int, width>) {
        return in_arena(threads, [object] { build_object<width>(object, TreeBuilder::quick); });
    });
    const auto embree = std::make_shared<EmbreeRebuild>(
        EmbreeRebuild::of_mesh(scene.geometry.meshes[0], quality, threads));
    out.embree = [embree] { embree->rebuild(); };
    return out;
}

/// The level above objects that stay, when all instances have moved.
Contest top_level(const BenchScene& scene, int threads) {
    Contest out = contest_of(scene, "top level", "LOW", threads);
    const TestScene& geometry = scene.geometry;
    out.ours = with_width([&]<int width>(std::integral_constant<int, width>) {
        const auto built = std::make_shared<WideScene<width>>();
        for (const TracerObject& object : geometry.objects())
            built->objects.push_back(std::make_shared<const WideObject<width>>(
                build_object<width>(object, TreeBuilder::bvh)));
        return in_arena(
            threads, [built, &geometry] { build_top(*built, std::span(geometry.instances), {}); });
    });
    const auto embree =
        std::make_shared<EmbreeRebuild>(EmbreeRebuild::of_instances(geometry, threads));
    out.embree = [embree] { embree->rebuild(); };
    return out;
}

BenchScene instanced_field(int count) {
    TestScene scene{fmt::format("field_{}", count), {sphere_mesh(4, 5, 0.5f)}, {}};
    Random random(8);
    for (int i = 0; i < count; ++i)
        scene.instances.push_back(
            {0, translate(mat4(1), uniform_point(random, {vec3(0), vec3(170, 1, 170)}))});
    return {std::move(scene), {}};
}

}  // namespace

nlohmann::json bench_build(const std::vector<std::string>& names, const BuildBenchConfig& config) {
    const int all_threads = std::max(2, int(std::thread::hardware_concurrency()));
    std::vector<BenchScene> scenes;
    for (const std::string& name : names) scenes.push_back(load_bench_scene(name));

    print_heading(config.repetitions);
    nlohmann::json results = nlohmann::json::array();
    const auto time = [&](const Contest& contest) {
        contest.ours();  // what comes first would pay for the process
        results.push_back(time_builds(contest, config.repetitions));
        print_build(results.back());
    };
    const auto time_scene = [&](const BenchScene& scene) {
        for (const int threads : {1, all_threads}) time(whole_scene(scene, threads));
    };
    std::vector<std::size_t> entry_of_scene;
    for (const BenchScene& scene : scenes) {
        entry_of_scene.push_back(results.size());
        time_scene(scene);
    }
    // What is built for every frame.
    const BenchScene deforming{scene_of("deforming_64k", sphere_mesh(180, 179, 1)), {}};
    for (const RTCBuildQuality quality : {RTC_BUILD_QUALITY_LOW, RTC_BUILD_QUALITY_REFIT})
        for (const int threads : {1, all_threads})
            time(deforming_mesh(deforming, quality, threads));
    for (const BenchScene& field : {instanced_field(661), load_bench_scene("sunflowers")}) {
        time_scene(field);
        for (const int threads : {1, all_threads}) time(top_level(field, threads));
    }

    print_strategy_heading();
    for (std::size_t i = 0; i < scenes.size(); ++i) {
        const nlohmann::json strategies = bench_strategies(scenes[i], config.view);
        if (!strategies.is_null()) results[entry_of_scene[i]]["strategies"] = strategies;
    }
    return results;
}

}  // namespace tessera
