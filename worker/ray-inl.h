// One incoherent ray through the wide trees: a ray meets all children of a node, and all triangles
// of a block, in one step.
//
// Wald, Benthin and Boulos, "Getting Rid of Packets: Efficient SIMD Single-Ray Traversal using
// Multi-branching BVHs" (2008), for both levels of the scene (Wald 2004, chapter 9), for closest
// hit and for occlusion. We differ in being exact: a box is skipped only when the ray misses it for
// certain, the float test of triangles only rejects, within its error bound, and what it leaves is
// decided in double (worker/triangle.h). The nearer plane of a slab follows from the sign bit of
// the direction, which tells -0 from +0; a ray inside a slab's face (distance NaN) keeps its
// segment; and traversal ends when no box left to visit starts before the hit.
#if defined(TESSERA_RAY_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_RAY_INL_H
#undef TESSERA_RAY_INL_H
#else
#define TESSERA_RAY_INL_H
#endif

#include "worker/kernels.h"
#include "worker/simd-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

using Node = WideNode<W>;
using Tree = WideTree<W>;
using Block = TriangleBlock<W>;
using SceneObject = WideObject<W>;
using Scene = WideScene<W>;

/// Meets boxes.
class BoxRay {
public:
    explicit BoxRay(const Ray& ray) : tmin_(ray.tmin) {
        // A slab distance goes through four roundings, 2^-24 each; this leaves twice as much.
        constexpr float slack = 0x1p-21f;
        for (int k = 0; k < 3; ++k) {
            const float inv = 1 / ray.dir[k];
            org_[k] = ray.org[k];
            // A distance along the ray times these lies surely below and above the true one.
            inv_below_[k] = inv * (1 - slack);
            inv_above_[k] = inv * (1 + slack);
            negative_[k] = std::signbit(ray.dir[k]);
        }
    }

    /// The children that the ray may meet in tmin .. t_last; where it enters them goes to `start`.
    HWY_INLINE Mask meets(const Node& node, float t_last, Float& start) const {
        Float t_near = splat(tmin_), t_far = splat(t_last);
        for (int k = 0; k < 3; ++k) {
            const Float org = splat(org_[k]);
            const Float entry = (load(node.bounds[k][negative_[k]]) - org) * splat(inv_below_[k]);
            const Float exit =
                (load(node.bounds[k][1 - negative_[k]]) - org) * splat(inv_above_[k]);
            t_near = max_or_second(entry, t_near);
            t_far = min_or_second(exit, t_far);
        }
        start = t_near;
        return t_near <= t_far;
    }

private:
    float org_[3], inv_below_[3], inv_above_[3], tmin_;
    int negative_[3];
};

HWY_INLINE Float load_links(const Node& node) {
    return load(reinterpret_cast<const float*>(node.children));
}

/// Sorts the stack above `base`, the nearest on top.
HWY_INLINE void bring_nearest_up(float* starts, float* links, int base, int top) {
    for (int i = base + 1; i < top; ++i) {
        const float start = starts[i], link = links[i];
        int place = i;
        for (; place != base && starts[place - 1] < start; --place) {
            starts[place] = starts[place - 1];
            links[place] = links[place - 1];
        }
        starts[place] = start;
        links[place] = link;
    }
}

