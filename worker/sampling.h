// Sample points and the warps that turn them into directions and places.
//
// The sequence is the Owen-scrambled Sobol (0,2)-sequence, padded to higher dimensions by giving
// each pair of dimensions its own shuffling and scrambling: Kollig and Keller, "Efficient
// Multidimensional Sampling" (2002), with the hash-based scrambling of Burley, "Practical
// Hash-based Owen Scrambling" (2020). Every number is a function of integers only, so any machine
// makes the same. We differ from Burley in using Vegdahl's improved hash constants and in computing
// the second Sobol dimension by five shifts (it is Pascal's triangle modulo 2, a Kronecker power).
//
// A warp `sample_x(u)` maps the unit square to x with the density `x_pdf`.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

/// A well mixing bijection of 32 bits (Wellons, "Prospecting for Hash Functions", 2018).
inline std::uint32_t hash(std::uint32_t x) {
    x ^= x >> 16;
    x *= 0x7feb352d;
    x ^= x >> 15;
    x *= 0x846ca68b;
    x ^= x >> 16;
    return x;
}

inline std::uint32_t hash(std::uint32_t a, std::uint32_t b) { return hash(hash(a) + b); }

/// A number in [0, 1) from the upper 24 bits.
inline float unit_float(std::uint32_t bits) { return float(bits >> 8) * 0x1p-24f; }

inline std::uint32_t reverse_bits(std::uint32_t x) {
    x = (x & 0x55555555) << 1 | (x >> 1 & 0x55555555);
    x = (x & 0x33333333) << 2 | (x >> 2 & 0x33333333);
    x = (x & 0x0f0f0f0f) << 4 | (x >> 4 & 0x0f0f0f0f);
    return __builtin_bswap32(x);
}

/// The lower 16 bits of a number at the even places of another.
inline std::uint32_t spread_bits(std::uint32_t x) {
    x &= 0xffff;
    x = (x | x << 8) & 0x00ff00ff;
    x = (x | x << 4) & 0x0f0f0f0f;
    x = (x | x << 2) & 0x33333333;
    return (x | x << 1) & 0x55555555;
}

/// Owen's nested uniform scrambling of a number whose bits are reversed: each bit is flipped by a
/// hash of the bits below it (Laine and Karras 2011; constants by Vegdahl).
inline std::uint32_t scramble_reversed(std::uint32_t x, std::uint32_t seed) {
    x ^= x * 0x3d20adea;
    x += seed;
    x *= (seed >> 16) | 1;
    x ^= x * 0x05526c56;
    x ^= x * 0x53a22864;
    return x;
}

/// Second dimension of the Sobol sequence, bits reversed.
inline std::uint32_t sobol_1_reversed(std::uint32_t index) {
    index ^= index >> 16;
    index ^= (index & 0xff00ff00) >> 8;
    index ^= (index & 0xf0f0f0f0) >> 4;
    index ^= (index & 0xcccccccc) >> 2;
    index ^= (index & 0xaaaaaaaa) >> 1;
    return index;
}

/// A point as the bits of its two numbers.
struct SobolBits {
    std::uint32_t x = 0, y = 0;
};

/// Point `index` of the dimension pair that the seed `s` stands for.
inline SobolBits sobol_bits(std::uint32_t index, std::uint32_t s) {
    const std::uint32_t shuffled = reverse_bits(scramble_reversed(reverse_bits(index), s));
    const std::uint32_t x = scramble_reversed(shuffled, hash(s ^ 0x68bc21eb));
    const std::uint32_t y = scramble_reversed(sobol_1_reversed(shuffled), hash(s ^ 0x02e5be93));
    return {reverse_bits(x), reverse_bits(y)};
}

/// What round `round` flips in the points of a dimension pair, a point itself: nothing in round 0.
inline SobolBits digital_shift(std::uint32_t round, std::uint32_t s) {
    return round == 0 ? SobolBits{} : sobol_bits(round - 1, hash(s ^ 0x967a889b));
}

/// Point `index` of dimension pair `pair` of the sequence `seed`, shifted by `round`. Rounds of one
/// point are as well distributed as points of one round.
inline vec2 sobol_point(std::uint32_t index, std::uint32_t pair, std::uint32_t seed,
                        std::uint32_t round = 0) {
    const std::uint32_t s = hash(seed, pair);
    const SobolBits point = sobol_bits(index, s), shift = digital_shift(round, s);
    return {unit_float(point.x ^ shift.x), unit_float(point.y ^ shift.y)};
}

