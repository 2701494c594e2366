// The laws of a cluster under faults, in virtual time: every frame is finished as long as one
// worker lives, every tile is counted once, and the pixels are right. TESSERA_SCHEDULES sets how
// many random fault schedules are tried.

#include "server/sim/cluster_sim.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>

#include "server/sim/plans.h"

namespace tessera {
namespace {

TEST(ClusterSim, laws_hold_under_random_faults) {
    const char* wanted = std::getenv("TESSERA_SCHEDULES");
    const unsigned schedules = wanted ? unsigned(std::atoi(wanted)) : 1000;
    std::uint64_t quarters = 0;
    for (unsigned seed = 0; seed < schedules; ++seed) {
        const SimReport report = simulate(random_cluster(seed));
        ASSERT_TRUE(report.broken.empty()) << "schedule " << seed << ", " << report.broken.front();
        quarters += report.quarters;
    }
    EXPECT_GT(quarters, 10 * schedules);
}

TEST(ClusterSim, frames_in_flight_share_the_workers) {
    for (unsigned seed = 0; seed < 10; ++seed) {
        SimConfig config;
        config.workers = 4;
        config.slowness = {1, 1, 1, 2};
        config.size = {256, 192};
        config.frames = 96;
        config.in_flight = 16;
        config.tile_seconds = 0.002;
        config.seed = seed;
        const SimReport report = simulate(config);
        ASSERT_TRUE(report.broken.empty()) << report.broken.front();
        std::vector<double> seconds = report.frame_seconds;
        std::sort(seconds.begin(), seconds.end());
        const double median = seconds[seconds.size() / 2];
        EXPECT_LT(seconds.back(), 1.3 * median) << seed;
        EXPECT_GT(report.efficiency(), 0.97) << seed;
    }
}

TEST(ClusterSim, goals_are_reached) {
    for (const Plan& plan : simulate_plans(Plans::small)) {
        EXPECT_TRUE(plan.report.broken.empty()) << plan.report.broken.front();
        EXPECT_TRUE(plan.reached()) << plan.name << ": " << plan.figure << ' ' << plan.value;
    }
}

}  // namespace
}  // namespace tessera
