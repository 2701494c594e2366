// `tessera bench trace`: how fast rays are traced, ours beside Embree's best, in one process on one
// thread. The two take turns on small blocks of the same rays, so that what else the machine does
// meets both alike.
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <string>
#include <vector>

#include "worker/kdtree_tracer.h"

namespace tessera {

/// Names of the kinds of rays that there are.
std::vector<std::string> ray_kind_names();

struct TraceBenchConfig {
    int view = 1024;      ///< width and height of the view in pixels; a multiple of 64
    int repetitions = 7;  ///< of everything; the median counts
    int vpls = 16;
    std::vector<std::string> kinds = ray_kind_names();
    bool incoherent = false;  ///< never tell Embree that rays are coherent
    bool flatten = false;     ///< trace all instances as one object, without a level above
    TreeBuilder builder = TreeBuilder::bvh;
};

/// Prints a table as it goes; returns the entries of `results`.
nlohmann::json bench_trace(const std::vector<std::string>& scenes, const TraceBenchConfig& config);

}  // namespace tessera
