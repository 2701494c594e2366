#include "worker/kdtree.h"

#include <tbb/enumerable_thread_specific.h>
#include <tbb/parallel_for.h>
#include <tbb/parallel_invoke.h>
#include <tbb/parallel_sort.h>

#include <array>
#include <bit>
#include <numeric>
#include <optional>
#include <unordered_map>

#include "common/check.h"

namespace tessera {

KdNode KdNode::inner(int axis, float position, std::uint32_t lower_child) {
    KdNode node;
    node.link_ = lower_child << 2 | std::uint32_t(axis);
    node.position_ = position;
    return node;
}

KdNode KdNode::leaf(std::uint32_t first_item, std::uint32_t item_count) {
    KdNode node;
    node.link_ = first_item << 2 | 3;
    node.count_ = item_count;
    return node;
}

KdNode KdNode::moved(std::uint32_t offset) const {
    KdNode node = *this;
    node.link_ += offset << 2;
    return node;
}

namespace {

/// A face of an item's box, as one integer that sorts by position, axis, kind and item.
using Event = std::uint64_t;

/// In the order in which a sweep must meet them at one position.
enum class Kind : std::uint32_t { end, planar, start };

constexpr std::uint32_t max_items = 1u << 28;  // what an Event has bits for

/// Maps floats to integers of the same order.
std::uint32_t ordered_bits(float x) {
    const auto bits = std::bit_cast<std::uint32_t>(x + 0.0f);  // -0 becomes +0
    return bits & 0x80000000 ? ~bits : bits | 0x80000000;
}

Event make_event(float position, int axis, Kind kind, std::uint32_t item) {
    return Event(ordered_bits(position)) << 32 | Event(axis) << 30 | Event(kind) << 28 | item;
}
float position_of(Event e) {
    const auto bits = std::uint32_t(e >> 32);
    return std::bit_cast<float>(bits & 0x80000000 ? bits & 0x7fffffff : ~bits);
}
int axis_of(Event e) { return int(e >> 30 & 3); }
Kind kind_of(Event e) { return Kind(e >> 28 & 3); }
std::uint32_t item_of(Event e) { return std::uint32_t(e & (max_items - 1)); }
/// Equal for events in one plane.
std::uint64_t plane_of(Event e) { return e >> 30; }

void add_events(std::vector<Event>& events, std::uint32_t item, const Box& box) {
    for (int axis = 0; axis < 3; ++axis) {
        if (box.lo[axis] == box.hi[axis]) {
            events.push_back(make_event(box.lo[axis], axis, Kind::planar, item));
        } else {
            events.push_back(make_event(box.lo[axis], axis, Kind::start, item));
            events.push_back(make_event(box.hi[axis], axis, Kind::end, item));
        }
    }
}

/// Calls `f` once for each item that `events` tell of.
template <class F>
void for_each_item(const std::vector<Event>& events, F&& f) {
    for (const Event e : events)
        if (axis_of(e) == 0 && kind_of(e) != Kind::end) f(item_of(e));
}

struct Split {
    int axis = -1;
    float position = 0;
    bool planar_below = true;  ///< items in the plane go to the lower child
    double cost = std::numeric_limits<double>::infinity();
};

/// Weighs the split planes of one cell.
class CostModel {
public:
    CostModel(const Box& cell, std::uint32_t count, const KdCosts& costs)
        : cell_(cell), count_(count), costs_(costs) {
        const glm::dvec3 e(cell.extent());
        for (int k = 0; k < 3; ++k) {
            const double a = e[(k + 1) % 3], b = e[(k + 2) % 3];
            face_[k] = a * b;
            rim_[k] = a + b;
        }
        area_ = face_[0] + rim_[0] * e.x;
    }

    double leaf_cost() const { return double(costs_.intersection) * count_; }

