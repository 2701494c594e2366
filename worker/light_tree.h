// Chooses among many lights by what each can send to a place: a binary tree over the lights, walked
// from the root by the bounds of each half's light (Conty Estevez and Kulla, "Importance Sampling
// of Many Lights with Adaptive Tree Splitting", 2018). We differ in halving the lights along their
// longest extent, and in taking one light at a time.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "worker/sampling.h"

namespace tessera {

/// Where some lights are and how they shine.
struct LightBounds {
    Box box;
    vec3 axis{0, 0, 1};    ///< middle of the lights' normals, unit
    float cos_spread = 1;  ///< no normal is farther from the axis; -1: lights shine all around
    float power = 0;
};

class LightTree {
public:
    LightTree() = default;
    explicit LightTree(std::span<const LightBounds> lights);

    bool empty() const { return nodes_.empty(); }
    const LightBounds& bounds(std::uint32_t index) const {
        return nodes_[leaf_of_light_[index]].bounds;
    }
    /// All lights, each beside its neighbours.
    std::vector<std::uint32_t> order() const;
    /// The same tree, of which sample() takes none of these lights.
    LightTree without(std::span<const std::uint32_t> lights) const;
    /// Nothing when no light can reach `p`; 0 <= u < 1. Not when empty.
    std::optional<Distribution::Choice> sample(const vec3& p, float u) const;
    /// Chance that sample() takes light `index`.
    float probability(const vec3& p, std::uint32_t index) const;

private:
    struct Node {
        LightBounds bounds;
        std::uint32_t parent = 0;
        std::uint32_t child = 0;  ///< the first of two neighbours; 0: a light
        std::uint32_t light = 0;
    };

    void build(std::uint32_t node, std::span<std::uint32_t> order,
               std::span<const LightBounds> lights);
    float chance_of_first(std::uint32_t child, const vec3& p) const;

    std::vector<Node> nodes_;  ///< from the root; siblings side by side
    std::vector<std::uint32_t> leaf_of_light_;
};

}  // namespace tessera
