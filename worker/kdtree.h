// The kd-tree: 8-byte nodes over lists of items, built by the surface area heuristic in O(N log N)
// with clipped ("perfect") splits.
//
// Wald and Havran, "On building fast kd-Trees for Ray Tracing, and on doing that in O(N log N)"
// (2006); node layout after Wald, "Realtime Ray Tracing and Interactive Global Illumination"
// (2004), 7.2.1. It is there to be measured (`tessera bench build`, `tessera bench trace
// --kdtree`): worker/bvh.h builds what is rendered.
#pragma once

#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "worker/box_tree.h"

namespace tessera {

/// Inner node: split axis and position; children are adjacent, the lower one first. Leaf: a run of
/// KdTree::items.
class KdNode {
public:
    static KdNode inner(int axis, float position, std::uint32_t lower_child);
    static KdNode leaf(std::uint32_t first_item, std::uint32_t item_count);

    bool is_leaf() const { return (link_ & 3) == 3; }
    int axis() const { return int(link_ & 3); }
    float position() const { return position_; }
    std::uint32_t lower_child() const { return link_ >> 2; }
    std::uint32_t first_item() const { return link_ >> 2; }
    std::uint32_t item_count() const { return count_; }

    /// The same node when what it links to moved by `offset`.
    KdNode moved(std::uint32_t offset) const;

private:
    std::uint32_t link_ = 3;  ///< bits 0-1: axis, or 3 for a leaf; bits 2-31: child or first item
    union {
        float position_;
        std::uint32_t count_ = 0;
    };
};
static_assert(sizeof(KdNode) == 8);

/// Nodes are in depth-first order; the root is node 0, node 1 is unused, so that children come in
/// pairs that start at even indices and share a cache line.
struct KdTree {
    std::vector<KdNode> nodes;
    std::vector<std::uint32_t> items;  ///< leaves with equal lists share one
    Box bounds;                        ///< of all items

    std::span<const std::uint32_t> items_of(const KdNode& leaf) const {
        return {items.data() + leaf.first_item(), leaf.item_count()};
    }
};

/// No leaf lies deeper: what a traversal stack must hold.
inline constexpr int kdtree_max_depth = box_tree_max_depth;

/// How split planes are chosen. All but the first are there to be measured against it (Wald 2004,
/// 7.3 and table 7.4); they stop at Kaplan's limits: three items, or 25 levels.
enum class KdStrategy : std::uint8_t {
    sah,            ///< surface area heuristic
    round_robin,    ///< Kaplan's: the middle, of x, y and z in turn
    middle,         ///< the middle of the longest axis
    plane_shifter,  ///< the same; where that cuts off emptiness, as much of it as there is
};

struct KdCosts {
    float traversal = 1;       ///< of one inner node
    float intersection = 1;    ///< of one item
    float empty_bonus = 0.8f;  ///< factor on the cost of splits that cut off empty space
    KdStrategy strategy = KdStrategy::sah;
};

/// Bounds of the part of `item` that lies in a cell: conservative, inside the cell, empty for items
/// to leave out. Called from many threads.
using ClippedBounds = std::function<Box(std::uint32_t item, const Box& cell)>;

/// Builds a tree over the items 0 .. count - 1, in parallel on the caller's oneTBB arena. The tree
/// is the same bits for any number of threads.
KdTree build_kdtree(std::uint32_t count, const ClippedBounds& clipped, const KdCosts& costs);

/// The same tree with boxes: those of its contents, clipped to its cells, so that it is a kd-tree
/// no longer but a tree of spatial splits (Stich, Friedrich and Dietrich, "Spatial Splits in
/// Bounding Volume Hierarchies", 2009). `clipped` is what it was built with; subtrees of up to
/// `leaf_size` different items become one leaf.
BoxTree boxes_of(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size);

}  // namespace tessera
