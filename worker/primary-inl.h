// Closest hits of hundreds of rays from one point: a camera's through a tile.
//
// The traversal is that of worker/shaft-inl.h, nearest boxes first. Candidates that no float bound
// puts beside a ray or behind its closest hit so far are decided in double, 16 rays of a group at
// once.
#if defined(TESSERA_PRIMARY_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_PRIMARY_INL_H
#undef TESSERA_PRIMARY_INL_H
#else
#define TESSERA_PRIMARY_INL_H
#endif

#include "worker/packet-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

/// The closest hits of a chunk's rays so far, group by group.
struct Closest {
    const Scene& scene;
    alignas(64) float t[chunk_size];  ///< zero for rays that there are not
    alignas(64) float u[chunk_size] = {};
    alignas(64) float v[chunk_size] = {};
    alignas(64) std::uint32_t instance[chunk_size];
    alignas(64) std::uint32_t triangle[chunk_size] = {};

    Closest(const Scene& of_scene, const Alive& alive) : scene(of_scene) {
        std::fill_n(instance, chunk_size, no_instance);
        std::fill_n(t, chunk_size, infinity);
        for (int g = 0; g < W; ++g)
            for_each_bit(all_rays & ~alive.rays[g], [&](int i) { t[g * group_size + i] = 0; });
    }
    Hit hit(int i) const {
        const bool found = instance[i] != no_instance;
        return named(scene, {found ? t[i] : infinity, u[i], v[i], instance[i], triangle[i]});
    }
    /// Takes the hit if it is closer, or as close and of lower ids.
    bool take(int i, const Hit& hit) {
        if (!(hit.t < t[i] || (hit.t == t[i] && hit.t < infinity && precedes(hit, i))))
            return false;
        t[i] = hit.t, u[i] = hit.u, v[i] = hit.v;
        instance[i] = hit.instance, triangle[i] = hit.triangle;
        return true;
    }
    /// The same for W rays from `first`; those that miss have a negative t.
    HWY_INLINE bool take(Float t_new, Float u_new, Float v_new, std::uint32_t of_instance,
                         std::uint32_t of_triangle, int first) {
        constexpr hn::RebindToUnsigned<decltype(lanes_tag)> tag;
        const Float t_old = load(t + first);
        const Mask ahead = t_new > splat(0);
        Mask closer = hn::And(ahead, t_new < t_old);
        const Bits ties = bits(hn::And(ahead, t_new == t_old));
        if (ties) {
            Bits won = 0;
            for_each_bit(ties, [&](int i) {
                const Hit hit{0, 0, 0, of_instance, of_triangle};
                if (precedes(hit, first + i)) won |= Bits(1) << i;
            });
            closer = hn::Or(closer, mask_of(won));
        }
        if (hn::AllFalse(lanes_tag, closer)) return false;
        // Not stored under a mask: what is read again soon would have to wait for that.
        store(hn::IfThenElse(closer, t_new, t_old), t + first);
        store(hn::IfThenElse(closer, u_new, load(u + first)), u + first);
        store(hn::IfThenElse(closer, v_new, load(v + first)), v + first);
        const auto ids = hn::RebindMask(tag, closer);
        const auto name = [&](std::uint32_t id, std::uint32_t* of) HWY_ATTR {
            hn::Store(hn::IfThenElse(ids, hn::Set(tag, id), hn::Load(tag, of + first)), tag,
                      of + first);
        };
        name(of_instance, instance);
        name(of_triangle, triangle);
        return true;
    }

    /// Bounds the z of the closest hits of a group's rays; `z(k)` tells those of W directions.
    template <class Z>
    HWY_INLINE float reach(int g, Z&& z) const {
        Float far = splat(0);
        for (int k = 0; k < group_size; k += W) {
            const Float of_rays = load(t + g * group_size + k);
            // Rays that there are not may have any z.
            far = hn::IfThenElse(of_rays > splat(0), hn::Max(far, of_rays * z(k)), far);
        }
        return hn::GetLane(hn::MaxOfLanes(lanes_tag, far)) * (1 + 0x1p-20f);
    }

private:
    bool precedes(const Hit& hit, int i) const {
        return scene.name_of(hit.instance, hit.triangle) < scene.name_of(instance[i], triangle[i]);
    }
};

