// The first points of many samplers, made together in SIMD.
#pragma once

#include "worker/sampling.h"

namespace tessera {

/// Samplers of one seed and round that differ in their indices, each with its first `pairs` points
/// at hand. Outlives the samplers that it hands out.
class SampleTable {
public:
    /// Of a vector of any instruction set: indices are read by whole vectors.
    static constexpr std::size_t most_lanes = 16;

    SampleTable(std::vector<std::uint32_t> indices, std::uint32_t seed, std::uint32_t round,
                std::uint32_t pairs);

    Sampler operator[](std::size_t i) const {
        return {indices_[i], seed_, round_, std::span(points_).subspan(i * pairs_, pairs_)};
    }

private:
    std::vector<std::uint32_t> indices_;
    std::uint32_t seed_;
    std::uint32_t round_;
    std::uint32_t pairs_;
    std::vector<vec2> points_;  ///< of one sampler after the other
};

}  // namespace tessera
