// Shadow rays from one point, a light's, to hundreds of points of a tile.
//
// The traversal is that of worker/shaft-inl.h. Where groups are wide against the boxes they go on
// alone, ray by ray in the lanes, as Wald's packets (2001); where few rays of a group are left
// those go on as single rays (worker/ray-inl.h). The triangles that blocked the light's rays last
// come first (Wald, Kollig, Benthin, Keller and Slusallek, "Interactive Global Illumination using
// Fast Ray Tracing", 2002, cache them for each light).
#if defined(TESSERA_SHADOW_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_SHADOW_INL_H
#undef TESSERA_SHADOW_INL_H
#else
#define TESSERA_SHADOW_INL_H
#endif

#include <algorithm>
#include <optional>

#include "worker/packet-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

/// The shadow rays of a chunk against one object, in the object's space.
class ObjectShadows : ObjectRays {
public:
    ObjectShadows(const Scene& scene, const SceneObject& object, std::uint32_t instance,
                  const Affine* object_from_world, const vec3& light, const PointRays& rays,
                  Alive& alive, OccluderCache* cache)
        : ObjectRays(scene, object, instance, object_from_world, light, rays),
          alive_(alive),
          cache_(cache) {}

    void run(Bits groups) {
        trace(
            alive_, groups,
            [&](Bits carried) {
                ask_cache(carried);
                walk(carried);
            },
            [&](int g) { trace_singly(g, alive_.rays[g], WideLink::node(0)); });
    }

private:
    /// So few rays are faster one by one.
    static constexpr int few = 1;

    void ask_cache(Bits groups) {
        if (!cache_) return;
        const auto known = cache_->blocks;
        for (const OccluderCache::Block& b : known)
            if (b.instance == instance_ && (groups & alive_.groups))
                test_block(b.first, groups & alive_.groups);
    }

    void walk(Bits carried) {
        struct Entry {
            WideLink link;
            Bits groups;
        };
        Entry stack[wide_stack_size<W>];
        int top = 0;
        stack[top++] = {WideLink::node(0), carried};
        while (top > 0) {
            const auto [link, of_entry] = stack[--top];
            const Bits groups = of_entry & alive_.groups;
            if (!groups) continue;
            if (link.is_leaf()) {
                for (std::uint32_t i = 0; i < link.count(); ++i)
                    test_block(link.first() + i, groups & alive_.groups);
                continue;
            }
            const Node& node = object_.tree.nodes[link.first()];
            const Boxes boxes = shaft_.children(node);
            const Bits met = bits(may_meet(boxes, shaft_.chunk()));
            if (!met) continue;
            const Float extent = extent_of(boxes);
            const Bits is_narrow =
                met & bits(splat(shaft_.spread()) * boxes.hi[2] < splat(narrow) * extent);
            for_each_bit(is_narrow, [&](int i) {
                prefetch_target(object_, node.children[i]);
                stack[top++] = {node.children[i], groups};
            });
            for_each_bit(met & ~is_narrow, [&](int i) HWY_ATTR {
                const Boxes box = shaft_.child(node, i);
                const Bits reached = bits(may_meet(box, shaft_.groups())) & groups;
                if (!reached) return;
                const WideLink child = node.children[i];
                Bits apart = 0;
                if (!child.is_leaf()) {
                    const Float across = extent_of(box);
                    apart = reached & bits(shaft_.spreads() * box.lo[2] > splat(wide) * across);
                }
                for_each_bit(apart & alive_.groups, [&](int g) { walk_group(g, child); });
                if (!(reached & ~apart)) return;
                prefetch_target(object_, child);
                stack[top++] = {child, reached & ~apart};
            });
        }
    }