/// TriangleRay::hits for a group of rays from one origin: the same operations in the same order,
/// and so the same bits, of as many rays at once as doubles fit.
class ExactGroup {
public:
    /// False when the directions are largest along different axes.
    bool set(const Shaft& shaft, const GroupRays& rays) {
        const float* along[3];  // by scene axis
        along[shaft.axis(0)] = rays.x, along[shaft.axis(1)] = rays.y, along[shaft.axis(2)] = rays.z;
        for (int k = 0; k < group_size; k += W) {
            Float size[3];
            for (int i = 0; i < 3; ++i) size[i] = hn::Abs(load(along[i] + k));
            // As axes_of() decides between equals.
            const Bits x_most = bits(hn::And(size[0] > size[1], size[0] > size[2]));
            const Bits y_most = bits(hn::And(hn::Not(size[0] > size[1]), size[1] > size[2]));
            const int z = x_most == all_lanes ? 0 : y_most == all_lanes ? 1 : 2;
            if (z == 2 && (x_most || y_most)) return false;
            if (k > 0 && z != axes_[2]) return false;
            axes_[2] = z;
        }

        axes_[0] = axes_[2] == 2 ? 0 : axes_[2] + 1;
        axes_[1] = axes_[0] == 2 ? 0 : axes_[0] + 1;
        double sign[3] = {1, 1, 1};
        sign[shaft.axis(2)] = shaft.sign();
        for (int k = 0; k < 3; ++k) org_[k] = shaft.origin()[axes_[k]];
        const Double z_sign = set(sign[axes_[2]]);
        const Double x_sign = set(sign[axes_[0]]), y_sign = set(sign[axes_[1]]);
        for (int i = 0; i < group_size; i += half_width) {
            const Double sz = z_sign / promoted(along[axes_[2]] + i);
            hn::Store(sz, tag, sz_ + i);
            hn::Store(promoted(along[axes_[0]] + i) * (x_sign * sz), tag, sx_ + i);
            hn::Store(promoted(along[axes_[1]] + i) * (y_sign * sz), tag, sy_ + i);
        }
        return true;
    }

    /// Lets `best`, of the group that starts at `at`, take the hits of the rays from `first` to
    /// `first` + W - 1; tells whether any was taken.
    HWY_INLINE bool test(const Block& block, int lane, std::uint32_t instance, Closest& best,
                         int at, int first) const {
        const float* const corners = &block.corners[0][0][0];
        double px[3], py[3], pz[3];
        for (int k = 0; k < 3; ++k) {
            const auto corner = [&](int axis) { return corners[(k * 3 + axes_[axis]) * W + lane]; };
            px[k] = corner(0) - org_[0], py[k] = corner(1) - org_[1], pz[k] = corner(2) - org_[2];
        }
        Found halves[2];
        for (int h = 0; h < 2; ++h) halves[h] = test_half(px, py, pz, first + h * half_width);
        const auto both = [&](auto part) HWY_ATTR {
            return hn::Combine(lanes_tag, hn::DemoteTo(half, halves[1].*part),
                               hn::DemoteTo(half, halves[0].*part));
        };
        return best.take(both(&Found::t), both(&Found::u), both(&Found::v), instance,
                         block.ids[lane], at + first);
    }

private:
    static constexpr hn::ScalableTag<double> tag{};
    static constexpr hn::Rebind<float, hn::ScalableTag<double>> half{};
    using Double = hn::Vec<hn::ScalableTag<double>>;
    static constexpr int half_width = int(hn::MaxLanes(hn::ScalableTag<double>()));
    static_assert(2 * half_width == W);

    /// Hits of half as many rays, with a negative t where there are none.
    struct Found {
        Double t, u, v;
    };

    HWY_INLINE Found test_half(const double* px, const double* py, const double* pz, int i) const {
        Double x[3], y[3];
        const Double sx = hn::Load(tag, sx_ + i), sy = hn::Load(tag, sy_ + i);
        Double width = set(0);
        for (int k = 0; k < 3; ++k) {
            x[k] = set(px[k]) - sx * set(pz[k]);
            y[k] = set(py[k]) - sy * set(pz[k]);
            width = hn::Max(width, hn::Max(hn::Abs(x[k]), hn::Abs(y[k])));
        }
        const Double u = x[2] * y[1] - y[2] * x[1];
        const Double v = x[0] * y[2] - y[0] * x[2];
        const Double w = x[1] * y[0] - y[1] * x[0];
        const auto beside =
            hn::And(hn::Min(u, hn::Min(v, w)) < set(0), hn::Max(u, hn::Max(v, w)) > set(0));
        const Double det = u + v + w;
        const auto sound = hn::Abs(det) > set(8 * 0x1p-53) * width * width;
        const auto hits = hn::AndNot(beside, sound);

        const Double scale = set(1) / det;
        const Double t =
            (u * set(pz[0]) + v * set(pz[1]) + w * set(pz[2])) * (hn::Load(tag, sz_ + i) * scale);
        // What float rounds to infinity is a miss.
        const auto finite = hn::And(hits, t < set(0x1.ffffffp127));
        return {hn::IfThenElse(finite, t, set(-1)), v * scale, w * scale};
    }

