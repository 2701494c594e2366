// Up to 256 rays from one origin, a tile's: what worker/shadow-inl.h and worker/primary-inl.h have
// in common. Rays are made a group at a time, when something must look at single ones; those of an
// instance in its own space.
#if defined(TESSERA_PACKET_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_PACKET_INL_H
#undef TESSERA_PACKET_INL_H
#else
#define TESSERA_PACKET_INL_H
#endif

#include <utility>

#include "worker/facet-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

/// The rays of a chunk that are still to be traced.
struct Alive {
    alignas(64) Bits rays[W];  ///< of each group
    Bits groups = 0;           ///< that have any

    /// The `wanted` rays of the W groups from `first`, as far as their targets are finite.
    Alive(const RayMask& wanted, const Targets& targets, int first) {
        for (int g = 0; g < W; ++g) {
            const auto i = std::size_t(first + g);
            rays[g] = wanted[i] & targets.finite[i];
            if (rays[g]) groups |= Bits(1) << g;
        }
    }

    void block(int g, Bits blocked) {
        rays[g] &= ~blocked;
        if (!rays[g]) groups &= ~(Bits(1) << g);
    }
    /// The groups whose ray `i` lives.
    HWY_INLINE Mask in_place(int i) const {
        constexpr hn::RebindToUnsigned<decltype(lanes_tag)> tag;
        return hn::RebindMask(lanes_tag,
                              hn::TestBit(hn::Load(tag, rays), hn::Set(tag, Bits(1) << i)));
    }
    void block_groups(Bits blocked) {
        for_each_bit(blocked, [&](int g) { rays[g] = 0; });
        groups &= ~blocked;
    }
};

/// W groups of rays from one origin to points.
class PointRays {
public:
    PointRays(const vec3& origin, const Targets& targets, int first_group)
        : origin_(origin), targets_(targets), first_(first_group) {}

    vec3 direction(int g, int i, const mat3* from_world) const {
        const vec3 d = targets_.point(std::size_t((first_ + g) * group_size + i)) - origin_;
        return from_world ? *from_world * d : d;
    }

    /// The directions of W rays of group g, from ray `k`.
    HWY_INLINE void directions(int g, int k, const mat3* from_world, Float (&d)[3]) const {
        const int at = (first_ + g) * group_size + k;
        for (int i = 0; i < 3; ++i) d[i] = load(targets_.p[i] + at) - splat(origin_[i]);
        if (from_world) transform(*from_world, d);
    }

    /// The directions of ray `i` of every group.
    HWY_INLINE void lanes(int i, const mat3* from_world, Float (&d)[3]) const {
        for (int k = 0; k < 3; ++k)
            d[k] = load(targets_.by_place[k][i] + first_) - splat(origin_[k]);
        if (from_world) transform(*from_world, d);
    }

private:
    /// In the order of Affine::vector, for the same bits.
    static HWY_INLINE void transform(const mat3& m, Float (&d)[3]) {
        const Float x = d[0], y = d[1], z = d[2];
        for (int i = 0; i < 3; ++i)
            d[i] = splat(m[0][i]) * x + splat(m[1][i]) * y + splat(m[2][i]) * z;
    }

    const vec3& origin_;
    const Targets& targets_;
    int first_;
};

/// One group of a shaft, ray by ray: made when the shaft must look at single rays. Along the
/// shaft's axes: where the rays end, relative to their origin, and their slopes.
struct GroupRays {
    alignas(64) float x[group_size], y[group_size], z[group_size];
    alignas(64) float u[group_size], v[group_size];
};

/// Bounds the distance along each axis of what lies in the box.
inline float reach_of(const Box& box, const vec3& org) {
    return std::max(max_component(abs(box.lo - org)), max_component(abs(box.hi - org)));
}

/// Sets `shaft` to as many of the wanted groups at a time as it can hold and calls `walk` with
/// them; calls `singly` with each group that it cannot. The others are as in Shaft::set().
template <class Lanes, class Walk, class Singly>
void for_each_shaft(Shaft& shaft, const vec3& org, Lanes&& lanes, Bits wanted, float reach,
                    Walk&& walk, Singly&& singly) {
    for (Bits left = wanted; left;) {
        const Bits lowest = left & (~left + 1);
        Bits carried = shaft.set(org, lanes, left, reach);
        if (!carried) carried = shaft.set(org, lanes, lowest, reach);
        if (carried) {
            walk(carried);
        } else {
            carried = lowest;
            singly(std::countr_zero(lowest));
        }
        left &= ~carried;
    }
}

/// The rays of a chunk against one object, in the object's space.
class ObjectRays {
protected:
    ObjectRays(const Scene& scene, const SceneObject& object, std::uint32_t instance,
               const Affine* object_from_world, const vec3& origin, const PointRays& rays)
        : scene_(scene),
          object_(object),
          instance_(instance),
          from_world_(object_from_world ? &object_from_world->linear : nullptr),
          org_(object_from_world ? object_from_world->point(origin) : origin),
          rays_(rays) {}

