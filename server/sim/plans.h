// What clusters of other sizes than ours would do: efficiencies and recoveries in virtual time,
// held against the goals of the project.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "server/sim/cluster_sim.h"

namespace tessera {

/// One simulated cluster and the figure that it is about.
struct Plan {
    std::string name;
    std::string figure;  ///< what `value` is
    SimConfig config;
    SimReport report;
    double value = 0;
    std::optional<double> goal = {};  ///< at least for an efficiency, at most for anything else
    bool more_is_better = true;

    /// Of what has been rendered, in quarters.
    double share_cut() const { return double(report.quarters) / quarters / report.rendered; }
    bool reached() const { return !goal || (more_is_better ? value >= *goal : value <= *goal); }
};

enum class Plans : std::uint8_t {
    small,  ///< those with a goal
    quick,  ///< and of a thousand workers
    all,
};
std::vector<Plan> simulate_plans(Plans plans);

}  // namespace tessera
