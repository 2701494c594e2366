// Points that shadow rays from many origins go to, prepared once: a tile's.
#pragma once

#include <array>
#include <span>

#include "common/math.h"

namespace tessera {

/// A bit for each of 256 rays: bit i of entry g is ray 16 g + i.
using RayMask = std::array<std::uint16_t, 16>;

inline bool has(const RayMask& mask, std::size_t i) { return mask[i / 16] >> (i % 16) & 1; }
inline void set(RayMask& mask, std::size_t i) {
    mask[i / 16] = std::uint16_t(mask[i / 16] | 1u << (i % 16));
}

/// Up to 256 points in groups of 16. Fastest where the points of a group lie close together: a
/// tile's pixels in blocks of 4 x 4.
struct Targets {
    static constexpr int group_size = 16;
    static constexpr int max_groups = 16;
    static constexpr int max_count = group_size * max_groups;

    /// Nothing blocks rays to points that are not finite.
    explicit Targets(std::span<const vec3> points);

    vec3 point(std::size_t i) const { return {p[0][i], p[1][i], p[2][i]}; }

    RayMask finite{};
    alignas(64) float p[3][max_count] = {};
    /// Bounds of each group's finite points.
    alignas(64) float lo[3][max_groups];
    alignas(64) float hi[3][max_groups];
};

inline Targets::Targets(std::span<const vec3> points) {
    Box boxes[max_groups];
    for (std::size_t i = 0; i < points.size(); ++i) {
        if (!is_finite(points[i])) continue;
        set(finite, i);
        for (int k = 0; k < 3; ++k) p[k][i] = points[i][k];
        boxes[i / group_size].add(points[i]);
    }
    for (int g = 0; g < max_groups; ++g)
        for (int k = 0; k < 3; ++k) lo[k][g] = boxes[g].lo[k], hi[k][g] = boxes[g].hi[k];
}

}  // namespace tessera
