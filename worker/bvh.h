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

/// Builds a tree in parallel on the caller's oneTBB arena; the same bits for any number of threads.
/// Leaves hold up to `leaf_size` items, a power of two, and tend to be full: a part-filled SIMD
/// block costs what a full one does.
BoxTree build_bvh(RawVector<BoxRef> refs, std::uint32_t leaf_size);

}  // namespace tessera
