#include "worker/wide_tree.h"

#include <algorithm>

namespace tessera {
namespace {

/// What the collapse must know of each kd-node.
struct Content {
    Box box;                             ///< of the items' parts in the cell
    bool small = false;                  ///< becomes one leaf
    std::uint32_t first = 0, count = 0;  ///< of a small node's items
};

template <int width>
class Collapse {
public:
    Collapse(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size,
             std::uint32_t leaf_limit, const MakeLeaf& make_leaf)
        : tree_(tree),
          clipped_(clipped),
          leaf_size_(leaf_size),
          leaf_limit_(leaf_limit),
          make_leaf_(make_leaf),
          contents_(tree.nodes.size()) {}

    WideTree<width> run() {
        gather(0, tree_.bounds);
        out_.bounds = tree_.bounds;
        fill(0, 0);
        return std::move(out_);
    }

private:
    /// Finds the contents of a kd-node and all below it. Lists of small nodes lie in lists_ one
    /// after another, so that a parent's follow its children's.
    void gather(std::uint32_t node, const Box& cell) {
        const KdNode& kd = tree_.nodes[node];
        Content& content = contents_[node];
        content.first = std::uint32_t(lists_.size());
        if (kd.is_leaf()) {
            for (const std::uint32_t item : tree_.items_of(kd)) {
                content.box.add(clipped_(item, cell));
                lists_.push_back(item);
            }
            content.small = true;
            content.count = kd.item_count();
            return;
        }
        Box lower = cell, upper = cell;
        lower.hi[kd.axis()] = upper.lo[kd.axis()] = kd.position();
        gather(kd.lower_child(), lower);
        gather(kd.lower_child() + 1, upper);
        const Content &a = contents_[kd.lower_child()], &b = contents_[kd.lower_child() + 1];
        content.box = a.box;
        content.box.add(b.box);
        if (a.small && b.small) merge(content, a, b);
    }

    /// Makes one leaf of two that fit in one.
    void merge(Content& content, const Content& a, const Content& b) {
        const auto list = lists_.begin();
        std::vector<std::uint32_t> both;
        std::set_union(list + a.first, list + a.first + a.count, list + b.first,
                       list + b.first + b.count, std::back_inserter(both));
        if (both.size() > leaf_size_) return;
        content.small = true;
        content.count = std::uint32_t(both.size());
        // Nothing looks at the children again.
        lists_.resize(content.first);
        lists_.insert(lists_.end(), both.begin(), both.end());
    }

    /// The kd-nodes that become the children: the largest is opened until all lanes are taken.
    std::vector<std::uint32_t> descend(std::uint32_t node) const {
        std::vector<std::uint32_t> found{node};
        const auto area = [&](std::uint32_t n) {
            return contents_[n].small ? -1.0f : contents_[n].box.area();
        };
        while (true) {
            std::erase_if(found, [&](std::uint32_t n) { return contents_[n].box.empty(); });
            const auto largest = std::ranges::max_element(found, {}, area);
            if (largest == found.end() || contents_[*largest].small || found.size() == width)
                return found;
            const std::uint32_t lower = tree_.nodes[*largest].lower_child();
            *largest = lower;
            found.push_back(lower + 1);
        }
    }

    void fill(std::uint32_t slot, std::uint32_t node) {
        const std::vector<std::uint32_t> children = descend(node);
        WideNode<width> wide;
        std::vector<std::pair<std::uint32_t, std::uint32_t>> inner;  // slot, kd-node
        for (std::size_t i = 0; i < children.size(); ++i) {
            const Content& content = contents_[children[i]];
            if (content.small) {
                set_child(wide, i, content.box, leaf(content.box, items_of(content)));
            } else {
                inner.emplace_back(new_node(), children[i]);
                set_child(wide, i, content.box, WideLink::node(inner.back().first));
            }
        }
        out_.nodes[slot] = wide;
        for (const auto& [child_slot, child] : inner) fill(child_slot, child);
    }

    static void set_child(WideNode<width>& wide, std::size_t lane, const Box& box, WideLink link) {
        for (int k = 0; k < 3; ++k) {
            wide.bounds[k][0][lane] = box.lo[k];
            wide.bounds[k][1][lane] = box.hi[k];
        }
        wide.children[lane] = link;
    }

    std::uint32_t new_node() {
        out_.nodes.emplace_back();
        return std::uint32_t(out_.nodes.size() - 1);
    }

    std::span<const std::uint32_t> items_of(const Content& content) const {
        return {lists_.data() + content.first, content.count};
    }

    /// A leaf, or a node of leaves when there are too many items for one.
    WideLink leaf(const Box& box, std::span<const std::uint32_t> items) {
        if (items.size() <= leaf_limit_) return make_leaf_(items);
        const std::uint32_t slot = new_node();
        WideNode<width> wide;
        const std::size_t part = (items.size() + width - 1) / width;
        for (std::size_t i = 0; i * part < items.size(); ++i) {
            const std::size_t count = std::min(part, items.size() - i * part);
            set_child(wide, i, box, leaf(box, items.subspan(i * part, count)));
        }
        out_.nodes[slot] = wide;
        return WideLink::node(slot);
    }

    const KdTree& tree_;
    const ClippedBounds& clipped_;
    std::uint32_t leaf_size_, leaf_limit_;
    const MakeLeaf& make_leaf_;
    std::vector<Content> contents_;
    std::vector<std::uint32_t> lists_;
    WideTree<width> out_;
};

}  // namespace

template <int width>
WideTree<width> collapse(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size,
                         std::uint32_t leaf_limit, const MakeLeaf& make_leaf) {
    return Collapse<width>(tree, clipped, leaf_size, leaf_limit, make_leaf).run();
}

template WideTree<4> collapse(const KdTree&, const ClippedBounds&, std::uint32_t, std::uint32_t,
                              const MakeLeaf&);
template WideTree<8> collapse(const KdTree&, const ClippedBounds&, std::uint32_t, std::uint32_t,
                              const MakeLeaf&);
template WideTree<16> collapse(const KdTree&, const ClippedBounds&, std::uint32_t, std::uint32_t,
                               const MakeLeaf&);

}  // namespace tessera
