// Incoherent rays through the wide trees: a ray meets all children of a node, and all triangles of
// a block, in one step.
//
// Wald, Benthin and Boulos, "Getting Rid of Packets: Efficient SIMD Single-Ray Traversal using
// Multi-branching BVHs" (2008), for both levels of the scene (Wald 2004, chapter 9), for closest
// hit and for occlusion. We differ in being exact: a box is skipped only when the ray misses it for
// certain, the float test of triangles decides only what its error bound allows, and what it leaves
// is decided in double (worker/triangle.h). The nearer plane of a slab follows from the sign bit of
// the direction, which tells -0 from +0; a ray inside a slab's face (distance NaN) keeps its
// segment; and traversal ends when no box left to visit starts before the hit.
//
// A lone ray spends its time on branches that none foresees. So many rays go through an object in
// waves that part computing from branching, in the manner of Laine, Karras and Aila, "Megakernels
// Considered Harmful" (2013).
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

/// A ray segment as four-lane vectors see it.
constexpr hn::FixedTag<float, 4> ray_tag;
using Vec4 = hn::Vec<decltype(ray_tag)>;
static_assert(sizeof(Ray) == 8 * sizeof(float));
HWY_INLINE Vec4 org_and_tmin(const Ray& ray) { return hn::LoadU(ray_tag, &ray.org.x); }
HWY_INLINE Vec4 dir_and_tmax(const Ray& ray) { return hn::LoadU(ray_tag, &ray.dir.x); }

/// Whether origin and direction are numbers. Other rays would meet every box, only to miss every
/// triangle.
HWY_INLINE bool is_sound(const Ray& ray) {
    const Vec4 zero = hn::Zero(ray_tag);
    const Vec4 nothing = hn::MulAdd(org_and_tmin(ray), zero, dir_and_tmax(ray) * zero);
    std::uint8_t zeros = 0;
    hn::StoreMaskBits(ray_tag, nothing == zero, &zeros);
    return (zeros & 7) == 7;
}

/// Meets boxes.
class BoxRay {
public:
    BoxRay() = default;
    explicit BoxRay(const Ray& ray) {
        // A slab distance goes through four roundings, 2^-24 each; this leaves twice as much.
        constexpr float slack = 0x1p-21f;
        const Vec4 inv = hn::Set(ray_tag, 1) / dir_and_tmax(ray);
        hn::Store(org_and_tmin(ray), ray_tag, org_);
        // A distance along the ray times these lies surely below and above the true one.
        hn::Store(inv * hn::Set(ray_tag, 1 - slack), ray_tag, inv_below_);
        hn::Store(inv * hn::Set(ray_tag, 1 + slack), ray_tag, inv_above_);
        for (int k = 0; k < 3; ++k) negative_[k] = std::signbit(ray.dir[k]);
    }

    /// The children that the ray may meet in tmin .. t_last; where it enters them goes to `start`.
    HWY_INLINE Mask meets(const Node& node, float t_last, Float& start) const {
        Float t_near = splat(org_[3]), t_far = splat(t_last);
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
    alignas(16) float org_[4];  ///< and tmin
    alignas(16) float inv_below_[4], inv_above_[4];
    int negative_[3];
};

HWY_INLINE Float load_links(const Node& node) {
    return load(reinterpret_cast<const float*>(node.children));
}

/// Sorts the stack from `base` on, the nearest on top.
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

/// Sorts a ray's triangles, in float.
class TriangleFilter {
public:
    TriangleFilter() = default;
    /// `bounds` are those of the object.
    TriangleFilter(const Ray& ray, const Box& bounds) : axes_(axes_of(ray.dir)), tmin_(ray.tmin) {
        // Indexing a vec3 with a variable branches.
        const float *const org = &ray.org.x, *const dir = &ray.dir.x;
        for (int k = 0; k < 3; ++k) org_[k] = org[axes_[k]];
        shear_[2] = 1 / dir[axes_[2]];
        shear_[0] = dir[axes_[0]] * shear_[2];
        shear_[1] = dir[axes_[1]] * shear_[2];
        extent_ = 2 * max_component(max(ray.org - bounds.lo, bounds.hi - ray.org));
    }

    struct Lanes {
        Bits maybe;   ///< those whose triangles the ray may hit in tmin < t <= t_last
        Bits surely;  ///< those of them that it hits for certain, in tmin < t < t_last
    };

