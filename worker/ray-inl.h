// One incoherent ray through the wide trees: a ray meets all children of a node, and all triangles
// of a block, in one step.
//
// Wald, Benthin and Boulos, "Getting Rid of Packets: Efficient SIMD Single-Ray Traversal using
// Multi-branching BVHs" (2008), for both levels of the scene (Wald 2004, chapter 9), for closest
// hit and for occlusion. We differ in being exact: a box is skipped only when the ray misses it for
// certain, the float test of triangles decides only what its error bound allows, and what it leaves
// is decided in double (worker/triangle.h). The nearer plane of a slab follows from the sign bit of
// the direction, which tells -0 from +0; a ray inside a slab's face (distance NaN) keeps its
// segment; and traversal ends when no box left to visit starts before the hit.
//
// Rays through one object go in waves, which part computing from branching, in the manner of Laine,
// Karras and Aila, "Megakernels Considered Harmful" (2013).
#if defined(TESSERA_RAY_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_RAY_INL_H
#undef TESSERA_RAY_INL_H
#else
#define TESSERA_RAY_INL_H
#endif

#include <optional>

#include "hwy/cache_control.h"
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

/// Asks memory for what is soon to be visited.
HWY_INLINE void prefetch_target(const SceneObject& object, WideLink link) {
    if (link.is_leaf())
        prefetch(&object.blocks[link.first()], sizeof(Block::corners));
    else
        prefetch(&object.tree.nodes[link.first()], sizeof(Node));
}

/// Other rays would meet every box, only to miss every triangle.
HWY_INLINE bool is_sound(const Ray& ray) { return is_finite(ray.org) && is_finite(ray.dir); }

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

/// What is left to visit.
template <bool ordered>
class LinkStack {
public:
    LinkStack() {}  // Leaves the memory as it is.

    void clear() { top_ = 0; }

    /// Adds the lanes that are set in `met`; if ordered, the nearest of them on top.
    HWY_INLINE void push(const Node& node, Mask met, Float start) {
        if constexpr (ordered) {
            push_in_order(node, bits(met), start);
        } else {
            // Moving all at once costs less than branching over each.
            const Float links = load(reinterpret_cast<const float*>(node.children));
            hn::StoreU(compress(links, met), lanes_tag, links_ + top_);
            top_ += std::popcount(bits(met));
        }
    }

    /// Takes the next that starts at or before `t_last`; false when none is left.
    HWY_INLINE bool pop(float t_last, WideLink& link) {
        while (top_ > 0) {
            --top_;
            if (ordered && !(starts_[top_] <= t_last)) continue;
            link = std::bit_cast<WideLink>(links_[top_]);
            return true;
        }
        return false;
    }

private:
    /// Each goes where the number of those that start later tells, which takes no branches.
    HWY_INLINE void push_in_order(const Node& node, Bits met, Float start) {
        // Keys that differ: of equal starts the lane decides.
        constexpr hn::RebindToSigned<decltype(lanes_tag)> tag;
        const auto keys =
            hn::Or(hn::And(hn::BitCast(tag, start), hn::Set(tag, -W)), hn::Iota(tag, 0));
        alignas(64) float starts[W];
        alignas(64) std::int32_t key_of[W];
        store(start, starts);
        hn::Store(keys, tag, key_of);
        for_each_bit(met, [&](int i) HWY_ATTR {
            const Bits later =
                met & bits(hn::RebindMask(lanes_tag, keys > hn::Set(tag, key_of[i])));
            const int place = top_ + std::popcount(later);
            starts_[place] = starts[i];
            links_[place] = std::bit_cast<float>(node.children[i]);
        });
        top_ += std::popcount(met);
    }

    int top_ = 0;
    float links_[wide_stack_size<W>];  // the bits of WideLinks, which SIMD moves as floats
    float starts_[ordered ? wide_stack_size<W> : 1];
};

/// Calls `leaf(link)` for the leaves that the ray may meet; if ordered, the nearest first as far as
/// boxes tell. `leaf` returns the largest t that still matters: the hit's, or -infinity to stop.
template <bool ordered, class Leaf>
HWY_INLINE void traverse(const Tree& tree, const BoxRay& ray, float t_last, WideLink from,
                         Leaf&& leaf) {
    LinkStack<ordered> stack;
    WideLink link = from;
    do {
        while (!link.is_leaf()) {
            const Node& node = tree.nodes[link.first()];
            Float start;
            const Mask met = ray.meets(node, t_last, start);
            const Bits lanes = bits(met);
            if (std::has_single_bit(lanes)) {
                link = node.children[std::countr_zero(lanes)];
            } else {
                if (lanes) stack.push(node, met, start);
                if (!stack.pop(t_last, link)) return;
            }
        }
        t_last = leaf(link);
    } while (t_last != -infinity && stack.pop(t_last, link));
}

