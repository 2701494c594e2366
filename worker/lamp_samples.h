// Points on lamps for many receivers at once, in SIMD: the common case of Lights::sample() and of
// what igi.cpp makes of it, where every light is a triangle of one radiance, chosen by power, and
// receivers reflect diffusely.
#pragma once

#include <array>
#include <cstddef>
#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

/// A triangle that shines; floats only, for gathering.
struct Lamp {
    vec3 p0, p1, p2;
    vec3 ng;  ///< of the front, unit
    vec3 off_front;
    vec3 radiance;
    float area;
    float two_sided;  ///< 1 or 0
    float probability;
};
static_assert(sizeof(Lamp) == 21 * sizeof(float));

struct LampTable {
    std::vector<Lamp> lamps;
    std::vector<float> cumulative;  ///< of their probabilities, from 0 to 1: one more than lamps
};

/// What receivers want, and what they get.
struct LampRequests {
    static constexpr std::size_t capacity = 256;
    using Column = std::array<float, capacity>;

    alignas(64) Column p[3], n[3], ng[3];  ///< place, shading normal, geometric normal
    Column throughput[3];                  ///< scales what the receiver gets
    Column u_choice[2], u_place[2];        ///< numbers in [0, 1)

    Column end[3];  ///< where the shadow ray to the lamp ends
    Column e[3];    ///< what arrives unless it is blocked; zero where there is no lamp to trace to
};

struct LampSampling {
    std::size_t candidates = 1;     ///< of which one is taken by what it would contribute
    float max_geometry = infinity;  ///< nearer lamps leave a share to scattered rays
};

/// Answers the first `count` requests. The same bits on every instruction set.
void sample_lamps(const LampTable& table, const LampSampling& sampling, std::size_t count,
                  LampRequests& requests);

}  // namespace tessera