    /// Takes the plane into `best` if it is cheaper: `below`, `planar` and `above` items lie on its
    /// sides and in it.
    void consider(Split& best, int axis, float position, std::uint32_t below, std::uint32_t planar,
                  std::uint32_t above) const {
        const float lo = cell_.lo[axis], hi = cell_.hi[axis];
        if (lo < position && position < hi) {
            take(best, axis, position, true, below + planar, above);
            if (planar > 0) take(best, axis, position, false, below, above + planar);
        } else if (planar > 0 && planar < count_) {
            // A plane on the cell's border gives the items in it a flat cell of their own.
            if (position == lo) take(best, axis, position, true, planar, above);
            if (position == hi) take(best, axis, position, false, below, planar);
        }
    }

private:
    void take(Split& best, int axis, float position, bool planar_below, std::uint32_t below,
              std::uint32_t above) const {
        const double area_below = face_[axis] + (double(position) - cell_.lo[axis]) * rim_[axis];
        const double area_above = face_[axis] + (double(cell_.hi[axis]) - position) * rim_[axis];
        double cost = costs_.traversal +
                      costs_.intersection * (area_below * below + area_above * above) / area_;
        if (below == 0 || above == 0) cost *= costs_.empty_bonus;
        // A cell that is a line or a point has no area; NaN is not cheaper.
        if (cost < best.cost) best = {axis, position, planar_below, cost};
    }

    Box cell_;
    std::uint32_t count_;
    KdCosts costs_;
    double face_[3], rim_[3];  ///< half the area of a slab of width w is face + w * rim
    double area_;
};

/// One sweep over all planes of all axes.
Split best_split(const CostModel& model, const std::vector<Event>& events, std::uint32_t count) {
    Split best;
    std::uint32_t below[3] = {0, 0, 0};
    std::uint32_t above[3] = {count, count, count};
    for (std::size_t i = 0; i < events.size();) {
        const Event first = events[i];
        const int axis = axis_of(first);
        std::uint32_t of_kind[3] = {0, 0, 0};
        for (; i < events.size() && plane_of(events[i]) == plane_of(first); ++i)
            ++of_kind[int(kind_of(events[i]))];
        const auto [ends, planars, starts] = of_kind;
        above[axis] -= planars + ends;
        model.consider(best, axis, position_of(first), below[axis], planars, above[axis]);
        below[axis] += starts + planars;
    }
    return best;
}

/// What Kaplan and his followers choose, who look at no costs.
std::optional<Split> middle_split(KdStrategy strategy, const Box& cell,
                                  const std::vector<Event>& events, std::uint32_t count,
                                  int depth) {
    constexpr std::uint32_t enough_items = 3;
    constexpr int deep_enough = 25;
    if (count <= enough_items || depth >= deep_enough) return std::nullopt;
    const vec3 e = cell.extent();
    const int longest = e.x >= e.y ? (e.x >= e.z ? 0 : 2) : (e.y >= e.z ? 1 : 2);
    Split split;
    split.axis = strategy == KdStrategy::round_robin ? depth % 3 : longest;
    split.position = cell.centre()[split.axis];
    if (strategy == KdStrategy::plane_shifter) {
        const auto on_axis = [&](Event event) { return axis_of(event) == split.axis; };
        const float first = position_of(*std::ranges::find_if(events, on_axis));
        const float last = position_of(*std::find_if(events.rbegin(), events.rend(), on_axis));
        split.planar_below = first <= split.position;  // else all items lie above, flat ones too
        split.position = std::min(std::max(split.position, first), last);
    }
    if (!(cell.lo[split.axis] < split.position && split.position < cell.hi[split.axis]))
        return std::nullopt;
    return split;
}

enum Side : std::uint8_t { lower, upper, both };

/// A cell on its way to become a node: its items as events, sorted.
struct Cell {
    Box box;
    std::uint32_t count = 0;
    std::vector<Event> events;
};

/// Nodes and items of a part of the tree, linked relative to its own start.
struct Subtree {
    std::vector<KdNode> nodes{2};
    std::vector<std::uint32_t> items;
};

class Builder {
public:
    Builder(std::uint32_t count, const ClippedBounds& clipped, const KdCosts& costs)
        : clipped_(clipped), costs_(costs), sides_([count] { return std::vector<Side>(count); }) {}

