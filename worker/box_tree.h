// A binary tree of boxes over items: what the builders make (worker/bvh.h, worker/kdtree.h) and
// what becomes a wide tree (worker/wide_tree.h).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

struct BoxNode {
    Box box;                     ///< of the items' parts below
    std::uint32_t children = 0;  ///< the first of two neighbours; 0: a leaf
    std::uint32_t first = 0;     ///< the items below are a run of BoxTree::items
    std::uint32_t count = 0;

    bool is_leaf() const { return children == 0; }
};

/// Node 0 is the root.
struct BoxTree {
    std::vector<BoxNode> nodes{1};
    std::vector<std::uint32_t> items;
    bool repeats = false;  ///< an item may lie in many leaves, each of which bounds a part of it

    std::span<const std::uint32_t> items_of(const BoxNode& node) const {
        return std::span(items).subspan(node.first, node.count);
    }
};

/// No leaf of a BoxTree lies deeper.
inline constexpr int box_tree_max_depth = 96;

}  // namespace tessera
