// The builder for trees that are wanted at once: a bounding volume hierarchy by the surface area
// heuristic over bins.
//
// Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007).
#pragma once

#include "worker/box_tree.h"
#include "worker/raw_vector.h"

namespace tessera {

/// Bounds of an item; finite.
struct alignas(16) BoxRef {
    vec3 lo;
    std::uint32_t item;
    vec3 hi;
    std::uint32_t unused;  ///< fills a register
};
static_assert(sizeof(BoxRef) == 32);

struct BvhConfig {
    std::uint32_t block_size = 1;  ///< items that are tested at once: splits leave full blocks
    std::uint32_t leaf_size = 1;   ///< what holds no more is not split
};

/// Builds a tree in parallel on the caller's oneTBB arena. It is the same for any number of
/// threads, but for the order in which its nodes lie.
BoxTree build_bvh(RawVector<BoxRef> refs, const BvhConfig& config);

}  // namespace tessera
