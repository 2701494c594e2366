#include "worker/bvh.h"

#include <tbb/parallel_for.h>
#include <tbb/parallel_invoke.h>
#include <tbb/parallel_reduce.h>

#include <array>
#include <atomic>
#include <cstring>
#include <memory>

#include "common/check.h"

namespace tessera {
namespace {

// Vectors as GCC and Clang have them: the builder needs no more than four lanes of any machine.
using Float4 = float __attribute__((vector_size(16)));
using Int4 = std::int32_t __attribute__((vector_size(16)));

Float4 min(Float4 a, Float4 b) { return a < b ? a : b; }
Float4 max(Float4 a, Float4 b) { return a > b ? a : b; }
Float4 splat(float x) { return Float4{x, x, x, x}; }

/// A box in registers; what the fourth lanes hold does not matter.
struct Box4 {
    Float4 lo = splat(infinity);
    Float4 hi = splat(-infinity);

    void add(const Box4& b) {
        lo = min(lo, b.lo);
        hi = max(hi, b.hi);
    }
    void add(Float4 p) {
        lo = min(lo, p);
        hi = max(hi, p);
    }
    /// Half of it.
    float area() const {
        const Float4 e = hi - lo;
        return e[0] * (e[1] + e[2]) + e[1] * e[2];
    }
    Box box() const { return {{lo[0], lo[1], lo[2]}, {hi[0], hi[1], hi[2]}}; }
};

Float4 load(const float* p) {
    Float4 v;
    std::memcpy(&v, p, sizeof v);
    return v;
}
Box4 load(const BoxRef& ref) { return {load(&ref.lo.x), load(&ref.hi.x)}; }
Float4 centre(const Box4& b) {
    return splat(0.5f) * b.lo + splat(0.5f) * b.hi;  // each halved, lest the sum overflows
}

/// A run of refs on its way to become a node.
struct Range {
    std::size_t begin = 0, end = 0;
    Box4 box, centres;

    std::size_t size() const { return end - begin; }
    void add(const Box4& b) {
        box.add(b);
        centres.add(centre(b));
    }
    void add(const Range& other) {
        box.add(other.box);
        centres.add(other.centres);
    }
};

/// Maps centres to bins, equally wide between the outermost centres.
class Bins {
public:
    Bins(const Range& range, int count) : lo_(range.centres.lo) {
        constexpr float largest = std::numeric_limits<float>::max();
        const Float4 extent = range.centres.hi - lo_;
        for (int k = 0; k < 3; ++k) {
            // A little less, so that rounding leads to none beyond the last.
            const float scale = 0.9999f * float(count) / extent[k];
            if (extent[k] > 0 && scale <= largest) scale_[k] = scale;
            finite_ = finite_ && extent[k] <= largest;
        }
    }

    /// Else nothing is.
    bool finite() const { return finite_; }
    bool usable(int axis) const { return scale_[axis] > 0; }
    /// The bin on each axis; 0 where it is not usable for being too narrow.
    Int4 of(const Box4& box) const {
        return __builtin_convertvector((centre(box) - lo_) * scale_, Int4);
    }

private:
    Float4 lo_;
    Float4 scale_ = splat(0);
    bool finite_ = true;
};

template <int bin_count>
struct Histogram {
    Box4 boxes[3][bin_count];
    std::uint32_t counts[3][bin_count] = {};

    void add(const Bins& bins, const BoxRef& ref) {
        const Box4 box = load(ref);
        const Int4 bin = bins.of(box);
        for (int k = 0; k < 3; ++k) {
            boxes[k][bin[k]].add(box);
            ++counts[k][bin[k]];
        }
    }
    void add(const Histogram& other) {
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < bin_count; ++i) {
                boxes[k][i].add(other.boxes[k][i]);
                counts[k][i] += other.counts[k][i];
            }
    }
};

struct Split {
    int axis = -1;
    int bin = 0;  ///< the first above
    float cost = infinity;
};

/// What a ray pays, about, that enters a box of so many items. Less than proportional: it will miss
/// most of them. Of the powers from 1/2 to 1 those around 3/4 make the fastest trees. A block that
/// is not full is cheaper than one that is, if not by what it lacks: it is small.
class SearchCosts {
public:
    explicit SearchCosts(std::uint32_t block_size) : block_size_(block_size) {
        for (std::uint32_t i = 0; i < few_.size(); ++i) few_[i] = cost(i);
    }

