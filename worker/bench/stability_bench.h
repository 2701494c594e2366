// `tessera bench stability`: rays that are hard on a tracer, and how many of them it answers
// wrongly by the verdict of an exact argument or of double precision; ours beside Embree, as it is
// by default and with its ROBUST flag.
#pragma once

#include <cstdint>
#include <nlohmann/json_fwd.hpp>

namespace tessera {

struct StabilityBenchConfig {
    std::uint64_t rays = 200'000;       ///< of each case
    std::uint64_t edge_rays = 200'000;  ///< of the cases that aim at shared edges and vertices
};

/// Prints a table as it goes; returns the entries of `results`.
nlohmann::json bench_stability(const StabilityBenchConfig& config);

}  // namespace tessera