/// Sorts triangles by whether a ray hits them, in float.
class TriangleFilter {
public:
    explicit TriangleFilter(const Ray& ray) : axes_(axes_of(ray.dir)), tmin_(ray.tmin) {
        // Indexing a vec3 with a variable branches.
        const float *const org = &ray.org.x, *const dir = &ray.dir.x;
        for (int k = 0; k < 3; ++k) org_[k] = org[axes_[k]];
        shear_[2] = 1 / dir[axes_[2]];
        shear_[0] = dir[axes_[0]] * shear_[2];
        shear_[1] = dir[axes_[1]] * shear_[2];
    }

    struct Lanes {
        Bits maybe;   ///< those whose triangles the ray may hit in tmin < t <= t_last
        Bits surely;  ///< those of them that it hits for certain, in tmin < t < t_last
    };

    HWY_INLINE Lanes sort(const Block& block, float t_last) const {
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
        // Counted in units of 2^-24: with M = extent and |sx|, |sy| <= 1, which were rounded twice,
        // a sheared coordinate is wrong by at most 6 M, and an edge function, with coordinates up
        // to W = width, by 30 M W + 72 M^2.
        constexpr float unit = 0x1p-24f;
        const Float error = splat(64 * unit) * extent * hn::MulAdd(splat(4 * unit), extent, width);
        const Float least = min3(u, v, w), most = max3(u, v, w);
        const Mask beside = hn::And(least<hn::Neg(error), most> error);
        const Mask inside = hn::Or(least > error, most < hn::Neg(error));
        // A hit lies between the vertices; each t is wrong by at most 3 of these units, and the
        // hit's is rounded once more.
        const Float slack = splat(8 * unit);
        const Float first = min3(t[0], t[1], t[2]), last = max3(t[0], t[1], t[2]);
        const Mask before = hn::MulAdd(slack, hn::Abs(last), last) < splat(tmin_);
        const Mask behind = hn::NegMulAdd(slack, hn::Abs(first), first) > splat(t_last);
        const Mask outside = hn::Or(before, behind);

        // For certain it is at t_det / det, of which t_det is wrong by at most 3 times the error of
        // an edge function times the largest t, and det by 2 of that error.
        const Float sum = u + v + w, det = hn::Abs(sum);
        const Float t_det =
            hn::Xor(hn::MulAdd(u, t[0], hn::MulAdd(v, t[1], w * t[2])), hn::Xor(det, sum));
        const Float reach = splat(3) * hn::Max(hn::Abs(first), hn::Abs(last));
        const auto beyond = [&](float end)
                                HWY_ATTR { return hn::NegMulAdd(splat(end), det, t_det); };
        const auto doubt = [&](float end)
                               HWY_ATTR { return error * (reach + splat(2 * std::abs(end))); };
        Mask within = beyond(tmin_) > doubt(tmin_);
        // What has no end all hits lie before.
        if (t_last < infinity) within = hn::And(within, beyond(t_last) < hn::Neg(doubt(t_last)));
        // A ray that leaves a surface lies between the vertices of triangles beside its origin.
        Mask never = hn::Or(outside, beyond(tmin_) < hn::Neg(doubt(tmin_)));
        if (t_last < infinity) never = hn::Or(never, beyond(t_last) > doubt(t_last));
        return {all_lanes & ~bits(hn::Or(beside, never)), bits(hn::And(inside, within))};
    }

private:
    std::array<int, 3> axes_;
    float org_[3], shear_[3], tmin_;
};

/// Whether `ray` hits one of a block's triangles, which were sorted to `lanes`.
HWY_INLINE bool hits_any(const Ray& ray, const Block& block, TriangleFilter::Lanes lanes) {
    if (lanes.surely) return true;
    for (Bits may = lanes.maybe; may; may &= may - 1) {
        const int lane = std::countr_zero(may);
        if (block.ids[lane] == Block::no_triangle) break;
        TriangleHit hit;
        if (TriangleRay(ray).hits(block, lane, hit)) return true;
    }
    return false;
}

/// One ray's way through the scene, and the best hit so far.
template <bool any_hit>
class Query {
public:
    /// `tmax` is that of the rays to be traced.
    explicit Query(const Scene& scene, float tmax = infinity) : scene_(scene) { hit_.t = tmax; }