    float operator()(std::uint32_t items) const {
        return items < few_.size() ? few_[items] : cost(items);
    }

private:
    float cost(std::uint32_t items) const {
        const std::uint32_t blocks = (items + block_size_ - 1) / block_size_;
        const float mean = 0.5f * (float(blocks * block_size_) + float(items));
        return std::sqrt(mean * std::sqrt(mean));
    }

    std::uint32_t block_size_;
    std::array<float, 512> few_;  ///< roots take time
};

class Builder {
public:
    Builder(RawVector<BoxRef> refs, const BvhConfig& config)
        : refs_(std::move(refs)),
          scratch_(refs_.size()),
          leaf_size_(config.leaf_size),
          costs_(config.block_size),
          nodes_(std::make_unique_for_overwrite<BoxNode[]>(2 * refs_.size() + 1)) {}

    BoxTree run() {
        nodes_[0] = {};
        if (!refs_.empty()) build(0, bounds(0, refs_.size()), 0);
        BoxTree tree;
        tree.nodes.assign(nodes_.get(), nodes_.get() + next_node_);
        tree.items.resize(refs_.size());
        for_chunks(0, refs_.size(), [&](std::size_t begin, std::size_t end) {
            for (std::size_t i = begin; i < end; ++i) tree.items[i] = refs_[i].item;
        });
        return tree;
    }

private:
    // Where tasks are worth their while. Decides who builds; what is built is the same either way.
    static constexpr std::size_t task_refs = 1024;
    static constexpr std::size_t chunk_refs = 1 << 14;
    // Fewer bins build them sooner, and better ones do not show.
    static constexpr std::size_t few_refs = 256;
    // Below come at most 28 levels of halves.
    static constexpr int deep_enough = 64;

    void build(std::uint32_t slot, const Range& range, int depth) {
        BoxNode& node = nodes_[slot];
        node = {range.box.box(), 0, std::uint32_t(range.begin), std::uint32_t(range.size())};
        if (range.size() <= leaf_size_) return;
        node.children = next_node_.fetch_add(2);
        const auto parts = divide(range, depth);
        const auto child = [&](std::uint32_t i) { build(node.children + i, parts[i], depth + 1); };
        if (range.size() > task_refs)
            tbb::parallel_invoke([&] { child(0); }, [&] { child(1); });
        else
            child(0), child(1);
    }

    std::array<Range, 2> divide(const Range& range, int depth) {
        if (depth >= deep_enough) return halve(range);
        return range.size() < few_refs ? divide<16>(range) : divide<32>(range);
    }

    template <int bin_count>
    std::array<Range, 2> divide(const Range& range) {
        using Sums = Histogram<bin_count>;
        const Bins bins(range, bin_count);
        if (!bins.finite()) return halve(range);
        const auto sums = reduce<Sums>(range.begin, range.end,
                                       [&](Sums& h, const BoxRef& ref) { h.add(bins, ref); });
        Split split;
        for (int axis = 0; axis < 3; ++axis)
            if (bins.usable(axis)) weigh(sums, axis, split);
        return split.axis >= 0 ? partition(range, bins, split) : halve(range);
    }

    /// Takes the axis' cheapest split into `best` if it is cheaper.
    template <int bin_count>
    void weigh(const Histogram<bin_count>& histogram, int axis, Split& best) const {
        const Box4* const boxes = histogram.boxes[axis];
        const std::uint32_t* const counts = histogram.counts[axis];
        float above_cost[bin_count + 1];
        above_cost[bin_count] = infinity;  // all below is no split
        Box4 box;
        std::uint32_t count = 0;
        for (int i = bin_count - 1; i > 0; --i) {
            above_cost[i] = above_cost[i + 1];
            if (counts[i] == 0) continue;
            box.add(boxes[i]);
            count += counts[i];
            above_cost[i] = box.area() * costs_(count);
        }
        box = {};
        count = 0;
        for (int i = 0; i + 1 < bin_count; ++i) {
            if (counts[i] == 0) continue;
            box.add(boxes[i]);
            count += counts[i];
            const float cost = box.area() * costs_(count) + above_cost[i + 1];
            if (cost < best.cost) best = {axis, i + 1, cost};
        }
    }