    HWY_INLINE Lanes sort(const Block& block, float t_last) const {
        Float x[3], y[3], z[3], size[3];
        for (int k = 0; k < 3; ++k) {
            z[k] = load(block.corners[k][axes_[2]]) - splat(org_[2]);
            x[k] = hn::NegMulAdd(splat(shear_[0]), z[k],
                                 load(block.corners[k][axes_[0]]) - splat(org_[0]));
            y[k] = hn::NegMulAdd(splat(shear_[1]), z[k],
                                 load(block.corners[k][axes_[1]]) - splat(org_[1]));
            size[k] = hn::Max(hn::Abs(x[k]), hn::Abs(y[k]));
        }
        const Float u = hn::MulSub(x[2], y[1], y[2] * x[1]);
        const Float v = hn::MulSub(x[0], y[2], y[0] * x[2]);
        const Float w = hn::MulSub(x[1], y[0], y[1] * x[0]);
        // Counted in units of 2^-24: with M = extent_ and |sx|, |sy| <= 1, a sheared coordinate is
        // wrong by at most 6 M, and an edge function, with coordinates up to W, by
        // 30 M W + 72 M^2. Both shear factors were rounded twice.
        constexpr float unit = 0x1p-24f;
        const float scale = 64 * unit * extent_;
        const Float error = hn::MulAdd(splat(scale), max3(size[0], size[1], size[2]),
                                       splat(4 * unit * extent_ * scale));
        const Float least = min3(u, v, w), most = max3(u, v, w);
        const Mask beside = hn::And(least<hn::Neg(error), most> error);

        // A hit is at t / det, and t is wrong by at most 3 depths' worth of the error, det by 2 of
        // it. What this leaves is more than t in double loses when it is rounded to float.
        const Float sum = u + v + w;
        const Float det = hn::Abs(sum);
        const Float sign = hn::Xor(det, sum);
        const Float t =
            hn::Xor(splat(shear_[2]) * hn::MulAdd(u, z[0], hn::MulAdd(v, z[1], w * z[2])), sign);
        const float far = 3 * extent_ * std::abs(shear_[2]);
        const auto beyond = [&](float end) HWY_ATTR { return hn::NegMulAdd(splat(end), det, t); };
        const auto slack = [&](float end)
                               HWY_ATTR { return error * splat(far + 2 * std::abs(end)); };
        const Float after = beyond(tmin_), after_error = slack(tmin_);
        const Float over = beyond(t_last), over_error = slack(t_last);
        const Mask outside = hn::Or(after<hn::Neg(after_error), over> over_error);
        const Mask inside = hn::Or(least > error, most < hn::Neg(error));
        const Mask within = hn::And(after > after_error, over < hn::Neg(over_error));
        return {all_lanes & ~bits(hn::Or(beside, outside)), bits(hn::And(inside, within))};
    }

private:
    std::array<int, 3> axes_;
    float org_[3], shear_[3], tmin_, extent_;
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

/// One ray's way through the scene, step by step, and the best hit so far.
template <bool any_hit>
class Query {
public:
    explicit Query(float tmax = infinity) { hit_.t = tmax; }

    /// Traces through an object's tree, or the part of it at `from`; `ray` is in the object's
    /// space. The query must be new.
    HWY_NOINLINE void trace(const SceneObject& object, const Ray& ray, std::uint32_t instance,
                            WideLink from = WideLink::node(0)) {
        enter(object, ray, instance, from);
        while (step()) {
        }
    }

    /// Begins at the root of the scene.
    void start(const Scene& scene, const Ray& ray) {
        hit_.t = ray.tmax;
        hit_.instance = no_instance;
        hit_.triangle = 0;
        top_ = base_ = 0;
        if (scene.single) return enter(scene.objects[0], ray, 0, WideLink::node(0));
        scene_ = &scene;
        world_ = ray;
        world_box_ = BoxRay(ray);
        mailbox_ = Mailbox();
        leave();
        next_ = WideLink::node(0);
    }

    /// Visits a node or a block of triangles; false when none is left.
    HWY_INLINE bool step() {
        const bool leaf = at_leaf();
        leaf ? filter() : meet();
        return leaf ? decide() : descend();
    }

    bool at_leaf() const { return next_.is_leaf(); }

