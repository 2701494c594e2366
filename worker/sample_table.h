// The first points of many samplers, made together in SIMD: a third of what a pixel cost went into
// making them one by one.
#pragma once

#include "worker/sampling.h"

namespace tessera {

/// Samplers of one index that differ in their seeds: Sampler(index, hash(seed, numbers[i])), each
/// with its first `pairs` points at hand. Outlives the samplers that it hands out.
class SampleTable {
public:
    SampleTable(std::uint32_t index, std::uint32_t seed, std::span<const std::uint32_t> numbers,
                std::uint32_t pairs);

    Sampler operator[](std::size_t i) const {
        return {index_, hash(seed_, numbers_[i]), std::span(points_).subspan(i * pairs_, pairs_)};
    }

private:
    std::uint32_t index_;
    std::uint32_t seed_;
    std::uint32_t pairs_;
    std::vector<std::uint32_t> numbers_;
    std::vector<vec2> points_;  ///< of one sampler after the other
};

}  // namespace tessera
