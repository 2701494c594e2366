// tessera-sim: `tessera bench cluster --simulate`. A program of its own, because it drives the
// server's insides, which no client links.

#include <fmt/format.h>

#include <CLI/CLI.hpp>
#include <fstream>
#include <nlohmann/json.hpp>

#include "common/check.h"
#include "server/sim/plans.h"

namespace tessera {
namespace {

struct Options {
    bool quick = false;
    unsigned schedules = 1000;
    std::string json;
};

/// Returns how many broke a law.
unsigned try_schedules(unsigned schedules) {
    unsigned broken = 0;
    std::uint64_t tiles = 0;
    for (unsigned seed = 0; seed < schedules; ++seed) {
        const SimReport report = simulate(random_cluster(seed));
        tiles += report.tiles;
        if (report.broken.empty()) continue;
        ++broken;
        fmt::print("schedule {}: {}\n", seed, report.broken.front());
    }
    fmt::print("{} random fault schedules, {} tiles: {} broke a law\n", schedules, tiles, broken);
    return broken;
}

nlohmann::json json_of(const Plan& plan) {
    nlohmann::json json = {{"name", plan.name},
                           {"figure", plan.figure},
                           {"value", plan.value},
                           {"reached", plan.reached()},
                           {"workers", plan.config.workers},
                           {"tile_seconds", plan.config.tile_seconds},
                           {"round_trip_seconds", plan.config.round_trip},
                           {"seconds", plan.report.seconds},
                           {"ideal_seconds", plan.report.ideal_seconds},
                           {"tiles", plan.report.tiles},
                           {"rendered", plan.report.rendered},
                           {"share_cut", plan.share_cut()},
                           {"most_leases", plan.report.most_leases},
                           {"server_load", plan.report.server_load}};
    if (plan.goal) json["goal"] = *plan.goal;
    return json;
}

/// Returns whether all goals are reached.
bool print_plans(const std::vector<Plan>& plans) {
    fmt::print("{:<50} {:>9} {:>9} {:>8} {:>5} {:>7} {:>7}  {:<12} {:>7} {:>7}\n", "1920x1080",
               "frame/s", "ideal/s", "rendered", "cut", "leases", "server", "figure", "value",
               "goal");
    bool all = true;
    for (const Plan& plan : plans) {
        const double frames = double(plan.report.frame_seconds.size());
        fmt::print(
            "{:<50} {:>9.2f} {:>9.2f} {:>7.2f}x {:>4.0f}% {:>7} {:>6.0f}%  {:<12} {:>7.3f} "
            "{:>7} {}\n",
            plan.name, frames / plan.report.seconds, frames / plan.report.ideal_seconds,
            plan.report.rendered / double(plan.report.tiles), 100 * plan.share_cut(),
            plan.report.most_leases, 100 * plan.report.server_load, plan.figure, plan.value,
            plan.goal ? fmt::format("{:.3f}", *plan.goal) : "", plan.reached() ? "" : "missed");
        for (const std::string& law : plan.report.broken) fmt::print("  {}\n", law);
        all = all && plan.reached() && plan.report.broken.empty();
    }
    return all;
}

bool run(const Options& options) {
    const std::vector<Plan> plans = simulate_plans(options.quick ? Plans::quick : Plans::all);
    const bool reached = print_plans(plans);
    const unsigned broken = try_schedules(options.schedules);
    if (!options.json.empty()) {
        nlohmann::json json = {{"version", TESSERA_VERSION},
                               {"schedules", options.schedules},
                               {"schedules_broken", broken},
                               {"results", nlohmann::json::array()}};
        for (const Plan& plan : plans) json["results"].push_back(json_of(plan));
        std::ofstream out(options.json);
        out << json.dump(2) << '\n';
        if (!out.flush()) throw UserError(fmt::format("cannot write {}", options.json));
    }
    return reached && broken == 0;
}

}  // namespace
}  // namespace tessera

int main(int argc, char** argv) {
    using namespace tessera;
    Options options;
    CLI::App app("Simulates clusters of any size in virtual time, driving the real scheduler.",
                 "tessera bench cluster --simulate");
    app.add_flag("--quick", options.quick, "no cluster of more than 1000 workers");
    app.add_option("--schedules", options.schedules, "random fault schedules to try")
        ->capture_default_str();
    app.add_option("--json", options.json, "write the results to this file, too");
    CLI11_PARSE(app, argc, argv);
    try {
        return run(options) ? EXIT_SUCCESS : EXIT_FAILURE;
    } catch (const std::exception& error) {
        fmt::print(stderr, "tessera: {}\n", error.what());
        return EXIT_FAILURE;
    }
}