    /// A group is wide where its rays are this share of a box's extent apart.
    static constexpr float wide = 1.0f / 8;
    /// So narrow a shaft meets a box with all its groups or hardly at all.
    static constexpr float narrow = 1.0f / 4;

    /// Takes the rays of the groups that live, as for_each_shaft() does.
    template <class Walk, class Singly>
    void trace(const Alive& alive, Bits groups, Walk&& walk, Singly&& singly) {
        const auto lanes = [&](int i, Float(&d)[3]) HWY_ATTR {
            rays_.lanes(i, from_world_, d);
            return alive.in_place(i);
        };
        for_each_shaft(shaft_, org_, lanes, groups & alive.groups,
                       reach_of(object_.tree.bounds, org_), walk, singly);
    }

    Ray ray(int g, int i, float tmax) const {
        return {org_, 0, rays_.direction(g, i, from_world_), tmax};
    }

    /// Of the groups those that did not meet the block lately; now they have. Leaves share blocks.
    Bits newcomers(std::uint32_t block, Bits groups) {
        Visit& visit = visits_[block % std::size(visits_)];
        if (visit.block != block) visit = {block, 0};
        return groups & ~std::exchange(visit.groups, visit.groups | groups);
    }

    const GroupRays& group_rays(int g) {
        GroupRays& out = group_rays_[g];
        if (known_rays_ >> g & 1) return out;
        known_rays_ |= Bits(1) << g;
        for (int k = 0; k < group_size; k += W) {
            Float d[3];
            rays_.directions(g, k, from_world_, d);
            const Float x = d[shaft_.axis(0)], y = d[shaft_.axis(1)];
            const Float z = splat(shaft_.sign()) * d[shaft_.axis(2)];
            const Float inv = splat(1) / z;
            store(x, out.x + k), store(y, out.y + k), store(z, out.z + k);
            store(x * inv, out.u + k), store(y * inv, out.v + k);
        }
        return out;
    }

    struct GroupBounds {
        Slopes slopes;
        Boxes ends;
    };

    GroupBounds bounds_of(const GroupRays& rays, Bits among) const {
        const auto lo = [&](const float* x) HWY_ATTR {
            float least = infinity;
            for (int k = 0; k < group_size; k += W)
                least = std::min(least, least_of(load(x + k), mask_of(among >> k & all_lanes)));
            return least;
        };
        const auto hi = [&](const float* x) HWY_ATTR {
            float most = -infinity;
            for (int k = 0; k < group_size; k += W)
                most = std::max(most, greatest_of(load(x + k), mask_of(among >> k & all_lanes)));
            return most;
        };
        const float margin = shaft_.widening(), far = hi(rays.z);
        return {{splat(lo(rays.u) - margin), splat(hi(rays.u) + margin), splat(lo(rays.v) - margin),
                 splat(hi(rays.v) + margin), splat(far * (1 + 0x1p-20f))},
                {{splat(lo(rays.x)), splat(lo(rays.y)), splat(lo(rays.z))},
                 {splat(hi(rays.x)), splat(hi(rays.y)), splat(far)}}};
    }

    HWY_INLINE Bits rays_that_meet(const GroupRays& rays, const Boxes& box) const {
        const Float margin = splat(shaft_.widening()), longer = splat(1 + 0x1p-20f);
        Bits reached = 0;
        for (int k = 0; k < group_size; k += W) {
            const Float u = load(rays.u + k), v = load(rays.v + k);
            const Slopes s{u - margin, u + margin, v - margin, v + margin,
                           load(rays.z + k) * longer};
            reached |= bits(may_meet(box, s)) << k;
        }
        return reached;
    }

    /// How the shaft's groups pass a triangle's edges.
    struct Passing {
        Float least, most;  ///< bounds of how far inside the edge that keeps out most
        Mask overlap;       ///< of the slopes of rays and corners
    };
    HWY_INLINE Passing passing(const Facets& f, int lane) const {
        Passing p{splat(infinity), splat(infinity), hn::FirstN(lanes_tag, W)};
        const Interval u = shaft_.slopes(0), v = shaft_.slopes(1);
        for (const auto& n : f.edges) {
            const Float x = splat(n[0][lane]), y = splat(n[1][lane]), z = splat(n[2][lane]);
            const Float middle = hn::MulAdd(x, u.middle, hn::MulAdd(y, v.middle, z));
            const Float half = hn::MulAdd(hn::Abs(x), u.half, hn::Abs(y) * v.half);
            p.most = hn::Min(p.most, middle + half);
            p.least = hn::Min(p.least, middle - half);
        }
        for (int k = 0; k < 2; ++k) {
            p.overlap = hn::And(p.overlap, shaft_.slopes(k, 1) >= splat(f.slopes[k][0][lane]));
            p.overlap = hn::And(p.overlap, shaft_.slopes(k, 0) <= splat(f.slopes[k][1][lane]));
        }
        return p;
    }