    static HWY_INLINE Double set(double x) { return hn::Set(tag, x); }
    static HWY_INLINE Double promoted(const float* x) {
        return hn::PromoteTo(tag, hn::Load(half, x));
    }

    int axes_[3];
    double org_[3];
    alignas(64) double sx_[group_size], sy_[group_size], sz_[group_size];
};

/// The closest hits of a chunk of rays in one object.
class ObjectClosest : ObjectRays {
public:
    ObjectClosest(const Scene& scene, const SceneObject& object, std::uint32_t instance,
                  const Affine* object_from_world, const vec3& origin, const PointRays& rays,
                  const Alive& alive, Closest& best)
        : ObjectRays(scene, object, instance, object_from_world, origin, rays),
          alive_(alive),
          best_(best) {}

    void run(Bits groups) {
        trace(
            alive_, groups,
            [&](Bits carried) {
                for (int g = 0; g < W; ++g) far_[g] = carried >> g & 1 ? reach(g) : 0;
                walk(carried);
            },
            [&](int g) { trace_singly(g, alive_.rays[g]); });
    }

private:
    void walk(Bits carried) {
        NearestFirst stack;
        stack.push({0, WideLink::node(0), carried});
        for (NearestFirst::Entry entry; stack.pop(entry);) {
            const Bits groups = entry.reached & bits(splat(entry.z) <= load(far_));
            if (!groups) continue;
            if (entry.link.is_leaf()) {
                for (std::uint32_t i = 0; i < entry.link.count(); ++i)
                    test_block(entry.link.first() + i, groups);
                continue;
            }
            const Node& node = object_.tree.nodes[entry.link.first()];
            const Boxes boxes = shaft_.children(node);
            Slopes slopes = shaft_.chunk();
            slopes.far = hn::MaxOfLanes(lanes_tag, load(far_));
            const Bits met = bits(may_meet(boxes, slopes));
            if (!met) continue;
            const Float extent = extent_of(boxes);
            const Bits is_narrow =
                met & bits(splat(shaft_.spread()) * boxes.hi[2] < splat(narrow) * extent);
            alignas(64) float start[W];
            store(boxes.lo[2], start);
            stack.mark();
            for_each_bit(met, [&](int i) HWY_ATTR {
                const WideLink child = node.children[i];
                if (is_narrow >> i & 1) return stack.push({start[i], child, groups});
                const Boxes box = shaft_.child(node, i);
                Slopes of_groups = shaft_.groups();
                of_groups.far = load(far_);
                const Bits reached = bits(may_meet(box, of_groups)) & groups;
                if (reached) stack.push({start[i], child, reached});
            });
        }
    }

    void trace_singly(int g, Bits rays) {
        for_each_bit(rays, [&](int i) {
            const Ray ray = this->ray(g, i, infinity);
            if (!is_finite(ray.org) || !is_finite(ray.dir)) return;
            Query<false> query(scene_);
            query.trace(object_, ray, instance_);
            if (query.found()) best_.take(g * group_size + i, query.result());
        });
    }

    HWY_NOINLINE void test_block(std::uint32_t index, Bits groups) {
        groups = newcomers(index, groups);
        if (!groups) return;
        const Block& block = object_.blocks[index];
        Facets facets;
        Slopes slopes = shaft_.chunk();
        slopes.far = hn::MaxOfLanes(lanes_tag, load(far_));
        for (Bits may = may_hit<false>(block, shaft_, slopes, {}, facets); may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            const Bits open = groups_met(facets, lane) & groups;
            if (open) test(block, lane, facets, open);
        }
    }

    /// The groups of which not every ray passes outside one edge or has a closer hit.
    HWY_INLINE Bits groups_met(const Facets& f, int lane) const {
        const Passing p = passing(f, lane);
        const Mask ahead =
            hn::And(p.most >= splat(-f.edge_slack[lane]), splat(f.nearest[lane]) <= load(far_));
        return bits(hn::And(p.overlap, ahead));
    }

