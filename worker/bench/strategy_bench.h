// What the building strategies of Wald's thesis are worth (2004, tables 7.4 and 7.5): kd-trees and
// the steps of rays through them, counted.
#pragma once

#include <nlohmann/json_fwd.hpp>

#include "worker/bench/bench_scene.h"

namespace tessera {

void print_strategy_heading();

/// Measures each strategy with the rays of a square view of `view` pixels' side, and prints a row
/// of it. Null for a scene of too many triangles.
nlohmann::json bench_strategies(const BenchScene& scene, int view);

}  // namespace tessera
