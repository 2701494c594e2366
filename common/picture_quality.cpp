#include "common/picture_quality.h"

#include <algorithm>
#include <cmath>

namespace tessera {
namespace {

/// A picture in 1/25 s looks like motion; where answers take long anyway, it may take a share.
constexpr double shortest_budget = 0.04;
constexpr double share_of_round_trip = 0.25;
/// A file is about half as large with so much less quality.
constexpr double quality_per_halving = 20;
/// Quality rises slowly, and only when there is room: one that goes up and down is seen.
constexpr int rise = 3;
constexpr double room = 0.6;

}  // namespace

int next_jpeg_quality(int now, double transfer_seconds, double round_trip_seconds) {
    const double budget = shortest_budget + share_of_round_trip * std::max(round_trip_seconds, 0.0);
    const double load = transfer_seconds / budget;
    int next = now;
    if (load > 1)
        next = now - int(std::ceil(std::min(quality_per_halving * std::log2(load), 100.0)));
    else if (load < room)
        next = now + rise;
    return std::clamp(next, worst_jpeg_quality, best_jpeg_quality);
}

}  // namespace tessera
