// The light half of `tessera bench stability`: scenes that are hard on light transport, igi held
// against the path tracer or against what is known of them.
#pragma once

#include <cstdint>
#include <nlohmann/json_fwd.hpp>

namespace tessera {

struct LightStabilityConfig {
    std::uint32_t passes = 64;  ///< of each of the 8 igi pictures; of path's four times as many
};

/// Prints a table as it goes; returns the entries of `results`: means of igi and of what is
/// expected, the standard error of their difference, and counts of values that were not finite.
nlohmann::json bench_light_stability(const LightStabilityConfig& config);

}  // namespace tessera