    HWY_INLINE void test(const Block& block, int lane, const Facets& f, Bits groups) {
        Float n[3][3], plane[3];
        for (int k = 0; k < 3; ++k) {
            for (int i = 0; i < 3; ++i) n[k][i] = splat(f.edges[k][i][lane]);
            plane[k] = splat(f.plane[k][lane]);
        }
        const Float slack = splat(-f.edge_slack[lane]), before = splat(f.before[lane]);
        const Float plane_slack = splat(f.plane_slack[lane]);
        for_each_bit(groups, [&](int g) HWY_ATTR {
            const GroupRays& rays = group_rays(g);
            bool closer = false;
            for (int k = 0; k < group_size; k += W) {
                const Float u = load(rays.u + k), v = load(rays.v + k);
                const auto along = [&](const Float* m) HWY_ATTR {
                    return hn::MulAdd(m[0], u, hn::MulAdd(m[1], v, m[2]));
                };
                const Mask inside = min3(along(n[0]), along(n[1]), along(n[2])) >= slack;
                // Its z is height / (n . (u, v, 1)).
                const Float farthest =
                    load(best_.t + g * group_size + k) * load(rays.z + k) * splat(1 + 0x1p-20f);
                const Mask behind = before > farthest * (along(plane) + plane_slack);
                if (hn::AllFalse(lanes_tag, hn::AndNot(behind, inside))) continue;
                closer |= decide(block, lane, g, k);
            }
            if (closer) far_[g] = reach(g);
        });
    }

    bool decide(const Block& block, int lane, int g, int k) {
        if (!(known_exact_ >> g & 1)) {
            known_exact_ |= Bits(1) << g;
            if (!exact_[g].set(shaft_, group_rays(g))) mixed_ |= Bits(1) << g;
        }
        if (!(mixed_ >> g & 1))
            return exact_[g].test(block, lane, instance_, best_, g * group_size, k);
        bool any = false;
        for_each_bit(alive_.rays[g] >> k & all_lanes, [&](int i) {
            TriangleHit hit;
            if (TriangleRay(ray(g, k + i, infinity)).hits(block.lane(lane), hit))
                any |= best_.take(g * group_size + k + i,
                                  {hit.t, hit.u, hit.v, instance_, block.ids[lane]});
        });
        return any;
    }

    /// Bounds the z of the closest hits of a group's rays.
    float reach(int g) {
        const GroupRays& rays = group_rays(g);
        return best_.reach(g, [&](int k) HWY_ATTR { return load(rays.z + k); });
    }

    const Alive& alive_;
    Closest& best_;
    alignas(64) float far_[W];
    Bits known_exact_ = 0, mixed_ = 0;
    ExactGroup exact_[W];
};

/// The same in all instances, each in its own space.
class InstanceClosest {
public:
    InstanceClosest(const Scene& scene, const vec3& origin, const PointRays& rays,
                    const Alive& alive, Closest& best)
        : scene_(scene), origin_(origin), rays_(rays), alive_(alive), best_(best) {}

    Bits open() const { return alive_.groups; }
    void visit(const WideInstance& instance, Bits groups) {
        ObjectClosest(scene_, scene_.object(instance.object), instance.id, instance.transform(),
                      origin_, rays_, alive_, best_)
            .run(groups);
    }
    void trace_singly(int g) {
        for_each_bit(alive_.rays[g], [&](int i) {
            const Ray ray{origin_, 0, rays_.direction(g, i, nullptr), infinity};
            best_.take(g * group_size + i, trace<false>(scene_, ray));
        });
    }
    /// Bounds the z of the closest hits of a group's rays.
    float reach(int g, const Shaft& shaft) const {
        return best_.reach(g, [&](int k) HWY_ATTR {
            Float d[3];
            rays_.directions(g, k, nullptr, d);
            return splat(shaft.sign()) * d[shaft.axis(2)];
        });
    }

private:
    const Scene& scene_;
    const vec3& origin_;
    const PointRays& rays_;
    const Alive& alive_;
    Closest& best_;
};

void closest_from(const Scene& scene, const vec3& origin, std::span<const vec3> dirs,
                  std::span<Hit> hits) {
    const vec3 zero(0);
    for (std::size_t start = 0; start < dirs.size(); start += chunk_size) {
        const std::size_t count = std::min<std::size_t>(chunk_size, dirs.size() - start);
        const Targets targets(dirs.subspan(start, count));
        const PointRays rays(zero, targets, 0);
        RayMask all;
        all.fill(all_rays);
        const Alive alive(all, targets, 0);
        Closest best(scene, alive);
        if (scene.single) {
            ObjectClosest(scene, scene.object(0), scene.single_id, nullptr, origin, rays, alive,
                          best)
                .run(alive.groups);
        } else {
            InstanceClosest query(scene, origin, rays, alive, best);
            trace_instances(scene, origin, rays, alive, query);
        }
        for (std::size_t i = 0; i < count; ++i) hits[start + i] = best.hit(int(i));
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
