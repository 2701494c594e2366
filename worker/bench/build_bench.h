// `tessera bench build`: how long trees take to build, ours beside Embree's HIGH quality; and what
// the building strategies of Wald's thesis are worth on these scenes (2004, tables 7.4 and 7.5).
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <string>
#include <vector>

namespace tessera {

struct BuildBenchConfig {
    int view = 512;       ///< width and height of the view whose rays count steps, in pixels
    int repetitions = 5;  ///< of each build; the median counts
};

/// Prints tables as it goes; returns the entries of `results`.
nlohmann::json bench_build(const std::vector<std::string>& scenes, const BuildBenchConfig& config);

}  // namespace tessera
