// Times, medians and spreads.
#pragma once

#include <time.h>

#include <algorithm>
#include <chrono>
#include <vector>

namespace tessera {

/// CPU seconds of the calling thread: does not count what other processes do.
inline double thread_seconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

inline double wall_seconds() {
    return std::chrono::duration<double>(std::chrono::steady_clock::now().time_since_epoch())
        .count();
}

inline double median(std::vector<double> values) {
    const auto middle = values.begin() + std::ptrdiff_t(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

/// Median of repeated runs, and the median of their distances to it.
struct Spread {
    double median = 0;
    double mad = 0;

    double relative() const { return mad / median; }
};

inline Spread spread_of(const std::vector<double>& values) {
    const double middle = median(values);
    std::vector<double> distances;
    for (const double value : values) distances.push_back(std::abs(value - middle));
    return {middle, median(std::move(distances))};
}

}  // namespace tessera