    /// Traces through an object's tree, or the part of it at `from`; `ray` is in the object's
    /// space.
    HWY_INLINE void trace(const SceneObject& object, const Ray& ray, std::uint32_t instance,
                          WideLink from = WideLink::node(0)) {
        const TriangleFilter filter(ray);
        const TriangleRay exact(ray);  // of which the compiler drops what any_hit does not use
        const auto visit = [&](WideLink leaf) HWY_ATTR {
            const Block* const first = &object.blocks[leaf.first()];
            for (const Block& block : std::span(first, leaf.count())) {
                const TriangleFilter::Lanes lanes = filter.sort(block, hit_.t);
                if constexpr (!any_hit) {
                    test(exact, block, lanes.maybe, instance);
                } else if (hits_any(ray, block, lanes)) {
                    hit_.instance = instance;
                    break;
                }
            }
            return last_t();
        };
        traverse<!any_hit>(object.tree, BoxRay(ray), hit_.t, from, visit);
    }

    /// Traces through all instances.
    void trace(const Ray& ray) {
        const auto visit = [&](WideLink leaf) HWY_ATTR {
            for (const std::uint32_t item : std::span(&scene_.items[leaf.first()], leaf.count())) {
                const WideInstance& instance = scene_.instances[item];
                const Affine* const transform = instance.transform();
                trace(scene_.object(instance.object),
                      transform ? transformed(ray, *transform) : ray, instance.id);
                if (any_hit && found()) break;
            }
            return last_t();
        };
        traverse<!any_hit>(scene_.top, BoxRay(ray), hit_.t, WideLink::node(0), visit);
    }

    bool found() const { return hit_.valid(); }
    /// By the scene's own names. Of any hit, only whether there is one.
    Hit result() const { return found() ? hit_ : Hit{}; }
    /// The largest t that can still change the answer.
    float last_t() const { return any_hit && found() ? -infinity : hit_.t; }

    /// Takes the hit among the triangles that `may` be hit, if it is closer.
    HWY_INLINE void test(const TriangleRay& ray, const Block& block, Bits may,
                         std::uint32_t instance) {
        for (; may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            const std::uint32_t triangle = block.ids[lane];
            if (triangle == Block::no_triangle) break;
            // The best hit so far is met again in each leaf that its triangle reaches.
            if (triangle == hit_.triangle && instance == hit_.instance) continue;
            TriangleHit hit;
            if (ray.hits(block, lane, hit)) take(hit, instance, triangle);
        }
    }

private:
    void take(const TriangleHit& found, std::uint32_t instance, std::uint32_t triangle) {
        const auto precedes = [&] {
            return scene_.name_of(instance, triangle) <
                   scene_.name_of(hit_.instance, hit_.triangle);
        };
        if (found.t < hit_.t || (found.t == hit_.t && hit_.valid() && precedes()))
            hit_ = {found.t, found.u, found.v, instance, triangle};
    }

    const Scene& scene_;
    Hit hit_;
};

/// The hit by the scene's own names.
template <bool any_hit>
Hit trace(const Scene& scene, const Ray& ray) {
    if (!is_sound(ray)) return {};
    Query<any_hit> query(scene, ray.tmax);
    if (scene.single)
        query.trace(scene.object(0), ray, scene.single_id);
    else
        query.trace(ray);
    return query.result();
}

/// A hit as the caller knows it.
Hit named(const Scene& scene, const Hit& hit) {
    const auto [instance, triangle] = scene.name_of(hit.instance, hit.triangle);
    return {hit.t, hit.u, hit.v, instance, triangle};
}

/// Traces rays through the only object of a scene, some rays at a time and all of these by one step
/// in turn: first what has no branches, for all of them, then what branches on it. A mispredicted
/// branch then costs little, for what it waits for is known, and memory has the time of a turn to
/// answer.
template <bool any_hit>
class RayWave {
public:
    /// Of any hit, only whether there is one.
    using Answer = std::conditional_t<any_hit, std::uint8_t, Hit>;

    RayWave(const Scene& scene, std::span<const Ray> rays, std::span<Answer> answers)
        : scene_(scene), object_(scene.object(0)), rays_(rays), answers_(answers) {}

    void run() {
        for (Walk& walk : walks_) start(walk);
        while (nodes_.count + leaves_.count > 0) {
            meet_boxes();
            meet_triangles();
        }
    }

private:
    struct Walk {
        std::size_t index;  ///< of the ray
        std::optional<BoxRay> boxes;
        std::optional<TriangleFilter> triangles;
        std::optional<TriangleRay> exact;   ///< of closest hits
        std::optional<Query<false>> query;  ///< the same
        WideLink next;
        alignas(64) float starts[W];  ///< of closest hits: where the ray enters the children
        Bits met;                     ///< of these, those that it meets
        TriangleFilter::Lanes lanes;
        LinkStack<!any_hit> stack;
    };

