// A server that is killed again and again while a script edits and a viewer looks: is every edit
// that was acknowledged there afterwards, and how soon does the viewer see a picture again?
#pragma once

#include <cstdint>
#include <functional>
#include <vector>

#include "client/local_cluster.h"

namespace tessera {

struct RestartBenchConfig {
    LocalClusterConfig cluster;  ///< with a journal
    int kills = 20;
    double down_seconds = 0;  ///< that the server stays away
    std::uint32_t seed = 1;
    /// Called now and then with the kills so far; may throw to end it.
    std::function<void(int)> tick = [](int) {};
};

struct RestartReport {
    int kills = 0;
    std::uint64_t edits = 0;  ///< acknowledged
    std::uint64_t lost = 0;   ///< of those, not there after a restart
    std::vector<double> acknowledge_seconds;
    /// From starting the server again to its listening, and to the first whole picture at the
    /// viewer.
    std::vector<double> start_seconds, picture_seconds;
};

/// Adds to `report` as it goes, so that it holds what there is when `tick` throws. Throws
/// UserError.
void bench_restarts(const RestartBenchConfig& config, RestartReport& report);

}  // namespace tessera