    /// Fills `out.nodes[slot]` and appends what is below it.
    void build(Subtree& out, std::uint32_t slot, Cell cell, int depth) {
        const std::optional<Split> choice = choose_split(cell, depth);
        if (!choice || depth == kdtree_max_depth) {
            make_leaf(out, slot, cell);
            return;
        }
        const Split split = *choice;
        auto cells = divide(std::move(cell), split);
        const auto children = std::uint32_t(out.nodes.size());
        out.nodes.resize(children + 2);
        out.nodes[slot] = KdNode::inner(split.axis, split.position, children);
        if (std::max(cells[0].count, cells[1].count) > parallel_items) {
            Subtree parts[2];
            tbb::parallel_invoke([&] { build(parts[0], 0, std::move(cells[0]), depth + 1); },
                                 [&] { build(parts[1], 0, std::move(cells[1]), depth + 1); });
            append(out, children, parts[0]);
            append(out, children + 1, parts[1]);
        } else {
            build(out, children, std::move(cells[0]), depth + 1);
            build(out, children + 1, std::move(cells[1]), depth + 1);
        }
        collapse_if_useless(out, slot);
    }

private:
    // Where subtrees are worth tasks. Decides who builds them; they come out the same either way.
    static constexpr std::uint32_t parallel_items = 4096;

    /// Nothing where a leaf is better.
    std::optional<Split> choose_split(const Cell& cell, int depth) const {
        if (costs_.strategy != KdStrategy::sah)
            return middle_split(costs_.strategy, cell.box, cell.events, cell.count, depth);
        const CostModel model(cell.box, cell.count, costs_);
        const Split split = best_split(model, cell.events, cell.count);
        return split.cost < model.leaf_cost() ? std::optional(split) : std::nullopt;
    }

    static void make_leaf(Subtree& out, std::uint32_t slot, const Cell& cell) {
        const std::size_t first = out.items.size();
        for_each_item(cell.events, [&](std::uint32_t item) { out.items.push_back(item); });
        std::sort(out.items.begin() + std::ptrdiff_t(first), out.items.end());
        out.nodes[slot] = KdNode::leaf(std::uint32_t(first), cell.count);
    }

    /// Moves `part` into `out`, its root to `slot`.
    static void append(Subtree& out, std::uint32_t slot, const Subtree& part) {
        const auto node_offset = std::uint32_t(out.nodes.size()) - 2;
        const auto item_offset = std::uint32_t(out.items.size());
        const auto moved = [&](const KdNode& n) {
            return n.moved(n.is_leaf() ? item_offset : node_offset);
        };
        out.nodes[slot] = moved(part.nodes[0]);
        std::transform(part.nodes.begin() + 2, part.nodes.end(), std::back_inserter(out.nodes),
                       moved);
        out.items.insert(out.items.end(), part.items.begin(), part.items.end());
    }

    /// Two leaves with the same items are one leaf (Wald 2004, 7.3.2).
    static void collapse_if_useless(Subtree& out, std::uint32_t slot) {
        const std::uint32_t children = out.nodes[slot].lower_child();
        const KdNode a = out.nodes[children], b = out.nodes[children + 1];
        if (!a.is_leaf() || !b.is_leaf() || a.item_count() != b.item_count()) return;
        const auto first = out.items.begin() + a.first_item();
        if (!std::equal(first, first + a.item_count(), out.items.begin() + b.first_item())) return;
        out.nodes[slot] = a;
        out.nodes.resize(children);
        out.items.resize(b.first_item());
    }

