// Points that shadow rays from many origins go to, prepared once: a tile's.
#pragma once

#include <array>
#include <bit>
#include <cstdint>
#include <cstring>
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
    void take_group(std::size_t g, std::span<const vec3> points);
    void repair_group(std::size_t g);
    void place_groups(std::size_t first);
};

// Four lanes, as GCC and Clang have them: one by one, points of small scenes took a tenth of the
// time of rays to them.
namespace targets_detail {

using Float4 = float __attribute__((vector_size(16)));
using Int4 = std::int32_t __attribute__((vector_size(16)));

inline Float4 load(const float* p) {
    Float4 v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
inline void store(Float4 v, float* p) { std::memcpy(p, &v, sizeof v); }

inline void transpose(Float4 (&rows)[4]) {
    const Float4 a = __builtin_shufflevector(rows[0], rows[1], 0, 4, 1, 5);
    const Float4 b = __builtin_shufflevector(rows[0], rows[1], 2, 6, 3, 7);
    const Float4 c = __builtin_shufflevector(rows[2], rows[3], 0, 4, 1, 5);
    const Float4 d = __builtin_shufflevector(rows[2], rows[3], 2, 6, 3, 7);
    rows[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5);
    rows[1] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
    rows[2] = __builtin_shufflevector(b, d, 0, 1, 4, 5);
    rows[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
}

}  // namespace targets_detail

inline Targets::Targets(std::span<const vec3> points) {
    for (std::size_t g = 0; g < max_groups; ++g) {
        take_group(g, points.subspan(std::min(points.size(), g * group_size)));
        if (finite[g] != 0xffff) repair_group(g);
    }
    for (std::size_t first = 0; first < max_groups; first += 4) place_groups(first);
}

/// From the points that there are, up to the size of a group.
inline void Targets::take_group(std::size_t g, std::span<const vec3> points) {
    using namespace targets_detail;
    const std::size_t first = g * group_size;
    if (points.size() < group_size) {
        for (std::size_t i = 0; i < points.size(); ++i) {
            for (int k = 0; k < 3; ++k) p[k][first + i] = points[i][k];
            if (is_finite(points[i])) set(finite, first + i);
        }
        return;
    }
    Int4 sound = {-1, -1, -1, -1};
    for (std::size_t i = 0; i < group_size; i += 4) {
        // The last of four is not followed by a point, maybe.
        Float4 rows[4] = {load(&points[i].x), load(&points[i + 1].x), load(&points[i + 2].x),
                          load(&points[i + 2].z)};
        rows[3] = __builtin_shufflevector(rows[3], rows[3], 1, 2, 3, 3);
        transpose(rows);
        for (int k = 0; k < 3; ++k) {
            sound &= rows[k] - rows[k] == Float4{};
            store(rows[k], p[k] + first + i);
        }
    }
    if (sound[0] & sound[1] & sound[2] & sound[3]) {
        finite[g] = 0xffff;
        return;
    }
    for (std::size_t i = 0; i < group_size; ++i)
        if (is_finite(points[i])) set(finite, first + i);
}

/// By their places, those of four groups.
inline void Targets::place_groups(std::size_t first) {
    using namespace targets_detail;
    for (int k = 0; k < 3; ++k) {
        for (std::size_t i = 0; i < group_size; i += 4) {
            Float4 rows[4];
            for (std::size_t j = 0; j < 4; ++j) rows[j] = load(p[k] + (first + j) * group_size + i);
            transpose(rows);
            for (std::size_t j = 0; j < 4; ++j) store(rows[j], by_place[k][i + j] + first);
        }
    }
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
