// The kd-tree collapsed to nodes of many children, so that one SIMD step decides them all.
//
// Each wide node gathers the kd-tree's nodes that a greedy descent by surface area meets first, as
// Wald, Benthin and Boulos, "Getting Rid of Packets" (2008), collapse a BVH; a child's bounds are
// those of its contents, clipped to the kd-tree's cells. With that it is a kd-tree no longer but a
// wide tree of spatial splits (Stich, Friedrich and Dietrich, "Spatial Splits in Bounding Volume
// Hierarchies", 2009): it keeps the kd-tree's partition of space, in which what lies in two leaves
// is there twice, and gains boxes that fit.
#pragma once

#include <functional>

#include "worker/kdtree.h"

namespace tessera {

/// What a child is: a node, or `count` of whatever the leaves hold.
struct WideLink {
    std::uint32_t first = 0;
    std::uint32_t count = 0;  ///< 0 for a node

    bool is_leaf() const { return count > 0; }
};

/// Free lanes have empty bounds, which no test meets.
template <int width>
struct alignas(4 * width) WideNode {
    float bounds[3][2][width];  ///< [axis][lo, hi]
    WideLink children[width];

    WideNode();
};

/// Node 0 is the root.
template <int width>
struct WideTree {
    std::vector<WideNode<width>> nodes{1};
    Box bounds;
};

/// What a traversal stack must hold.
template <int width>
inline constexpr int wide_stack_size = kdtree_max_depth * (width - 1) + 1;

/// Stores a leaf's items; returns where.
using MakeLeaf = std::function<WideLink(std::span<const std::uint32_t> items)>;

/// Collapses `tree`. `clipped` is what it was built with; subtrees of up to `leaf_size` different
/// items become one leaf.
template <int width>
WideTree<width> collapse(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size,
                         const MakeLeaf& make_leaf);

extern template WideTree<4> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                     const MakeLeaf&);
extern template WideTree<8> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                     const MakeLeaf&);
extern template WideTree<16> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                      const MakeLeaf&);

template <int width>
WideNode<width>::WideNode() {
    for (auto& [lo, hi] : bounds) {
        std::fill_n(lo, width, infinity);
        std::fill_n(hi, width, -infinity);
    }
}

}  // namespace tessera