    /// One group from a node on: its rays in the lanes.
    HWY_NOINLINE void walk_group(int g, WideLink from) {
        struct Entry {
            WideLink link;
            Bits rays;
        };
        const GroupRays& rays = group_rays(g);
        const GroupBounds bounds = bounds_of(rays, alive_.rays[g]);
        Entry stack[wide_stack_size<W>];
        int top = 0;
        stack[top++] = {from, alive_.rays[g]};
        while (top > 0) {
            const auto [link, of_entry] = stack[--top];
            const Bits left = of_entry & alive_.rays[g];
            if (std::popcount(left) <= few) {
                trace_singly(g, left, link);
                continue;
            }
            if (link.is_leaf()) {
                for (std::uint32_t i = 0; i < link.count(); ++i)
                    test_block(link.first() + i, g, bounds);
                continue;
            }
            const Node& node = object_.tree.nodes[link.first()];
            const Bits met = bits(may_meet(shaft_.children(node), bounds.slopes));
            for_each_bit(met, [&](int i) HWY_ATTR {
                const Bits reached = left & rays_that_meet(rays, shaft_.child(node, i));
                if (!reached) return;
                prefetch_target(object_, node.children[i]);
                stack[top++] = {node.children[i], reached};
            });
        }
    }

    void trace_singly(int g, Bits rays, WideLink from) {
        for_each_bit(rays, [&](int i) {
            Query<true> query(scene_, 1);
            const Ray ray = this->ray(g, i, 1);
            if (!is_finite(ray.org) || !is_finite(ray.dir)) return;
            query.trace(object_, ray, instance_, from);
            if (query.found()) alive_.block(g, Bits(1) << i);
        });
    }

    /// A block of triangles against groups.
    HWY_NOINLINE void test_block(std::uint32_t index, Bits groups) {
        groups = newcomers(index, groups);
        if (!groups) return;
        const Block& block = object_.blocks[index];
        Facets facets;
        bool useful = false;
        for (Bits may = may_hit<true>(block, shaft_, shaft_.chunk(), shaft_.chunk_ends(), facets);
             may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            const Met met = groups_met(facets, lane);
            const Bits blocked = met.surely & groups & alive_.groups;
            alive_.block_groups(blocked);
            useful |= blocked != 0;
            const Bits open = met.maybe & groups & alive_.groups;
            if (open) useful |= test(block, lane, facets, open);
        }
        if (useful) remember(index);
    }

    /// The same against one group.
    HWY_NOINLINE void test_block(std::uint32_t index, int g, const GroupBounds& bounds) {
        if (!newcomers(index, Bits(1) << g)) return;
        const Block& block = object_.blocks[index];
        Facets facets;
        bool useful = false;
        for (Bits may = may_hit<true>(block, shaft_, bounds.slopes, bounds.ends, facets); may;
             may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            useful |= test(block, lane, facets, Bits(1) << g);
        }
        if (useful) remember(index);
    }

    struct Met {
        Bits maybe;   ///< groups of which not every ray passes outside one edge or ends too soon
        Bits surely;  ///< groups all of whose rays hit
    };
    /// How the groups that the shaft holds meet a triangle.
    HWY_INLINE Met groups_met(const Facets& f, int lane) const {
        const Passing p = passing(f, lane);
        Float middle = hn::Zero(lanes_tag), half = middle;
        for (int k = 0; k < 3; ++k) {
            const Float n = splat(f.plane[k][lane]);
            const Interval ends = shaft_.ends(k);
            middle = hn::MulAdd(n, ends.middle, middle);
            half = hn::MulAdd(hn::Abs(n), ends.half, half);
        }
        const float slack = f.edge_slack[lane];
        const Mask crosses =
            hn::And(p.most >= splat(-slack), middle + half >= splat(f.before[lane]));
        return {bits(hn::And(p.overlap, crosses)),
                bits(hn::And(p.least > splat(slack), middle - half > splat(f.beyond[lane])))};
    }

