#include "worker/wide_tree.h"

#include <tbb/parallel_invoke.h>

#include <algorithm>
#include <memory>

namespace tessera {
namespace {

/// What a binary subtree costs at least as a forest of few trees, and how it is cut for that.
template <int width>
struct Forests {
    float cost[width];          ///< of up to i + 1 trees
    std::uint8_t below[width];  ///< so many of these are in the lower child; 0: one tree is best
    std::uint8_t node_below;    ///< the same of the children of a wide node
    bool leaf;                  ///< one tree is best a leaf
};

template <int width>
class Collapse {
public:
    Collapse(const BoxTree& tree, const WideCosts& costs, const MakeLeaf& make_leaf)
        : tree_(tree),
          costs_(costs),
          make_leaf_(make_leaf),
          forests_(std::make_unique_for_overwrite<Forests<width>[]>(tree.nodes.size())) {}

    WideTree<width> run() {
        out_.bounds = tree_.nodes[0].box;
        if (tree_.nodes[0].count > 0) {
            weigh(0);
            fill(0, 0);
        }
        out_.nodes.shrink_to_fit();
        return std::move(out_);
    }

private:
    /// Finds the cheapest forests of the node and of all below it.
    void weigh(std::uint32_t node) {
        constexpr std::uint32_t task_items = 4096;
        const BoxNode& binary = tree_.nodes[node];
        Forests<width>& forests = forests_[node];
        const float area = binary.box.area();
        const std::uint32_t blocks = (binary.count + costs_.block_size - 1) / costs_.block_size;
        const float leaf_cost = costs_.block * area * float(blocks);
        std::fill_n(forests.below, width, std::uint8_t(0));
        forests.leaf = true;
        if (binary.is_leaf()) {
            std::fill_n(forests.cost, width, leaf_cost);
            return;
        }
        const std::uint32_t lower = binary.children, upper = lower + 1;
        if (binary.count > task_items)
            tbb::parallel_invoke([&] { weigh(lower); }, [&] { weigh(upper); });
        else
            weigh(lower), weigh(upper);

        for (int trees = 2; trees <= width; ++trees) cut(forests, trees, lower, upper);
        forests.node_below = forests.below[width - 1];
        const float node_cost = costs_.node * area + forests.cost[width - 1];
        forests.leaf = blocks <= costs_.max_blocks && !(node_cost < leaf_cost);
        forests.cost[0] = forests.leaf ? leaf_cost : node_cost;
        for (int i = 1; i < width; ++i) {
            if (forests.cost[i] < forests.cost[0]) continue;
            forests.cost[i] = forests.cost[0];
            forests.below[i] = 0;
        }
    }

    /// Cuts a forest of so many trees between the children.
    void cut(Forests<width>& forests, int trees, std::uint32_t lower, std::uint32_t upper) const {
        const float *a = forests_[lower].cost, *b = forests_[upper].cost;
        float least = infinity;
        int best = 1;
        for (int i = 1; i < trees; ++i) {
            const float cost = a[i - 1] + b[trees - i - 1];
            if (cost < least) least = cost, best = i;
        }
        forests.cost[trees - 1] = least;
        forests.below[trees - 1] = std::uint8_t(best);
    }

    /// A binary node that becomes the child of a wide node.
    struct Child {
        std::uint32_t node;
        WideLink link = {};  ///< of leaves
    };
    struct Children {
        Child children[width];
        int count = 0;

        std::span<Child> all() { return {children, std::size_t(count)}; }
    };
    void gather(Children& children, std::uint32_t node, int trees, int below) const {
        if (below == 0) {
            children.children[children.count++] = {node};
            return;
        }
        const std::uint32_t lower = tree_.nodes[node].children, upper = lower + 1;
        gather(children, lower, below, forests_[lower].below[below - 1]);
        gather(children, upper, trees - below, forests_[upper].below[trees - below - 1]);
    }

    void fill(std::uint32_t slot, std::uint32_t node) {
        Children children;
        gather(children, node, width, forests_[node].leaf ? 0 : forests_[node].node_below);
        // Neighbours one after another, which may share what they are stored in.
        for (Child& child : children.all())
            if (forests_[child.node].leaf && !tree_.nodes[child.node].box.empty())
                child.link = leaf(tree_.nodes[child.node]);
        order(children.all());
        WideNode<width> wide;
        for (int i = 0; i < children.count; ++i) {
            const auto [child, link] = children.children[i];
            const Box& box = tree_.nodes[child].box;
            if (box.empty()) continue;
            wide.set_child(i, box, forests_[child].leaf ? link : WideLink::node(new_node()));
        }
        out_.nodes[slot] = wide;
        for (int i = 0; i < children.count; ++i) {
            const std::uint32_t child = children.children[i].node;
            if (!forests_[child].leaf) fill(wide.children[i].first(), child);
        }
    }

    /// Traversals that take lanes off a stack begin with the last. Any hit ends a shadow ray: first
    /// comes what it meets likely, for being large, and can search soon, for holding little.
    /// Measured against none, area and count alone, and leaves first: up to 40 % of the shadow
    /// rays' speed.
    void order(std::span<Child> children) const {
        std::ranges::stable_sort(children, {}, [&](const Child& child) {
            const BoxNode& binary = tree_.nodes[child.node];
            return binary.box.area() / std::sqrt(float(binary.count));
        });
    }

    std::uint32_t new_node() {
        out_.nodes.emplace_back();
        return std::uint32_t(out_.nodes.size() - 1);
    }

    WideLink leaf(const BoxNode& node) {
        const auto items = tree_.items_of(node);
        if (!tree_.repeats) return leaf(node.box, items);
        std::vector<std::uint32_t> once(items.begin(), items.end());
        std::ranges::sort(once);
        once.erase(std::unique(once.begin(), once.end()), once.end());
        return leaf(node.box, once);
    }

    /// A leaf, or a node of leaves when there are too many items for one.
    WideLink leaf(const Box& box, std::span<const std::uint32_t> items) {
        const std::size_t limit = std::size_t(costs_.max_blocks) * costs_.block_size;
        if (items.size() <= limit) return make_leaf_(items);
        const std::uint32_t slot = new_node();
        WideNode<width> wide;
        const std::size_t part = (items.size() + width - 1) / width;
        for (std::size_t i = 0; i * part < items.size(); ++i) {
            const std::size_t count = std::min(part, items.size() - i * part);
            wide.set_child(int(i), box, leaf(box, items.subspan(i * part, count)));
        }
        out_.nodes[slot] = wide;
        return WideLink::node(slot);
    }

    const BoxTree& tree_;
    WideCosts costs_;
    const MakeLeaf& make_leaf_;
    std::unique_ptr<Forests<width>[]> forests_;
    WideTree<width> out_;
};

}  // namespace

template <int width>
WideTree<width> collapse(const BoxTree& tree, const WideCosts& costs, const MakeLeaf& make_leaf) {
    return Collapse<width>(tree, costs, make_leaf).run();
}

template WideTree<4> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);
template WideTree<8> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);
template WideTree<16> collapse(const BoxTree&, const WideCosts&, const MakeLeaf&);

}  // namespace tessera
