#include "worker/bench/stability_bench.h"

#include <nlohmann/json.hpp>
namespace tessera {
nlohmann::json bench_stability(const StabilityBenchConfig&) { return {}; }
}  // namespace tessera