    /// Blocks the rays of the groups that hit the triangle; tells whether there are any.
    HWY_INLINE bool test(const Block& block, int lane, const Facets& facets, Bits groups) {
        Float n[3][3];
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < 3; ++i) n[k][i] = splat(facets.edges[k][i][lane]);
        const Float slack = splat(facets.edge_slack[lane]);
        const Float beyond = splat(facets.beyond[lane]), before = splat(facets.before[lane]);
        const Float plane[3] = {splat(facets.plane[0][lane]), splat(facets.plane[1][lane]),
                                splat(facets.plane[2][lane])};
        std::optional<Facet> facet;
        bool any = false;
        for (; groups; groups &= groups - 1) {
            const int g = std::countr_zero(groups);
            const GroupRays& rays = group_rays(g);
            for (int k = 0; k < group_size; k += W) {
                const Float u = load(rays.u + k), v = load(rays.v + k);
                const auto distance = [&](int i) HWY_ATTR {
                    return hn::MulAdd(n[i][0], u, hn::MulAdd(n[i][1], v, n[i][2]));
                };
                const Float least = min3(distance(0), distance(1), distance(2));
                const Float along =
                    hn::MulAdd(plane[0], load(rays.x + k),
                               hn::MulAdd(plane[1], load(rays.y + k), plane[2] * load(rays.z + k)));
                const Bits maybe =
                    bits(hn::And(least >= hn::Neg(slack), along >= before)) & alive_.rays[g] >> k;
                if (!maybe) continue;
                const Bits hit = maybe & bits(hn::And(least > slack, along > beyond));
                if (hit) alive_.block(g, hit << k), any = true;
                if (hit == maybe) continue;
                if (!facet) facet.emplace(block.lane(lane), shaft_);
                any |= decide(*facet, block, lane, g, k, maybe & ~hit);
            }
        }
        return any;
    }

    /// Blocks those of the rays that hit the triangle.
    HWY_INLINE bool decide(const Facet& facet, const Block& block, int lane, int g, int k,
                           Bits maybe) {
        const GroupRays& rays = group_rays(g);
        Bits crossed, maybe_crossed;
        facet.crossed(rays.x + k, rays.y + k, rays.z + k, crossed, maybe_crossed);
        maybe &= maybe_crossed;
        if (!maybe) return false;
        Bits inside, maybe_inside;
        facet.inside(load(rays.u + k), load(rays.v + k), inside, maybe_inside);
        Bits hit = maybe & inside & crossed;
        for_each_bit(maybe & maybe_inside & ~hit, [&](int i) {
            TriangleHit found;
            if (TriangleRay(ray(g, k + i, 1)).hits(block.lane(lane), found)) hit |= Bits(1) << i;
        });
        if (hit) alive_.block(g, hit << k);
        return hit != 0;
    }

    void remember(std::uint32_t index) {
        if (!cache_) return;
        auto& known = cache_->blocks;
        if (known[0].instance == instance_ && known[0].first == index) return;
        const auto same = std::find_if(known.begin(), known.end() - 1, [&](const auto& b) {
            return b.instance == instance_ && b.first == index;
        });
        std::move_backward(known.begin(), same, same + 1);
        known[0] = {instance_, index};
    }

    Alive& alive_;
    OccluderCache* cache_;
};

/// The same for all instances, each in its own space.
class InstanceShadows {
public:
    InstanceShadows(const Scene& scene, const vec3& light, const PointRays& rays, Alive& alive,
                    OccluderCache* cache)
        : scene_(scene), light_(light), rays_(rays), alive_(alive), cache_(cache) {}

    Bits open() const { return alive_.groups; }
    void visit(const WideInstance& instance, Bits groups) {
        ObjectShadows(scene_, scene_.object(instance.object), instance.id, instance.transform(),
                      light_, rays_, alive_, cache_)
            .run(groups);
    }
    void trace_singly(int g) {
        for_each_bit(alive_.rays[g], [&](int i) {
            const Ray ray{light_, 0, rays_.direction(g, i, nullptr), 1};
            if (trace<true>(scene_, ray).valid()) alive_.block(g, Bits(1) << i);
        });
    }
    float reach(int g, const Shaft& shaft) const { return shaft.far(g); }

private:
    const Scene& scene_;
    const vec3& light_;
    const PointRays& rays_;
    Alive& alive_;
    OccluderCache* cache_;
};

RayMask occluded_from(const Scene& scene, const vec3& light, const Targets& targets,
                      const RayMask& wanted, OccluderCache* cache) {
    RayMask blocked{};
    for (int first = 0; first < Targets::max_groups; first += W) {
        const Alive asked(wanted, targets, first);
        if (!asked.groups) continue;
        Alive alive = asked;
        const PointRays rays(light, targets, first);
        if (scene.single) {
            ObjectShadows(scene, scene.object(0), scene.single_id, nullptr, light, rays, alive,
                          cache)
                .run(alive.groups);
        } else {
            InstanceShadows query(scene, light, rays, alive, cache);
            trace_instances(scene, light, rays, alive, query);
        }
        for (int g = 0; g < W; ++g)
            blocked[std::size_t(first + g)] = std::uint16_t(asked.rays[g] & ~alive.rays[g]);
    }
    return blocked;
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
