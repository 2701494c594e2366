// What the tiles of a picture cost, learnt from frame to frame: the next frame from nearly the same
// place costs nearly the same (Wald 2004, 8.1.2 names the uneven cost of tiles as what spoils
// static subdivision). Pure.
#pragma once

#include <cstdint>
#include <deque>
#include <vector>

#include "common/tile.h"

namespace tessera {

/// Relative costs of a picture's tiles; 1 is the mean.
class CostMap {
public:
    /// All tiles cost the same.
    explicit CostMap(std::uint32_t tiles = 0) : measured_(tiles) {}
    /// As predicted by `before`.
    explicit CostMap(std::vector<float> before)
        : predicted_(std::move(before)), measured_(predicted_.size()) {}

    /// Whether there was a frame to learn from.
    bool is_known() const { return !predicted_.empty(); }
    float predicted(std::uint32_t tile) const { return predicted_.empty() ? 1 : predicted_[tile]; }
    void measure(std::uint32_t tile, float cost);
    /// Tiles in the order to render them: expensive ones first, in the order of the picture among
    /// those of much the same cost.
    std::vector<std::uint32_t> order() const;
    /// What has been measured, normalised; empty unless every tile has been.
    std::vector<float> learnt() const;

private:
    std::vector<float> predicted_;  ///< empty: all the same
    std::vector<float> measured_;   ///< 0: not yet
};

/// The costs of the last few frames.
class CostMemory {
public:
    void keep(const FrameSpec& spec, const CostMap& costs);
    /// From the frame of the same scene, size and integrator whose camera was nearest.
    CostMap recall(const FrameSpec& spec) const;

private:
    struct Entry {
        FrameSpec spec;
        std::vector<float> costs;
    };
    std::deque<Entry> entries_;  ///< newest first
};

}  // namespace tessera
