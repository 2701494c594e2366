// Trees of many children a node, so that one SIMD step decides them all: made from binary ones.
//
// Wald, Benthin and Boulos, "Getting Rid of Packets" (2008) collapse binary trees by a greedy
// descent; here the nodes and leaves that cost least by the surface area heuristic are found, by
// dynamic programming, as by Ylitie, Karras and Laine, "Efficient Incoherent Ray Traversal on GPUs
// Through Compressed Wide BVHs" (2017). We differ in that leaves are cut into SIMD blocks, of which
// each costs the same.
#pragma once

#include <functional>

#include "worker/box_tree.h"

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
    void set_child(int lane, const Box& box, WideLink link);
};

/// Node 0 is the root.
template <int width>
struct WideTree {
    std::vector<WideNode<width>> nodes{1};
    Box bounds;
};

/// What a traversal stack must hold.
template <int width>
inline constexpr int wide_stack_size = (box_tree_max_depth + 8) * width;

/// Stores a leaf's items, in at most WideLink::max_count units; returns where. Leaves of a node are
/// stored one after another, neighbours next to each other.
using MakeLeaf = std::function<WideLink(std::span<const std::uint32_t> items)>;

/// What visits cost: a ray pays for a wide node, and for each block of items of a leaf.
struct WideCosts {
    float node = 1;
    float block = 1;
    std::uint32_t block_size = 1;                    ///< items
    std::uint32_t max_blocks = WideLink::max_count;  ///< of a leaf
};

/// Collapses `tree` so that it costs least; every run of its items that becomes a leaf goes through
/// `make_leaf`, one after another.
template <int width>
WideTree<width> collapse(const BoxTree& tree, const WideCosts& costs, const MakeLeaf& make_leaf);

extern template WideTree<4> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);
extern template WideTree<8> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);
extern template WideTree<16> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);

template <int width>
WideNode<width>::WideNode() {
    for (auto& [lo, hi] : bounds) {
        std::fill_n(lo, width, infinity);
        std::fill_n(hi, width, -infinity);
    }
}

template <int width>
void WideNode<width>::set_child(int lane, const Box& box, WideLink link) {
    for (int k = 0; k < 3; ++k) {
        bounds[k][0][lane] = box.lo[k];
        bounds[k][1][lane] = box.hi[k];
    }
    children[lane] = link;
}

}  // namespace tessera