/// Calls `leaf(link)` for the leaves that the ray may meet, the nearest first as far as boxes tell.
/// `leaf` returns the largest t that still matters: the hit's, or -infinity to stop.
template <bool ordered, class Leaf>
HWY_INLINE void traverse(const Tree& tree, const BoxRay& ray, float t_last, WideLink from,
                         Leaf&& leaf) {
    float starts[wide_stack_size<W>];
    float links[wide_stack_size<W>];  // of WideLinks the bits, which SIMD moves as floats
    int top = 0;
    WideLink link = from;
    while (true) {
        if (link.is_leaf()) {
            t_last = leaf(link);
        } else {
            const Node& node = tree.nodes[link.first()];
            Float start;
            const Mask hit = ray.meets(node, t_last, start);
            const Bits hits = bits(hit);
            if (!hits) {
                // Falls through to the next of the stack.
            } else if (!(hits & (hits - 1))) {
                link = node.children[std::countr_zero(hits)];
                continue;
            } else {
                // Moving all at once costs less than branching over each.
                hn::StoreU(hn::Compress(start, hit), lanes_tag, starts + top);
                hn::StoreU(hn::Compress(load_links(node), hit), lanes_tag, links + top);
                const int base = top;
                top += std::popcount(hits);
                if constexpr (ordered) bring_nearest_up(starts, links, base, top);
            }
        }
        do {
            if (top == 0) return;
            --top;
        } while (!(starts[top] <= t_last));
        link = std::bit_cast<WideLink>(links[top]);
    }
}

/// Rejects triangles.
class TriangleFilter {
public:
    TriangleFilter(const Ray& ray, const TriangleRay& exact) : tmin_(ray.tmin) {
        const auto [x, y, z] = exact.axes();
        axes_[0] = x, axes_[1] = y, axes_[2] = z;
        for (int k = 0; k < 3; ++k) {
            org_[k] = ray.org[axes_[k]];
            shear_[k] = float(exact.shear()[k]);
        }
    }

    /// The lanes whose triangles the ray may hit in tmin < t <= t_last.
    HWY_INLINE Bits may_hit(const Block& block, float t_last) const {
        Float x[3], y[3], t[3], width = hn::Zero(lanes_tag), depth = width;
        for (int k = 0; k < 3; ++k) {
            const Float z = load(block.corners[k][axes_[2]]) - splat(org_[2]);
            t[k] = z * splat(shear_[2]);
            x[k] = hn::NegMulAdd(splat(shear_[0]), z,
                                 load(block.corners[k][axes_[0]]) - splat(org_[0]));
            y[k] = hn::NegMulAdd(splat(shear_[1]), z,
                                 load(block.corners[k][axes_[1]]) - splat(org_[1]));
            width = max3(width, hn::Abs(x[k]), hn::Abs(y[k]));
            depth = hn::Max(depth, hn::Abs(z));
        }
        const Float extent = hn::Max(width, depth);
        const Float u = hn::MulSub(x[2], y[1], y[2] * x[1]);
        const Float v = hn::MulSub(x[0], y[2], y[0] * x[2]);
        const Float w = hn::MulSub(x[1], y[0], y[1] * x[0]);
        // Counted in units of 2^-24: with M = extent and |sx|, |sy| <= 1, a sheared coordinate is
        // wrong by at most 6 M, and an edge function, with coordinates up to W = width, by
        // 30 M W + 72 M^2.
        constexpr float unit = 0x1p-24f;
        const Float error = splat(64 * unit) * extent * hn::MulAdd(splat(4 * unit), extent, width);
        const Mask beside = hn::And(min3(u, v, w) < hn::Neg(error), max3(u, v, w) > error);
        // A hit lies between the vertices; each t is wrong by at most 2 of these units.
        constexpr float slack = 8 * unit;
        const Mask before = max3(t[0], t[1], t[2]) * splat(1 + slack) < splat(tmin_);
        const Mask behind = min3(t[0], t[1], t[2]) * splat(1 - slack) > splat(t_last);
        return all_lanes & ~bits(hn::Or(beside, hn::Or(before, behind)));
    }

private:
    int axes_[3];
    float org_[3], shear_[3], tmin_;
};

/// One ray's way through the scene, and the best hit so far.
template <bool any_hit>
class Query {
public:
    explicit Query(float tmax = infinity) { hit_.t = tmax; }