    const Scene& scene_;
    const SceneObject& object_;
    std::uint32_t instance_;
    const mat3* from_world_;
    vec3 org_;
    const PointRays& rays_;
    Shaft shaft_;

private:
    struct Visit {
        std::uint32_t block = ~0u;
        Bits groups = 0;
    };
    Visit visits_[16];
    Bits known_rays_ = 0;
    GroupRays group_rays_[W];
};

/// Links to visit with the groups or rays that reach them, those pushed after a mark() in order of
/// their z.
class NearestFirst {
public:
    struct Entry {
        float z;
        WideLink link;
        Bits reached;
    };

    bool pop(Entry& entry) { return top_ > 0 && (entry = entries_[--top_], true); }
    void mark() { base_ = top_; }
    void push(const Entry& entry) {
        int place = top_++;
        for (; place != base_ && entries_[place - 1].z < entry.z; --place)
            entries_[place] = entries_[place - 1];
        entries_[place] = entry;
    }

private:
    Entry entries_[wide_stack_size<W>];
    int top_ = 0, base_ = 0;
};

/// Takes rays of a chunk through the instances that they may meet, the nearest first. Of `query`
/// open() tells the groups that are still to be traced; visit(instance, groups) traces them in an
/// instance; trace_singly(group) traces its rays, too wide for a shaft, in the whole scene; and
/// reach(group, shaft) bounds the z that still matter.
template <class Query>
class InstanceRays {
public:
    InstanceRays(const Scene& scene, const vec3& origin, const PointRays& rays, const Alive& alive,
                 Query& query)
        : scene_(scene), origin_(origin), rays_(rays), alive_(alive), query_(query) {}

    void run() {
        const auto living = [&](int i, Float(&d)[3]) HWY_ATTR {
            rays_.lanes(i, nullptr, d);
            return alive_.in_place(i);
        };
        for_each_shaft(
            shaft_, origin_, living, query_.open(), reach_of(scene_.top.bounds, origin_),
            [&](Bits carried) { walk(carried); }, [&](int g) { query_.trace_singly(g); });
    }

private:
    /// A group that covers this share of a box's extent goes on as single rays.
    static constexpr float wide = 1.0f / 2;

    void walk(Bits carried) {
        for (int g = 0; g < W; ++g) far_[g] = carried >> g & 1 ? query_.reach(g, shaft_) : 0;
        NearestFirst stack;
        stack.push({0, WideLink::node(0), carried});
        for (NearestFirst::Entry entry; stack.pop(entry);) {
            const Bits groups =
                entry.reached & query_.open() & ~done_ & bits(splat(entry.z) <= load(far_));
            if (!groups) continue;
            if (entry.link.is_leaf()) {
                visit(entry.link, groups);
                continue;
            }
            const Node& node = scene_.top.nodes[entry.link.first()];
            const Boxes boxes = shaft_.children(node);
            alignas(64) float start[W];
            store(boxes.lo[2], start);
            Slopes chunk = shaft_.chunk(), of_groups = shaft_.groups();
            chunk.far = hn::MaxOfLanes(lanes_tag, load(far_));
            of_groups.far = load(far_);
            stack.mark();
            for_each_bit(bits(may_meet(boxes, chunk)), [&](int i) HWY_ATTR {
                const Boxes box = shaft_.child(node, i);
                const Bits reached = bits(may_meet(box, of_groups)) & groups & ~done_;
                if (!reached) return;
                const Bits apart =
                    reached & bits(shaft_.spreads() * box.lo[2] > splat(wide) * extent_of(box));
                for_each_bit(apart, [&](int g) { query_.trace_singly(g); });
                done_ |= apart;
                if (reached & ~apart) stack.push({start[i], node.children[i], reached & ~apart});
            });
        }
    }

    void visit(WideLink leaf, Bits groups) {
        for (const std::uint32_t item : std::span(&scene_.items[leaf.first()], leaf.count()))
            query_.visit(scene_.instances[item], groups);
        for_each_bit(groups, [&](int g) { far_[g] = query_.reach(g, shaft_); });
    }

    const Scene& scene_;
    const vec3& origin_;
    const PointRays& rays_;
    const Alive& alive_;
    Query& query_;
    Shaft shaft_;
    Bits done_ = 0;  ///< groups that went on as single rays
    alignas(64) float far_[W];
};

template <class Query>
void trace_instances(const Scene& scene, const vec3& origin, const PointRays& rays,
                     const Alive& alive, Query& query) {
    InstanceRays<Query>(scene, origin, rays, alive, query).run();
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
