// Points in fixed point: as few bits for each coordinate as keep it within an error that is asked
// for, counted from the bounds of all. Each array stands for itself: what is put elsewhere thirty
// times a second is never waited for (a difference to the one before would have to be).
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

struct PackedPoints {
    std::uint64_t count = 0;
    vec3 lo{0};  ///< coordinates are lo + step * integer
    vec3 step{0};
    uvec3 bits{1};    ///< of the integer, 1 to 24
    float error = 0;  ///< the most by which a coordinate is off
    std::vector<std::byte> packed;
};

/// `error`: more than 0. What cannot be kept that close in 24 bits is off by more, and says so.
PackedPoints pack(std::span<const vec3> points, float error);

/// Throws std::runtime_error when there are not as many bytes as the points need.
std::vector<vec3> unpack(const PackedPoints& points);

}  // namespace tessera
