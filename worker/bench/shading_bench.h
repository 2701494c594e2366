// What programmable shading costs (Wald 2004, table 13.1): a scene whose every surface wears a
// shader, against the same scene plain.
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <string>
#include <vector>

namespace tessera {

struct ShadingBenchConfig {
    int width = 240;
    int repetitions = 5;
    std::vector<std::uint32_t> vpls{1, 4, 8, 32};
};

/// Prints a row for each number of virtual point lights.
nlohmann::json bench_shading(const std::vector<std::string>& scenes,
                             const ShadingBenchConfig& config);

}  // namespace tessera