    /// Puts the children that the ray meets on the stack.
    HWY_INLINE void meet() {
        const Node& node = tree_->nodes[next_.first()];
        Float start;
        const Mask hit = box_->meets(node, hit_.t, start);
        if constexpr (!any_hit) hn::StoreU(compress(start, hit), lanes_tag, starts_ + top_);
        hn::StoreU(compress(load_links(node), hit), lanes_tag, links_ + top_);
        met_ = std::popcount(bits(hit));
        top_ += met_;
    }

    /// Chooses among them. False, as of decide(), when nothing is left to visit.
    HWY_INLINE bool descend() {
        // Any order finds some occluder, and sorting costs more than it saves.
        if constexpr (!any_hit) bring_nearest_up(starts_, links_, top_ - met_, top_);
        return pop();
    }

    /// Sorts the triangles of the block.
    HWY_INLINE void filter() { lanes_ = filter_.sort(object_->blocks[next_.first()], hit_.t); }

    /// Tests what filter() left open, and goes on.
    HWY_INLINE bool decide() {
        const Block& block = object_->blocks[next_.first()];
        if (any_hit && lanes_.surely) {
            hit_.instance = instance_;
            return false;
        }
        for (Bits may = lanes_.maybe; may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            test(block, lane);
        }
        if (any_hit && hit_.valid()) return false;
        if (next_.count() > 1) {
            next_ = WideLink::leaf(next_.first() + 1, next_.count() - 1);
            return true;
        }
        return pop();
    }

    /// Asks for the memory of the next step.
    HWY_INLINE void prefetch() const {
        if (!next_.is_leaf())
            prefetch(&tree_->nodes[next_.first()], sizeof(Node));
        else
            prefetch(&object_->blocks[next_.first()], sizeof(Block::corners));
    }

    bool found() const { return hit_.valid(); }
    Hit result() const { return hit_.valid() ? hit_ : Hit{}; }

private:
    static HWY_INLINE void prefetch(const void* at, std::size_t bytes) {
        for (std::size_t i = 0; i < bytes; i += 64)
            hwy::Prefetch(reinterpret_cast<const char*>(at) + i);
    }

    HWY_INLINE void enter(const SceneObject& object, const Ray& ray, std::uint32_t instance,
                          WideLink from) {
        object_ = &object;
        tree_ = &object.tree;
        ray_ = ray;
        object_box_ = BoxRay(ray);
        box_ = &object_box_;
        filter_ = TriangleFilter(ray, object.tree.bounds);
        exact_.reset();
        instance_ = instance;
        next_ = from;
    }

    void leave() {
        object_ = nullptr;
        tree_ = &scene_->top;
        box_ = &world_box_;
        base_ = 0;
    }

    /// Takes the next off the stack, which may end an instance.
    HWY_INLINE bool pop() {
        while (true) {
            while (top_ > base_) {
                --top_;
                if (!any_hit && !(starts_[top_] <= hit_.t)) continue;
                next_ = std::bit_cast<WideLink>(links_[top_]);
                if (!object_ && next_.is_leaf()) return enter_instance();
                return true;
            }
            if (top_ == 0) return false;
            leave();
        }
    }

    /// Goes into the first instance of a leaf and leaves the others on the stack.
    bool enter_instance() {
        const std::uint32_t item = scene_->items[next_.first()];
        if (next_.count() > 1) {
            starts_[top_] = world_.tmin;
            links_[top_++] =
                std::bit_cast<float>(WideLink::leaf(next_.first() + 1, next_.count() - 1));
        }
        if (mailbox_.test_and_set(item)) return pop();
        const WideInstance& instance = scene_->instances[item];
        base_ = top_;
        enter(scene_->objects[instance.object], transformed(world_, instance.object_from_world),
              instance.id, WideLink::node(0));
        return true;
    }

    /// Tests the triangle in a lane.
    void test(const Block& block, int lane) {
        const std::uint32_t triangle = block.ids[lane];
        // The best hit so far is met again in each leaf that its triangle reaches.
        if (triangle == hit_.triangle && instance_ == hit_.instance) return;
        if (!exact_) exact_.emplace(ray_);
        TriangleHit found;
        if (exact_->hits(block, lane, found)) take(found, triangle);
    }

    void take(const TriangleHit& found, std::uint32_t triangle) {
        const auto precedes = [&] {
            return std::pair(instance_, triangle) < std::pair(hit_.instance, hit_.triangle);
        };
        if (found.t < hit_.t || (found.t == hit_.t && hit_.valid() && precedes()))
            hit_ = {found.t, found.u, found.v, instance_, triangle};
    }

