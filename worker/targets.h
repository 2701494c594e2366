// Points that shadow rays from many origins go to, prepared once: a tile's.
#pragma once

#include <array>
#include <bit>
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
    /// The points again by their place in the group: [axis][place][group]. Places without a finite
    /// point repeat another of the group.
    alignas(64) float by_place[3][group_size][max_groups];

private:
    void repair_group(std::size_t g);
};

inline Targets::Targets(std::span<const vec3> points) {
    for (std::size_t i = 0; i < points.size(); ++i) {
        for (int k = 0; k < 3; ++k) p[k][i] = points[i][k];
        if (is_finite(points[i])) set(finite, i);
    }
    for (std::size_t g = 0; g < max_groups; ++g)
        if (finite[g] != 0xffff) repair_group(g);
    for (int k = 0; k < 3; ++k)
        for (std::size_t i = 0; i < group_size; ++i)
            for (std::size_t g = 0; g < max_groups; ++g)
                by_place[k][i][g] = p[k][g * group_size + i];
}

inline void Targets::repair_group(std::size_t g) {
    const std::size_t first = g * group_size;
    for (std::size_t i = first; i < first + group_size; ++i) {
        const std::size_t sound = finite[g] ? first + std::size_t(std::countr_zero(finite[g])) : i;
        for (int k = 0; k < 3; ++k)
            if (!has(finite, i)) p[k][i] = finite[g] ? p[k][sound] : 0;
    }
}

}  // namespace tessera