    /// The cells below and above the split.
    std::array<Cell, 2> divide(Cell cell, const Split& split) {
        Cell below{cell.box, 0, {}}, above{cell.box, 0, {}};
        below.box.hi[split.axis] = above.box.lo[split.axis] = split.position;
        std::vector<Side>& sides = sides_.local();
        classify(cell.events, split, sides);

        // Hand on the events of items on one side, in order; clip the others to both sides.
        below.events.resize(cell.events.size());
        above.events.resize(cell.events.size());
        std::size_t n_below = 0, n_above = 0;
        for (const Event e : cell.events) {
            const Side side = sides[item_of(e)];
            below.events[n_below] = e;
            above.events[n_above] = e;
            n_below += side == lower;
            n_above += side == upper;
        }
        below.events.resize(n_below);
        above.events.resize(n_above);
        std::vector<Event> cut_below, cut_above;
        for_each_item(cell.events, [&](std::uint32_t item) {
            below.count += sides[item] != upper;
            above.count += sides[item] != lower;
            if (sides[item] != both) return;
            add_events(cut_below, item, clip(item, below.box));
            add_events(cut_above, item, clip(item, above.box));
        });
        cell.events = {};
        merge_in(below.events, cut_below);
        merge_in(above.events, cut_above);
        return {std::move(below), std::move(above)};
    }

    static void classify(const std::vector<Event>& events, const Split& split,
                         std::vector<Side>& sides) {
        for_each_item(events, [&](std::uint32_t item) { sides[item] = both; });
        for (const Event e : events) {
            if (axis_of(e) != split.axis) continue;
            const float position = position_of(e);
            const Kind kind = kind_of(e);
            if (kind == Kind::planar && position == split.position)
                sides[item_of(e)] = split.planar_below ? lower : upper;
            else if (kind != Kind::start && position <= split.position)
                sides[item_of(e)] = lower;
            else if (kind != Kind::end && position >= split.position)
                sides[item_of(e)] = upper;
        }
    }

    Box clip(std::uint32_t item, const Box& box) const {
        const Box part = clipped_(item, box);
        DCHECK(!part.empty());
        return part;
    }

    static void merge_in(std::vector<Event>& events, std::vector<Event>& more) {
        if (more.empty()) {
            events.shrink_to_fit();  // it was sized for all of the parent's
            return;
        }
        std::sort(more.begin(), more.end());
        std::vector<Event> merged(events.size() + more.size());
        std::merge(events.begin(), events.end(), more.begin(), more.end(), merged.begin());
        events = std::move(merged);
    }

    const ClippedBounds& clipped_;
    KdCosts costs_;
    tbb::enumerable_thread_specific<std::vector<Side>> sides_;
};

/// All items' events and bounds; the events not sorted yet.
Cell whole_cell(std::uint32_t count, const ClippedBounds& clipped) {
    const Box everywhere{vec3(-infinity), vec3(infinity)};
    std::vector<Box> boxes(count);
    tbb::parallel_for(std::uint32_t(0), count,
                      [&](std::uint32_t item) { boxes[item] = clipped(item, everywhere); });
    Cell cell;
    cell.events.reserve(std::size_t(count) * 6);
    for (std::uint32_t item = 0; item < count; ++item) {
        if (boxes[item].empty()) continue;
        cell.box.add(boxes[item]);
        add_events(cell.events, item, boxes[item]);
        ++cell.count;
    }
    return cell;
}

/// Stores equal item lists once.
std::vector<std::uint32_t> share_lists(std::vector<KdNode>& nodes,
                                       const std::vector<std::uint32_t>& items) {
    std::vector<std::uint32_t> shared;
    std::unordered_multimap<std::uint64_t, KdNode> known;
    for (KdNode& node : nodes) {
        if (!node.is_leaf()) continue;
        const std::span list(items.data() + node.first_item(), node.item_count());
        const std::uint64_t hash = std::accumulate(
            list.begin(), list.end(), std::uint64_t(list.size()),
            [](std::uint64_t h, std::uint32_t item) { return (h ^ item) * 0x9e3779b97f4a7c15; });
        const auto [first, last] = known.equal_range(hash);
        const auto same = std::find_if(first, last, [&](const auto& entry) {
            const KdNode& other = entry.second;
            return std::ranges::equal(
                list, std::span(shared.data() + other.first_item(), other.item_count()));
        });
        if (same != last) {
            node = same->second;
        } else {
            node = KdNode::leaf(std::uint32_t(shared.size()), node.item_count());
            shared.insert(shared.end(), list.begin(), list.end());
            known.emplace(hash, node);
        }
    }
    return shared;
}

class Boxes {
public:
    Boxes(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size)
        : tree_(tree), clipped_(clipped), leaf_size_(leaf_size) {
        out_.repeats = true;
    }