    /// Traces through an object's tree, or the part of it at `from`; `ray` is in the object's
    /// space.
    HWY_INLINE void trace(const SceneObject& object, const Ray& ray, std::uint32_t instance,
                          WideLink from = WideLink::node(0)) {
        const BoxRay box_ray(ray);
        const TriangleRay exact(ray);
        const TriangleFilter filter(ray, exact);
        traverse<!any_hit>(object.tree, box_ray, hit_.t, from, [&](WideLink leaf) HWY_ATTR {
            const Block* const first = &object.blocks[leaf.first()];
            for (const Block& block : std::span(first, leaf.count())) {
                for (Bits may = filter.may_hit(block, last_t()); may; may &= may - 1)
                    test(exact, block, std::countr_zero(may), instance);
                if (any_hit && hit_.valid()) break;
            }
            return last_t();
        });
    }

    /// The largest t that can still change the answer.
    float last_t() const { return any_hit && hit_.valid() ? -infinity : hit_.t; }

    bool found() const { return hit_.valid(); }
    Hit result() const { return hit_.valid() ? hit_ : Hit{}; }

    /// Tests the triangle in a lane.
    void test(const TriangleRay& ray, const Block& block, int lane, std::uint32_t instance) {
        const std::uint32_t triangle = block.ids[lane];
        // The best hit so far is met again in each leaf that its triangle reaches.
        if (triangle == Block::no_triangle ||
            (triangle == hit_.triangle && instance == hit_.instance))
            return;
        TriangleHit found;
        if (ray.hits(block.lane(lane), found)) take(found, instance, triangle);
    }

private:
    void take(const TriangleHit& found, std::uint32_t instance, std::uint32_t triangle) {
        const auto precedes = [&] {
            return std::pair(instance, triangle) < std::pair(hit_.instance, hit_.triangle);
        };
        if (found.t < hit_.t || (found.t == hit_.t && hit_.valid() && precedes()))
            hit_ = {found.t, found.u, found.v, instance, triangle};
    }

    Hit hit_;
};

/// Remembers instances that a ray was tested against: their boxes overlap many cells, and a test is
/// expensive (Wald 2004, 9.6.1). Forgetting one costs time only.
class Mailbox {
public:
    Mailbox() { seen_.fill(~0u); }
    /// Whether `instance` was surely seen before.
    bool test_and_set(std::uint32_t instance) {
        return std::exchange(seen_[instance % seen_.size()], instance) == instance;
    }

private:
    std::array<std::uint32_t, 16> seen_;
};

template <bool any_hit>
void trace_instances(const Scene& scene, const Ray& ray, Query<any_hit>& query) {
    Mailbox mailbox;
    traverse<!any_hit>(
        scene.top, BoxRay(ray), query.last_t(), WideLink::node(0), [&](WideLink leaf) HWY_ATTR {
            for (const std::uint32_t item : std::span(&scene.items[leaf.first()], leaf.count())) {
                if (query.last_t() == -infinity) break;
                if (mailbox.test_and_set(item)) continue;
                const WideInstance& instance = scene.instances[item];
                query.trace(scene.objects[instance.object],
                            transformed(ray, instance.object_from_world), instance.id);
            }
            return query.last_t();
        });
}

template <bool any_hit>
Hit trace(const Scene& scene, const Ray& ray) {
    // It would meet every box, only to miss every triangle.
    if (!is_finite(ray.org) || !is_finite(ray.dir)) return {};
    Query<any_hit> query(ray.tmax);
    if (scene.single)
        query.trace(scene.objects[0], ray, 0);
    else
        trace_instances(scene, ray, query);
    return query.result();
}

void closest_hits(const Scene& scene, std::span<const Ray> rays, std::span<Hit> hits) {
    for (std::size_t i = 0; i < rays.size(); ++i) hits[i] = trace<false>(scene, rays[i]);
}

void occluded(const Scene& scene, std::span<const Ray> rays, std::span<std::uint8_t> blocked) {
    for (std::size_t i = 0; i < rays.size(); ++i) blocked[i] = trace<true>(scene, rays[i]).valid();
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
