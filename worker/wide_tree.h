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

/// What a child is, in 32 bits so that SIMD can move it: a node, or a run of whatever the leaves
/// hold.
class WideLink {
public:
    static constexpr std::uint32_t max_count = 31;
    static constexpr std::uint32_t max_first = (1u << 26) - 1;

    static WideLink node(std::uint32_t index) { return from_bits(index); }
    static WideLink leaf(std::uint32_t first, std::uint32_t count) {
        return from_bits(1u << 31 | count << 26 | first);
    }
    static WideLink from_bits(std::uint32_t bits) {
        WideLink link;
        link.bits_ = bits;
        return link;
    }

    bool is_leaf() const { return bits_ >> 31; }
    std::uint32_t first() const { return bits_ & max_first; }
    std::uint32_t count() const { return bits_ >> 26 & max_count; }

private:
    std::uint32_t bits_;
};

/// Free lanes have empty bounds, which no test meets.
template <int width>
struct alignas(4 * width) WideNode {
    float bounds[3][2][width];  ///< [axis][lo, hi]
    WideLink children[width] = {};

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
inline constexpr int wide_stack_size = (kdtree_max_depth + 8) * width;

/// Stores a leaf's items, in at most WideLink::max_count units; returns where.
using MakeLeaf = std::function<WideLink(std::span<const std::uint32_t> items)>;

/// Collapses `tree`. `clipped` is what it was built with; subtrees of up to `leaf_size` different
/// items become one leaf, which is cut in parts when it exceeds `leaf_limit`.
template <int width>
WideTree<width> collapse(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size,
                         std::uint32_t leaf_limit, const MakeLeaf& make_leaf);

extern template WideTree<4> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                     std::uint32_t, const MakeLeaf&);
extern template WideTree<8> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                     std::uint32_t, const MakeLeaf&);
extern template WideTree<16> collapse(const KdTree&, const ClippedBounds&, std::uint32_t,
                                      std::uint32_t, const MakeLeaf&);

template <int width>
WideNode<width>::WideNode() {
    for (auto& [lo, hi] : bounds) {
        std::fill_n(lo, width, infinity);
        std::fill_n(hi, width, -infinity);
    }
}

}  // namespace tessera