    static constexpr int size = 8;

    struct List {
        Walk* walks[size + 1];  ///< one more, to write to without a branch
        int count = 0;

        /// Empties the list; the walks stay where they are until others take their places.
        std::span<Walk*> take() { return {walks, std::size_t(std::exchange(count, 0))}; }
    };

    /// The largest t that can still change the answer.
    HWY_INLINE float last_t(const Walk& walk) const {
        return any_hit ? rays_[walk.index].tmax : walk.query->last_t();
    }

    HWY_INLINE void meet_boxes() {
        const auto walks = nodes_.take();
        for (Walk* walk : walks) {
            const Node& node = object_.tree.nodes[walk->next.first()];
            Float start;
            const Mask met = walk->boxes->meets(node, last_t(*walk), start);
            if constexpr (any_hit) {
                walk->stack.push(node, met, start);
            } else {
                walk->met = bits(met);
                store(start, walk->starts);
            }
        }
        for (Walk* walk : walks) {
            if constexpr (!any_hit) {
                const Node& node = object_.tree.nodes[walk->next.first()];
                if (std::has_single_bit(walk->met)) {
                    walk->next = node.children[std::countr_zero(walk->met)];
                    place(*walk);
                    continue;
                }
                walk->stack.push(node, mask_of(walk->met), load(walk->starts));
            }
            advance(*walk);
        }
    }

    HWY_INLINE void meet_triangles() {
        const auto walks = leaves_.take();
        for (Walk* walk : walks)
            walk->lanes = walk->triangles->sort(object_.blocks[walk->next.first()], last_t(*walk));
        for (Walk* walk : walks) {
            const WideLink leaf = walk->next;
            const Block& block = object_.blocks[leaf.first()];
            if constexpr (any_hit) {
                if (hits_any(rays_[walk->index], block, walk->lanes)) {
                    answers_[walk->index] = true;
                    start(*walk);
                    continue;
                }
            } else {
                walk->query->test(*walk->exact, block, walk->lanes.maybe, scene_.single_id);
            }
            if (leaf.count() > 1) {
                walk->next = WideLink::leaf(leaf.first() + 1, leaf.count() - 1);
                place(*walk);
            } else {
                advance(*walk);
            }
        }
    }

    /// Goes on to what the stack holds, or with another ray.
    HWY_INLINE void advance(Walk& walk) {
        if (walk.stack.pop(last_t(walk), walk.next)) return place(walk);
        if constexpr (!any_hit) answers_[walk.index] = named(scene_, walk.query->result());
        start(walk);
    }

    /// Gives the walk the next ray, if there is one.
    HWY_INLINE void start(Walk& walk) {
        while (next_ < rays_.size()) {
            const std::size_t i = next_++;
            answers_[i] = {};
            if (!is_sound(rays_[i])) continue;
            walk.index = i;
            walk.boxes.emplace(rays_[i]);
            walk.triangles.emplace(rays_[i]);
            if constexpr (!any_hit) {
                walk.exact.emplace(rays_[i]);
                walk.query.emplace(scene_, rays_[i].tmax);
            }
            walk.next = WideLink::node(0);
            walk.stack.clear();
            return place(walk);
        }
    }

    HWY_INLINE void place(Walk& walk) {
        const bool leaf = walk.next.is_leaf();
        prefetch_target(object_, walk.next);
        nodes_.walks[nodes_.count] = leaves_.walks[leaves_.count] = &walk;
        nodes_.count += !leaf;
        leaves_.count += leaf;
    }

    const Scene& scene_;
    const SceneObject& object_;
    std::span<const Ray> rays_;
    std::span<Answer> answers_;
    std::size_t next_ = 0;
    List nodes_, leaves_;
    Walk walks_[size];
};

void closest_hits(const Scene& scene, std::span<const Ray> rays, std::span<Hit> hits) {
    if (scene.single) return RayWave<false>(scene, rays, hits).run();
    for (std::size_t i = 0; i < rays.size(); ++i)
        hits[i] = named(scene, trace<false>(scene, rays[i]));
}

void occluded(const Scene& scene, std::span<const Ray> rays, std::span<std::uint8_t> blocked) {
    if (scene.single) return RayWave<true>(scene, rays, blocked).run();
    for (std::size_t i = 0; i < rays.size(); ++i) blocked[i] = trace<true>(scene, rays[i]).valid();
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