    std::array<Range, 2> partition(const Range& range, const Bins& bins, const Split& split) {
        const auto is_below = [&](const BoxRef& ref) {
            return bins.of(load(ref))[split.axis] < split.bin;
        };
        if (range.size() > 2 * chunk_refs) return partition_chunks(range, is_below);
        // Without a branch that depends on the side, which no processor could guess.
        std::array<Range, 2> sides;
        BoxRef* to[2] = {&refs_[range.begin], &scratch_[range.begin]};
        for (std::size_t i = range.begin; i < range.end; ++i) {
            const BoxRef ref = refs_[i];
            const int side = is_below(ref) ? 0 : 1;
            sides[side].add(load(ref));
            *to[side]++ = ref;
        }
        const auto below = std::size_t(to[0] - refs_.data());
        std::copy(&scratch_[range.begin], to[1], to[0]);
        sides[0].begin = range.begin;
        sides[0].end = sides[1].begin = below;
        sides[1].end = range.end;
        return sides;
    }

    /// In parallel: each chunk counts, and then moves its refs to where they go.
    template <class IsBelow>
    std::array<Range, 2> partition_chunks(const Range& range, IsBelow&& is_below) {
        const std::size_t chunks = (range.size() + chunk_refs - 1) / chunk_refs;
        std::vector<std::size_t> places(chunks);
        const auto chunk_of = [&](std::size_t begin) { return (begin - range.begin) / chunk_refs; };
        for_chunks(range.begin, range.end, [&](std::size_t begin, std::size_t end) {
            places[chunk_of(begin)] =
                std::size_t(std::count_if(refs_.begin() + begin, refs_.begin() + end, is_below));
        });
        std::size_t place = range.begin;
        for (std::size_t& p : places) p = std::exchange(place, place + p);
        for_chunks(range.begin, range.end, [&](std::size_t begin, std::size_t end) {
            // Of the refs before this chunk those that do not lie below lie above.
            std::size_t to_below = places[chunk_of(begin)];
            std::size_t to_above = place + (begin - range.begin) - (to_below - range.begin);
            for (std::size_t i = begin; i < end; ++i)
                scratch_[is_below(refs_[i]) ? to_below++ : to_above++] = refs_[i];
        });
        for_chunks(range.begin, range.end, [&](std::size_t begin, std::size_t end) {
            std::copy(scratch_.begin() + begin, scratch_.begin() + end, refs_.begin() + begin);
        });
        return {bounds(range.begin, place), bounds(place, range.end)};
    }

    /// The first half of the refs and the rest, wherever they lie.
    std::array<Range, 2> halve(const Range& range) const {
        const std::size_t middle = range.begin + range.size() / 2;
        return {bounds(range.begin, middle), bounds(middle, range.end)};
    }

    Range bounds(std::size_t begin, std::size_t end) const {
        Range range =
            reduce<Range>(begin, end, [](Range& sum, const BoxRef& ref) { sum.add(load(ref)); });
        range.begin = begin;
        range.end = end;
        return range;
    }

    /// The sum of all refs that `add` makes.
    template <class Sum, class Add>
    Sum reduce(std::size_t begin, std::size_t end, Add&& add) const {
        const auto add_all = [&](std::size_t i, std::size_t last, Sum& sum) {
            for (; i < last; ++i) add(sum, refs_[i]);
        };
        Sum sum;
        if (end - begin <= chunk_refs) {
            add_all(begin, end, sum);
        } else {
            sum = tbb::parallel_deterministic_reduce(
                tbb::blocked_range(begin, end, chunk_refs), Sum(),
                [&](const auto& part, Sum partial) {
                    add_all(part.begin(), part.end(), partial);
                    return partial;
                },
                [](Sum a, const Sum& b) {
                    a.add(b);
                    return a;
                });
        }
        return sum;
    }

    template <class F>
    static void for_chunks(std::size_t begin, std::size_t end, F&& f) {
        const std::size_t chunks = (end - begin + chunk_refs - 1) / chunk_refs;
        tbb::parallel_for(std::size_t(0), chunks, [&](std::size_t i) {
            const std::size_t from = begin + i * chunk_refs;
            f(from, std::min(end, from + chunk_refs));
        });
    }

    RawVector<BoxRef> refs_;
    RawVector<BoxRef> scratch_;
    std::uint32_t leaf_size_;
    SearchCosts costs_;
    std::unique_ptr<BoxNode[]> nodes_;
    std::atomic<std::uint32_t> next_node_ = 1;
};

}  // namespace

BoxTree build_bvh(RawVector<BoxRef> refs, const BvhConfig& config) {
    CHECK(config.leaf_size > 0);
    CHECK(refs.size() < 1u << 30);
    return Builder(std::move(refs), config).run();
}

}  // namespace tessera
