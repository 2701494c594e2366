#include "worker/bench/build_bench.h"

#include <nlohmann/json.hpp>
namespace tessera {
nlohmann::json bench_build(const std::vector<std::string>&, const BuildBenchConfig&) { return {}; }
}  // namespace tessera
