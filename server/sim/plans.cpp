#include "server/sim/plans.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace tessera {
namespace {

/// Frames one after the other: the first is learnt from, the efficiency is that of all.
SimConfig full_hd(std::uint32_t workers, double tile_seconds) {
    SimConfig config;
    config.workers = workers;
    config.size = {1920, 1080};
    config.tile_seconds = tile_seconds;
    config.frames = 3;
    return config;
}

Plan efficiency_of(const std::string& name, const SimConfig& config, std::optional<double> goal) {
    Plan plan{.name = name, .figure = "efficiency", .config = config, .report = simulate(config)};
    plan.value = plan.report.efficiency();
    plan.goal = goal;
    return plan;
}

/// The same twice: with whole tiles only, and with tiles cut where the scheduler thinks that it
/// pays, which must not be worse, give or take a hundredth.
void add_both(const std::string& name, SimConfig config, std::optional<double> goal,
              std::vector<Plan>& plans) {
    const double fineness = std::exchange(config.scheduler.fineness, 0);
    const Plan whole = efficiency_of(name + ", none cut", config, {});
    config.scheduler.fineness = fineness;
    plans.push_back(efficiency_of(name, config, std::max(goal.value_or(0), whole.value - 0.01)));
    plans.push_back(whole);
}

/// Of eight workers one is ten times slower: frame time against the ideal split.
Plan one_slow() {
    SimConfig config = full_hd(8, 0.01);
    config.slowness = {10};
    Plan plan{.name = "one of 8 is 10 times slower",
              .figure = "time / ideal",
              .config = config,
              .report = simulate(config)};
    plan.value = 1 / plan.report.efficiency();
    plan.goal = 1.15;
    plan.more_is_better = false;
    return plan;
}

/// One of eight fails in the middle of a frame: how much later the frame is than it would be had
/// the seven others gone on without losing anything.
Plan one_fails(const std::string& name, Mishap mishap) {
    SimConfig config = full_hd(8, 0.01);
    config.frames = 2;
    const std::vector<double> times = simulate(config).frame_seconds;
    const double first = times.front(), undisturbed = times.back();
    config.faults = {{.mishap = mishap, .worker = 3, .at = first + undisturbed / 2}};
    Plan plan{.name = name, .figure = "s later", .config = config, .report = simulate(config)};
    const double without_loss = undisturbed / 2 + undisturbed / 2 * 8 / 7;
    plan.value = plan.report.frame_seconds.back() - without_loss;
    plan.goal = std::chrono::duration<double>(config.scheduler.shortest_lease).count() +
                config.tile_seconds;
    plan.more_is_better = false;
    return plan;
}

}  // namespace

std::vector<Plan> simulate_plans(Plans wanted) {
    const std::uint32_t most_workers = wanted == Plans::small   ? 48
                                       : wanted == Plans::quick ? 1000
                                                                : 10000;
    std::vector<Plan> plans;
    for (const std::uint32_t workers : {48u, 1000u, 10000u}) {
        if (workers > most_workers) continue;
        for (const double tile_seconds : {0.01, 0.0005}) {
            const std::optional<double> goal =
                workers == 48 ? std::optional(tile_seconds > 0.001 ? 0.97 : 0.90) : std::nullopt;
            const std::string name =
                fmt::format("{} workers, {:g} ms tiles", workers, 1e3 * tile_seconds);
            const SimConfig config = full_hd(workers, tile_seconds);
            if (workers <= 1000 && wanted != Plans::small)
                add_both(name, config, goal, plans);
            else
                plans.push_back(efficiency_of(name, config, goal));
        }
    }
    for (const std::uint32_t workers : {48u, 96u}) {
        SimConfig config = full_hd(workers, 0.01);
        config.threads = 4;
        config.size = {640, 480};
        config.frames = 6;
        add_both(fmt::format("{} workers of 4 threads, 640x480, 10 ms", workers), config, {},
                 plans);
    }
    if (wanted != Plans::small) {
        SimConfig two_frames = full_hd(1000, 0.01);
        two_frames.in_flight = 2;
        two_frames.frames = 8;
        plans.push_back(
            efficiency_of("1000 workers, 10 ms tiles, two frames in flight", two_frames, {}));
    }
    plans.push_back(one_slow());
    plans.push_back(one_fails("one of 8 is killed in mid-frame", Mishap::death));
    plans.push_back(one_fails("one of 8 hangs in mid-frame", Mishap::hang));
    return plans;
}

}  // namespace tessera