/// Deals out the dimensions of one point of a sequence, two at a time.
class Sampler {
public:
    /// `made`: its first points, where somebody has made them already (worker/sample_table.h).
    Sampler(std::uint32_t index, std::uint32_t seed, std::uint32_t round = 0,
            std::span<const vec2> made = {})
        : made_(made), index_(index), seed_(seed), round_(round) {}

    vec2 next() {
        const std::uint32_t pair = pair_++;
        return pair < made_.size() ? made_[pair] : sobol_point(index_, pair, seed_, round_);
    }

private:
    std::span<const vec2> made_;
    std::uint32_t index_;
    std::uint32_t seed_;
    std::uint32_t round_;
    std::uint32_t pair_ = 0;
};

/// Concentric map of the square to the unit disc (Shirley and Chiu, "A Low Distortion Map Between
/// Disk and Square", 1997); pdf 1/pi.
inline vec2 sample_disc(const vec2& u) {
    const vec2 p = 2.0f * u - 1.0f;
    if (p.x == 0 && p.y == 0) return {0, 0};
    const bool wide = std::abs(p.x) > std::abs(p.y);
    const float r = wide ? p.x : p.y;
    const float phi = wide ? pi / 4 * (p.y / p.x) : pi / 2 - pi / 4 * (p.x / p.y);
    return r * vec2(std::cos(phi), std::sin(phi));
}

/// Directions around +z, proportional to the cosine (Malley's method).
inline vec3 sample_cosine_hemisphere(const vec2& u) {
    const vec2 d = sample_disc(u);
    return {d, std::sqrt(std::max(0.0f, 1 - dot(d, d)))};
}
inline float cosine_hemisphere_pdf(float cosine) { return std::max(cosine, 0.0f) / pi; }

/// Directions within the angle of cosine `cos_max` around +z, uniform by solid angle.
inline vec3 sample_cone(const vec2& u, float cos_max) {
    const float z = 1 - u.x * (1 - cos_max);
    const float r = std::sqrt(std::max(0.0f, 1 - z * z));
    return {r * std::cos(2 * pi * u.y), r * std::sin(2 * pi * u.y), z};
}
inline float cone_pdf(float cos_max) { return 1 / (2 * pi * (1 - cos_max)); }

inline vec3 sample_sphere(const vec2& u) { return sample_cone(u, -1); }
inline constexpr float sphere_pdf = 1 / (4 * pi);

/// Uniform barycentric weights of the second and third vertex (Heitz, "A Low-Distortion Map Between
/// Triangle and Square", 2019).
inline vec2 sample_triangle(const vec2& u) {
    const vec2 b = 0.5f * u;
    const float offset = b.y - b.x;
    return offset > 0 ? vec2(b.x, b.y + offset) : vec2(b.x - offset, b.y);
}

/// Weight of the strategy with density a > 0 against one with density b; either may be infinite
/// (Veach and Guibas, "Optimally Combining Sampling Techniques for Monte Carlo Rendering", 1995).
inline float power_heuristic(float a, float b) {
    const float ratio = b / a;
    return 1 / (1 + ratio * ratio);
}

/// Chooses among n things in proportion to their weights; what has no weight is never chosen.
class Distribution {
public:
    struct Choice {
        std::uint32_t index = 0;
        float probability = 0;
        float u = 0;  ///< uniform again, for further use
    };

    Distribution() = default;
    /// Weights that are negative or not finite count as zero.
    explicit Distribution(std::span<const float> weights);

    /// Whether nothing can be chosen.
    bool empty() const { return cumulative_.empty(); }
    /// Call only when not empty; 0 <= u < 1.
    Choice sample(float u) const;
    float probability(std::uint32_t index) const {
        return cumulative_[index + 1] - cumulative_[index];
    }
    /// Sums of the probabilities, from 0 to 1: one more than there are things.
    std::span<const float> cumulative() const { return cumulative_; }

private:
    std::vector<float> cumulative_;
};

inline Distribution::Distribution(std::span<const float> weights) {
    const auto usable = [](float w) { return std::isfinite(w) && w > 0 ? double(w) : 0.0; };
    double total = 0;
    for (const float w : weights) total += usable(w);
    if (total <= 0) return;
    cumulative_.reserve(weights.size() + 1);
    cumulative_.push_back(0);
    double sum = 0;
    for (const float w : weights) cumulative_.push_back(float((sum += usable(w)) / total));
}

inline Distribution::Choice Distribution::sample(float u) const {
    // The last sum is exactly 1, so that there is always one above u.
    const auto above = std::upper_bound(cumulative_.begin(), cumulative_.end(), u);
    const auto index = std::uint32_t(above - cumulative_.begin() - 1);
    const float p = probability(index);
    return {index, p, std::min((u - cumulative_[index]) / p, 0x1.fffffep-1f)};
}

}  // namespace tessera