    BoxRay object_box_;
    TriangleFilter filter_;
    std::optional<TriangleRay> exact_;  ///< made when first needed
    Hit hit_;
    WideLink next_;           ///< what to visit
    int top_ = 0, base_ = 0;  ///< of the stack, and of the part that belongs to the object
    int met_;                 ///< by the last meet()
    TriangleFilter::Lanes lanes_;
    const Tree* tree_;
    const BoxRay* box_;
    const SceneObject* object_;  ///< null in the level of instances
    std::uint32_t instance_;
    Ray ray_;

    const Scene* scene_ = nullptr;
    Ray world_;
    BoxRay world_box_;
    Mailbox mailbox_;

    static constexpr int stack_size = 2 * wide_stack_size<W>;
    float starts_[stack_size];
    float links_[stack_size];  // of WideLinks the bits, which SIMD moves as floats
};

template <bool any_hit>
Hit trace(const Scene& scene, const Ray& ray) {
    if (!is_sound(ray)) return {};
    Query<any_hit> query;
    query.start(scene, ray);
    while (query.step()) {
    }
    return query.result();
}

/// Traces many rays through one object, some at a time and all of these by one step in turn: first
/// what has no branches, for all of them, then what branches on it. A mispredicted branch then
/// costs little, for what it waits for is known, and memory has the time of a turn to answer.
template <bool any_hit, class Done>
class Wave {
public:
    /// Calls `done(i, hit)` for each ray.
    Wave(const Scene& scene, std::span<const Ray> rays, const Done& done)
        : scene_(scene), rays_(rays), done_(done) {
        for (int q = 0; q < size && start(q); ++q) place(q);
        while (nodes_.count + leaves_.count > 0) {
            take_turn(
                nodes_, [](auto& query) HWY_ATTR { query.meet(); },
                [](auto& query) HWY_ATTR { return query.descend(); });
            take_turn(
                leaves_, [](auto& query) HWY_ATTR { query.filter(); },
                [](auto& query) HWY_ATTR { return query.decide(); });
        }
    }

private:
    static constexpr int size = 16;

    struct List {
        int queries[size + 1];  ///< one more, to write to without a branch
        int count = 0;
    };

    template <class Compute, class Branch>
    HWY_INLINE void take_turn(List& list, const Compute& compute, const Branch& branch) {
        const int count = std::exchange(list.count, 0);
        for (int i = 0; i < count; ++i) compute(queries_[list.queries[i]]);
        for (int i = 0; i < count; ++i) {
            const int q = list.queries[i];
            if (branch(queries_[q])) {
                place(q);
                continue;
            }
            done_(ray_of_[q], queries_[q].result());
            if (start(q)) place(q);
        }
    }

    /// Gives the query the next ray; false when there is none left.
    HWY_INLINE bool start(int q) {
        while (next_ < rays_.size()) {
            const std::size_t i = next_++;
            if (is_sound(rays_[i])) {
                queries_[q].start(scene_, rays_[i]);
                ray_of_[q] = i;
                return true;
            }
            done_(i, Hit{});
        }
        return false;
    }

    HWY_INLINE void place(int q) {
        queries_[q].prefetch();
        const bool leaf = queries_[q].at_leaf();
        nodes_.queries[nodes_.count] = leaves_.queries[leaves_.count] = q;
        nodes_.count += !leaf;
        leaves_.count += leaf;
    }

    const Scene& scene_;
    std::span<const Ray> rays_;
    const Done& done_;
    std::size_t next_ = 0;
    List nodes_, leaves_;
    std::size_t ray_of_[size];
    Query<any_hit> queries_[size];
};

/// Calls `done(i, hit)` for each ray.
template <bool any_hit, class Done>
void trace(const Scene& scene, std::span<const Ray> rays, const Done& done) {
    // Where rays enter instances, waves cost more than they save.
    if (scene.single)
        Wave<any_hit, Done>(scene, rays, done);
    else
        for (std::size_t i = 0; i < rays.size(); ++i) done(i, trace<any_hit>(scene, rays[i]));
}

void closest_hits(const Scene& scene, std::span<const Ray> rays, std::span<Hit> hits) {
    trace<false>(scene, rays, [&](std::size_t i, const Hit& hit) { hits[i] = hit; });
}

void occluded(const Scene& scene, std::span<const Ray> rays, std::span<std::uint8_t> blocked) {
    trace<true>(scene, rays, [&](std::size_t i, const Hit& hit) { blocked[i] = hit.valid(); });
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