    BoxTree run() {
        gather(0, 0, tree_.bounds);
        return std::move(out_);
    }

private:
    /// Finds the contents of a kd-node and all below it; a parent's items follow one another.
    void gather(std::uint32_t slot, std::uint32_t kd_slot, const Box& cell) {
        const KdNode& kd = tree_.nodes[kd_slot];
        BoxNode node{Box{}, 0, std::uint32_t(out_.items.size()), 0};
        if (kd.is_leaf()) {
            for (const std::uint32_t item : tree_.items_of(kd)) {
                node.box.add(clipped_(item, cell));
                out_.items.push_back(item);
            }
        } else {
            Box lower = cell, upper = cell;
            lower.hi[kd.axis()] = upper.lo[kd.axis()] = kd.position();
            node.children = std::uint32_t(out_.nodes.size());
            out_.nodes.resize(node.children + 2);
            gather(node.children, kd.lower_child(), lower);
            gather(node.children + 1, kd.lower_child() + 1, upper);
            node.box = out_.nodes[node.children].box;
            node.box.add(out_.nodes[node.children + 1].box);
            merge(node);
        }
        node.count = std::uint32_t(out_.items.size()) - node.first;
        out_.nodes[slot] = node;
    }

    /// Makes one leaf of two that fit in one.
    void merge(BoxNode& node) {
        const BoxNode a = out_.nodes[node.children], b = out_.nodes[node.children + 1];
        if (!a.is_leaf() || !b.is_leaf()) return;
        const auto items = out_.items.begin();
        std::vector<std::uint32_t> both;
        std::set_union(items + a.first, items + a.first + a.count, items + b.first,
                       items + b.first + b.count, std::back_inserter(both));
        if (both.size() > leaf_size_) return;
        out_.nodes.resize(node.children);
        node.children = 0;
        out_.items.resize(node.first);
        out_.items.insert(out_.items.end(), both.begin(), both.end());
    }

    const KdTree& tree_;
    const ClippedBounds& clipped_;
    std::uint32_t leaf_size_;
    BoxTree out_;
};

}  // namespace

KdTree build_kdtree(std::uint32_t count, const ClippedBounds& clipped, const KdCosts& costs) {
    CHECK(count <= max_items);
    Cell cell = whole_cell(count, clipped);
    tbb::parallel_sort(cell.events.begin(), cell.events.end());
    const Box bounds = cell.box;
    Subtree tree;
    if (cell.count > 0) Builder(count, clipped, costs).build(tree, 0, std::move(cell), 0);
    KdTree out{std::move(tree.nodes), {}, bounds};
    out.items = share_lists(out.nodes, tree.items);
    CHECK(out.nodes.size() < 1u << 30 && tree.items.size() < 1u << 30);
    return out;
}

BoxTree boxes_of(const KdTree& tree, const ClippedBounds& clipped, std::uint32_t leaf_size) {
    return Boxes(tree, clipped, leaf_size).run();
}

}  // namespace tessera
