// The laws of a cluster under faults, in virtual time: every frame is finished as long as one
// worker lives, every tile is counted once, and the pixels are right. TESSERA_SCHEDULES sets how
// many random fault schedules are tried.

#include "server/sim/cluster_sim.h"

#include <gtest/gtest.h>

#include <cstdlib>

#include "server/sim/plans.h"

namespace tessera {
namespace {

TEST(ClusterSim, laws_hold_under_random_faults) {
    const char* wanted = std::getenv("TESSERA_SCHEDULES");
    const unsigned schedules = wanted ? unsigned(std::atoi(wanted)) : 1000;
    for (unsigned seed = 0; seed < schedules; ++seed) {
        const SimReport report = simulate(random_cluster(seed));
        ASSERT_TRUE(report.broken.empty()) << "schedule " << seed << ", " << report.broken.front();
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
