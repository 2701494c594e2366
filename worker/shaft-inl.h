// Shafts: the frusta of hundreds of rays from one origin, a tile's, that step through the wide
// trees together.
//
// Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001)
// trace packets of rays in SIMD lanes; Reshetov, Soupikov and Hurley, "Multi-Level Ray Tracing
// Algorithm" (2005) decide a node for a whole frustum of rays by interval arithmetic. Here both
// meet: the rays are cut into groups of 16, each lane carries the frustum of one group, and one
// step decides a box for all of them. We differ in being exact: all tests of boxes and triangles
// are conservative in their rounding, and a ray whose hit the error bounds leave open is decided by
// the double test that decides for single rays (worker/triangle.h). So the answers are theirs, bit
// for bit.
//
// Coordinates here are relative to the rays' origin and permuted: z is an axis along which all of
// them advance, and a ray is u = (x / z), v = (y / z).
#if defined(TESSERA_SHAFT_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_SHAFT_INL_H
#undef TESSERA_SHAFT_INL_H
#else
#define TESSERA_SHAFT_INL_H
#endif

#include "worker/ray-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

constexpr int group_size = 16;
constexpr int chunk_size = W * group_size;  ///< a lane for each group
constexpr Bits all_rays = 0xffff;

/// Intervals of slopes and a reach: of one ray, a group or a chunk, in one lane or in all.
struct Slopes {
    Float u_lo, u_hi, v_lo, v_hi, far;
};

/// Boxes relative to the origin, in one lane or in all.
struct Boxes {
    Float lo[3], hi[3];
};

/// Whether a ray of the slopes may meet the box: the sides of the frustum against the corners of
/// the box that lie deepest inside.
HWY_INLINE Mask may_meet(const Boxes& box, const Slopes& s) {
    const Float z0 = hn::Max(box.lo[2], hn::Zero(lanes_tag)), z1 = box.hi[2];
    const auto beyond = [&](Float lo, Float slope) HWY_ATTR {
        return hn::Min(hn::NegMulAdd(slope, z0, lo), hn::NegMulAdd(slope, z1, lo));
    };
    const auto before = [&](Float hi, Float slope) HWY_ATTR {
        return hn::Max(hn::NegMulAdd(slope, z0, hi), hn::NegMulAdd(slope, z1, hi));
    };
    const Float above = hn::Max(beyond(box.lo[0], s.u_hi), beyond(box.lo[1], s.v_hi));
    const Float below = hn::Min(before(box.hi[0], s.u_lo), before(box.hi[1], s.v_lo));
    const Float zero = hn::Zero(lanes_tag);
    return hn::And(hn::And(above <= zero, below >= zero), hn::And(z0 <= z1, z0 <= s.far));
}

HWY_INLINE float least_of(Float x, Mask among) {
    return hn::GetLane(hn::MinOfLanes(lanes_tag, hn::IfThenElse(among, x, splat(infinity))));
}
HWY_INLINE float greatest_of(Float x, Mask among) {
    return hn::GetLane(hn::MaxOfLanes(lanes_tag, hn::IfThenElse(among, x, splat(-infinity))));
}

/// The frusta of up to W groups of rays and of all of them together.
class Shaft {
public:
    /// Takes of the `wanted` groups those whose rays all advance well along one axis, and returns
    /// them. `ends` bounds the directions of each group's rays, along the scene's axes and from the
    /// origin to where they end; `lanes(i, d)` sets `d` to those of ray i of every group
    /// and tells in which groups that ray counts; `reach`
    /// exceeds the distance along each axis of all geometry.
    template <class Lanes>
    Bits set(const vec3& org, Lanes&& lanes, Bits wanted, float reach);

    const vec3& origin() const { return org_; }
    int axis(int k) const { return axes_[k]; }
    float sign() const { return sign_; }
    float steepest() const { return steepest_; }
    float longest() const { return longest_; }
    float reach() const { return reach_; }
    float widening() const { return widening_; }
    float spread() const { return chunk_spread_; }

    Slopes chunk() const {
        return {splat(chunk_[0]), splat(chunk_[1]), splat(chunk_[2]), splat(chunk_[3]),
                splat(chunk_[4])};
    }
    Slopes groups() const {
        return {load(groups_[0]), load(groups_[1]), load(groups_[2]), load(groups_[3]),
                load(groups_[4])};
    }
    /// The groups' least and greatest slopes, u or v; and bounds of where their rays end.
    const float* slopes(int k, int hi) const { return groups_[2 * k + hi]; }
    const float* group_ends(int k, int hi) const { return group_ends_[k][hi]; }
    /// The z where the longest ray of a group ends.
    float far(int g) const { return groups_[4][g]; }
    /// How far the groups' rays stand apart at z = 1.
    Float spreads() const { return load(spread_); }

    /// Bounds of where all rays end.
    Boxes chunk_ends() const {
        return permuted([&](int k) { return splat(ends_lo_[k]); },
                        [&](int k) { return splat(ends_hi_[k]); });
    }

    /// The boxes of a node's children in the lanes, or of child `i` in all lanes.
    Boxes children(const Node& node) const {
        return permuted([&](int k) { return load(node.bounds[k][0]) - splat(org_[k]); },
                        [&](int k) { return load(node.bounds[k][1]) - splat(org_[k]); });
    }
    Boxes child(const Node& node, int i) const {
        return permuted([&](int k) { return splat(node.bounds[k][0][i] - org_[k]); },
                        [&](int k) { return splat(node.bounds[k][1][i] - org_[k]); });
    }

private:
    template <class Lo, class Hi>
    HWY_INLINE Boxes permuted(Lo&& lo, Hi&& hi) const {
        const int x = axes_[0], y = axes_[1], z = axes_[2];
        if (sign_ > 0) return {{lo(x), lo(y), lo(z)}, {hi(x), hi(y), hi(z)}};
        return {{lo(x), lo(y), hn::Neg(hi(z))}, {hi(x), hi(y), hn::Neg(lo(z))}};
    }
    Bits choose_axis(const Boxes& ends, Bits wanted);
    template <class Lanes>
    void bound_slopes(Lanes&& lanes, Bits carried);

    vec3 org_;
    int axes_[3];
    float sign_;      ///< of the directions along z
    float steepest_;  ///< bounds all |u|, |v|, and 1
    float widening_;  ///< what slopes are widened by against boxes
    float longest_;   ///< bounds the directions' coordinates
    float reach_;
    float ends_lo_[3], ends_hi_[3];  ///< bound them, by scene axis and relative to the origin
    float chunk_[5], chunk_spread_;
    alignas(64) float group_ends_[3][2][W];
    alignas(64) float groups_[5][W];
    alignas(64) float spread_[W];
};

/// Finds the bounds of all ends, and from them the axis along which they lie; returns the groups
/// whose rays advance well along it.
inline Bits Shaft::choose_axis(const Boxes& ends, Bits wanted) {
    const Mask among = mask_of(wanted);
    float farthest = 0;
    longest_ = 0;
    for (int k = 0; k < 3; ++k) {
        ends_lo_[k] = least_of(ends.lo[k], among);
        ends_hi_[k] = greatest_of(ends.hi[k], among);
        longest_ = std::max(longest_, std::max(-ends_lo_[k], ends_hi_[k]));
        const float sum = ends_lo_[k] + ends_hi_[k];
        if (k > 0 && !(std::abs(sum) > farthest)) continue;
        farthest = std::abs(sum);
        axes_[2] = k;
        sign_ = sum > 0 ? 1.0f : -1.0f;
    }
    axes_[0] = (axes_[2] + 1) % 3;
    axes_[1] = (axes_[2] + 2) % 3;
    const Boxes e = permuted([&](int k) { return ends.lo[k]; }, [&](int k) { return ends.hi[k]; });
    for (int k = 0; k < 3; ++k)
        store(e.lo[k], group_ends_[k][0]), store(e.hi[k], group_ends_[k][1]);
    const Float aside = hn::Max(hn::Max(hn::Abs(e.lo[0]), hn::Abs(e.hi[0])),
                                hn::Max(hn::Abs(e.lo[1]), hn::Abs(e.hi[1])));
    // What is not a number is not sound.
    const Mask sound = hn::And(e.lo[2] > hn::Max(splat(0x1p-3f) * aside, splat(0x1p-60f)),
                               hn::Max(aside, e.hi[2]) < splat(0x1p40f));
    return wanted & bits(sound);
}

template <class Lanes>
Bits Shaft::set(const vec3& org, Lanes&& lanes, Bits wanted, float reach) {
    if (!(reach < 0x1p40f)) return 0;
    org_ = org;
    reach_ = reach;

    Boxes ends;
    for (int k = 0; k < 3; ++k) ends.lo[k] = splat(infinity), ends.hi[k] = splat(-infinity);
    for (int i = 0; i < group_size; ++i) {
        Float d[3];
        const Mask counts = lanes(i, d);
        for (int k = 0; k < 3; ++k) {
            ends.lo[k] = hn::IfThenElse(counts, hn::Min(ends.lo[k], d[k]), ends.lo[k]);
            ends.hi[k] = hn::IfThenElse(counts, hn::Max(ends.hi[k], d[k]), ends.hi[k]);
        }
    }
    const Bits carried = choose_axis(ends, wanted);
    if (carried) bound_slopes(lanes, carried);
    return carried;
}

template <class Lanes>
void Shaft::bound_slopes(Lanes&& lanes, Bits carried) {
    Float u_lo = splat(infinity), u_hi = splat(-infinity), v_lo = u_lo, v_hi = u_hi;
    for (int i = 0; i < group_size; ++i) {
        Float d[3];
        const Mask counts = lanes(i, d);
        const Float inv = reciprocal(d[axes_[2]]) * splat(sign_);
        const Float u = d[axes_[0]] * inv, v = d[axes_[1]] * inv;
        u_lo = hn::IfThenElse(counts, hn::Min(u_lo, u), u_lo);
        u_hi = hn::IfThenElse(counts, hn::Max(u_hi, u), u_hi);
        v_lo = hn::IfThenElse(counts, hn::Min(v_lo, v), v_lo);
        v_hi = hn::IfThenElse(counts, hn::Max(v_hi, v), v_hi);
    }
    const Mask among = mask_of(carried);
    chunk_[0] = least_of(u_lo, among);
    chunk_[1] = greatest_of(u_hi, among);
    chunk_[2] = least_of(v_lo, among);
    chunk_[3] = greatest_of(v_hi, among);
    steepest_ = 1;
    for (int i = 0; i < 4; ++i) steepest_ = std::max(steepest_, std::abs(chunk_[i]));
    store(hn::Max(u_hi - u_lo, v_hi - v_lo), spread_);
    chunk_spread_ = std::max(chunk_[1] - chunk_[0], chunk_[3] - chunk_[2]);

    // A slope, a box relative to the origin and their product are each wrong by 2^-22 at most.
    widening_ = 0x1p-20f * steepest_;
    const Float margin = splat(widening_);
    store(u_lo - margin, groups_[0]);
    store(u_hi + margin, groups_[1]);
    store(v_lo - margin, groups_[2]);
    store(v_hi + margin, groups_[3]);
    store(load(group_ends_[2][1]) * splat(1 + 0x1p-20f), groups_[4]);
    for (const int i : {0, 2}) chunk_[i] -= widening_;
    for (const int i : {1, 3}) chunk_[i] += widening_;
    chunk_[4] = (sign_ > 0 ? ends_hi_[axes_[2]] : -ends_lo_[axes_[2]]) * (1 + 0x1p-20f);
}

/// Of a block's triangles, as the origin sees them: the planes through the origin and each edge,
/// whose normals point to where rays pass inside, and the triangles' own planes.
struct Facets {
    alignas(64) float edges[3][3][W];   ///< [edge][axis]
    alignas(64) float slopes[2][2][W];  ///< [u, v][lo, hi] of the corners
    alignas(64) float edge_slack[W];    ///< infinite where the origin lies in the plane
    alignas(64) float plane[3][W];      ///< the normal, away from the origin
    alignas(64) float before[W];  ///< with less than this a point surely lies on the origin's side
    // Of segments:
    alignas(64) float beyond[W];  ///< with more than this surely on the other
    // Of rays that do not end:
    alignas(64) float plane_slack[W];  ///< how wrong n . (u, v, 1) may be
    alignas(64) float nearest[W];      ///< no hit has a lesser z
};

/// The lanes whose triangles a ray of `s` that ends in `ends` may hit: those that no side of the
/// frustum keeps out, that do not have all of it on one side, and none of whose edges has. Fills
/// `facets` for them. Without `segments` the rays do not end.
template <bool segments>
HWY_INLINE Bits may_hit(const Block& block, const Shaft& shaft, const Slopes& s, const Boxes& ends,
                        Facets& facets) {
    Float p[3][3];  // [axis][corner]
    for (int axis = 0; axis < 3; ++axis) {
        const Float org = splat(shaft.origin()[shaft.axis(axis)]);
        for (int k = 0; k < 3; ++k) p[axis][k] = load(block.corners[k][shaft.axis(axis)]) - org;
    }
    if (shaft.sign() < 0)
        for (Float& z : p[2]) z = hn::Neg(z);

    // How far inside the frustum's four sides, its origin and its far end the corners lie.
    const auto deepest = [&](const Float* x, Float slope) HWY_ATTR {
        return max3(hn::NegMulAdd(slope, p[2][0], x[0]), hn::NegMulAdd(slope, p[2][1], x[1]),
                    hn::NegMulAdd(slope, p[2][2], x[2]));
    };
    const auto shallowest = [&](const Float* x, Float slope) HWY_ATTR {
        return min3(hn::NegMulAdd(slope, p[2][0], x[0]), hn::NegMulAdd(slope, p[2][1], x[1]),
                    hn::NegMulAdd(slope, p[2][2], x[2]));
    };
    const Float slack = splat(0x1p-21f * shaft.steepest() * shaft.reach());
    const Float inside = hn::Min(deepest(p[0], s.u_lo), deepest(p[1], s.v_lo));
    const Float outside = hn::Max(shallowest(p[0], s.u_hi), shallowest(p[1], s.v_hi));
    const Float front = max3(p[2][0], p[2][1], p[2][2]);
    const Float back = min3(p[2][0], p[2][1], p[2][2]);
    const Bits met = bits(
        hn::And(hn::Min(inside, front) >= hn::Neg(slack), hn::Max(outside, back - s.far) <= slack));
    if (!met) return 0;

    // The plane's normal, and the distances of the origin and of the ends from the plane. Ends and
    // origin lie close to surfaces, so all is measured from a corner, where errors are small.
    Float e[3], f[3], n[3], extent = hn::Zero(lanes_tag);
    for (int k = 0; k < 3; ++k) {
        e[k] = p[k][1] - p[k][0];
        f[k] = p[k][2] - p[k][1];
        extent = max3(extent, hn::Abs(e[k]), hn::Abs(f[k]));
    }
    Float origin = hn::Zero(lanes_tag), nearest = origin, farthest = origin;
    Float error = origin, ends_error = origin, normal_size = origin;
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const Float product = e[j] * f[i];
        n[k] = hn::MulSub(e[i], f[j], product);
        const Float n_size = hn::Abs(product) + hn::Abs(n[k]);
        normal_size = normal_size + n_size;
        error = hn::MulAdd(n_size, hn::Abs(p[k][0]), error);
        origin = hn::NegMulAdd(n[k], p[k][0], origin);
        if (!segments) continue;
        const Float lo = ends.lo[k] - p[k][0], hi = ends.hi[k] - p[k][0];
        nearest = nearest + hn::Min(n[k] * lo, n[k] * hi);
        farthest = farthest + hn::Max(n[k] * lo, n[k] * hi);
        ends_error = hn::MulAdd(n_size, hn::Max(hn::Abs(lo), hn::Abs(hi)), ends_error);
    }
    // What the double test may be wrong by is far less, whatever the triangle's shape.
    const Float least = splat(0x1p-40f * shaft.reach()) * extent * extent;
    error = hn::MulAdd(splat(0x1p-20f), error, least);
    ends_error = hn::MulAdd(splat(0x1p-20f), ends_error, error);
    Bits cross_plane = met;
    if (segments) {
        const Mask above = hn::And(origin > error, nearest > ends_error);
        const Mask below = hn::And(origin < hn::Neg(error), farthest < hn::Neg(ends_error));
        cross_plane &= ~bits(hn::Or(above, below));
        if (!cross_plane) return 0;
    }

    // Bounds of the slopes, where all corners lie ahead.
    const Mask ahead = back > hn::Zero(lanes_tag);
    Float inv[3];
    for (int k = 0; k < 3; ++k) inv[k] = splat(1) / p[2][k];
    for (int k = 0; k < 2; ++k) {
        const Float a = p[k][0] * inv[0], b = p[k][1] * inv[1], c = p[k][2] * inv[2];
        store(hn::IfThenElse(ahead, min3(a, b, c), splat(-infinity)), facets.slopes[k][0]);
        store(hn::IfThenElse(ahead, max3(a, b, c), splat(infinity)), facets.slopes[k][1]);
    }

    // Normals that point inwards, as far as the origin's side of the plane is known.
    const Mask known = hn::Abs(origin) > error;
    const float reach = shaft.reach();
    const Float slack_of_edges =
        splat(0x1p-18f * shaft.steepest() * reach) * (splat(0x1p-20f * reach) + extent);
    const Float edge_slack = hn::IfThenElse(known, slack_of_edges, splat(infinity));
    store(edge_slack, facets.edge_slack);
    const Float height = hn::Abs(origin);
    const Float plane_slack = hn::IfThenElse(known, segments ? ends_error : error, splat(infinity));
    store(height - plane_slack, facets.before);
    if (segments) {
        // A hit needs t < 1 after rounding.
        store(height + hn::Max(splat(0x1p-20f) * height, plane_slack), facets.beyond);
    } else {
        store(splat(0x1p-20f * shaft.steepest()) * normal_size, facets.plane_slack);
        store(back - slack, facets.nearest);
    }
    const Float towards = hn::CopySign(splat(1), hn::Neg(origin));
    for (int k = 0; k < 3; ++k) store(towards * n[k], facets.plane[k]);
    Float most = splat(infinity);
    for (int k = 0; k < 3; ++k) {
        Float d[3], m[3];
        for (int i = 0; i < 3; ++i)
            d[i] = towards * (k == 0 ? e[i] : k == 1 ? f[i] : p[i][0] - p[i][2]);
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, l = (i + 2) % 3;
            m[i] = hn::MulSub(p[j][k], d[l], p[l][k] * d[j]);
            store(m[i], facets.edges[k][i]);
        }
        most = hn::Min(most, hn::Max(m[0] * s.u_lo, m[0] * s.u_hi) +
                                 hn::Max(m[1] * s.v_lo, m[1] * s.v_hi) + m[2]);
    }
    return cross_plane & ~bits(most < hn::Neg(edge_slack));
}

/// A triangle as the origin sees it: the planes through the origin and its edges, and its own
/// plane. Set up in double, so that the only errors to speak of are those of the rays' slopes in
/// float.
class Facet {
public:
    Facet(const Triangle& triangle, const Shaft& shaft) {
        using glm::dvec3;
        const auto relative = [&](const vec3& p) {
            dvec3 out;
            for (int k = 0; k < 3; ++k) {
                const int axis = shaft.axis(k);
                out[k] = double(p[axis]) - double(shaft.origin()[axis]);
            }
            out.z *= double(shaft.sign());
            return out;
        };
        const dvec3 a = relative(triangle.a), b = relative(triangle.b), c = relative(triangle.c);
        const dvec3 ab = b - a, bc = c - b, ca = a - c;
        dvec3 edges[3] = {cross(a, ab), cross(b, bc), cross(c, ca)};
        plane_ = cross(ab, bc);
        height_ = dot(plane_, a);
        if (height_ < 0) {
            for (dvec3& e : edges) e = -e;
            plane_ = -plane_;
            height_ = -height_;
        }
        const auto largest = [](const dvec3& p) {
            return std::max(std::abs(p.x), std::max(std::abs(p.y), std::abs(p.z)));
        };
        const double extent = std::max(largest(ab), largest(bc));
        const double reach =
            std::max(std::max(largest(a), largest(b)), double(shaft.longest())) + extent;
        plane_slack_ = 0x1p-44 * extent * extent * reach;
        double edge_size = 0;
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k) edges_[i][k] = float(edges[i][k]);
            edge_size = std::max(
                edge_size, std::abs(edges[i].x) + std::abs(edges[i].y) + std::abs(edges[i].z));
        }
        // Six roundings of 2^-24, and those of the double test.
        slack_ = float(0x1p-21 * edge_size * double(shaft.steepest()) + 0x1p-44 * extent * reach);
        // An origin in the plane tells nothing, nor do numbers so small that they vanish.
        if (!(height_ > plane_slack_ && edge_size > 0x1p-80)) {
            slack_ = infinity;
            plane_slack_ = double(infinity);
        }
    }

    /// Of W rays: those that surely pass inside the edges, and those that may.
    HWY_INLINE void inside(Float u, Float v, Bits& surely, Bits& maybe) const {
        Float least = splat(infinity);
        for (const auto& e : edges_)
            least =
                hn::Min(least, hn::MulAdd(splat(e[0]), u, hn::MulAdd(splat(e[1]), v, splat(e[2]))));
        surely = bits(least > splat(slack_));
        maybe = bits(hn::Not(least < splat(-slack_)));
    }

    /// Of the rays: those that end surely beyond the plane, and those that may.
    HWY_INLINE void crossed(const float* x, const float* y, const float* z, Bits& surely,
                            Bits& maybe) const {
        constexpr hn::ScalableTag<double> tag;
        constexpr hn::Rebind<float, decltype(tag)> half;
        const auto sure_bound = hn::Set(tag, -std::max(0x1p-22 * height_, plane_slack_));
        const auto maybe_bound = hn::Set(tag, plane_slack_);
        surely = maybe = 0;
        for (int i = 0; i < W; i += W / 2) {
            auto left = hn::Set(tag, height_);
            const auto d = [&](const float* p)
                               HWY_ATTR { return hn::PromoteTo(tag, hn::Load(half, p + i)); };
            left = hn::NegMulAdd(hn::Set(tag, plane_.x), d(x), left);
            left = hn::NegMulAdd(hn::Set(tag, plane_.y), d(y), left);
            left = hn::NegMulAdd(hn::Set(tag, plane_.z), d(z), left);
            surely |= half_bits(tag, left < sure_bound) << i;
            maybe |= half_bits(tag, hn::Not(left > maybe_bound)) << i;
        }
    }

private:
    template <class Tag, class M>
    static HWY_INLINE Bits half_bits(Tag tag, M mask) {
        std::uint8_t bytes[8] = {};
        hn::StoreMaskBits(tag, mask, bytes);
        return bytes[0];
    }

    float edges_[3][3];
    float slack_;
    glm::dvec3 plane_;
    double height_, plane_slack_;
};

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

/// One group of a shaft, ray by ray: made when the shaft must look at single rays.
struct GroupRays {
    alignas(64) float d[3][group_size];  ///< by scene axis, to where the rays end
    alignas(64) float u[group_size], v[group_size], z[group_size];
};

/// The rays of a chunk against one object, in the object's space.
class ObjectRays {
protected:
    ObjectRays(const SceneObject& object, std::uint32_t instance, const Affine* object_from_world,
               const vec3& origin, const PointRays& rays)
        : object_(object),
          instance_(instance),
          from_world_(object_from_world ? &object_from_world->linear : nullptr),
          org_(object_from_world ? object_from_world->point(origin) : origin),
          rays_(rays) {
        const Box& b = object.tree.bounds;
        reach_ = std::max(max_component(abs(b.lo - org_)), max_component(abs(b.hi - org_)));
    }

    /// A group is wide where its rays are this share of a box's extent apart.
    static constexpr float wide = 1.0f / 8;
    /// So narrow a shaft meets a box with all its groups or hardly at all.
    static constexpr float narrow = 1.0f / 4;

    HWY_INLINE void lanes(int i, Float (&d)[3]) const { rays_.lanes(i, from_world_, d); }
    Ray ray(int g, int i, float tmax) const {
        return {org_, 0, rays_.direction(g, i, from_world_), tmax};
    }

    const GroupRays& group_rays(int g) {
        GroupRays& out = group_rays_[g];
        if (known_rays_ >> g & 1) return out;
        known_rays_ |= Bits(1) << g;
        for (int k = 0; k < group_size; k += W) {
            Float d[3];
            rays_.directions(g, k, from_world_, d);
            for (int i = 0; i < 3; ++i) store(d[i], out.d[i] + k);
            const Float z = splat(shaft_.sign()) * d[shaft_.axis(2)];
            const Float inv = splat(1) / z;
            store(d[shaft_.axis(0)] * inv, out.u + k);
            store(d[shaft_.axis(1)] * inv, out.v + k);
            store(z, out.z + k);
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
        const float* const x = rays.d[shaft_.axis(0)];
        const float* const y = rays.d[shaft_.axis(1)];
        return {{splat(lo(rays.u) - margin), splat(hi(rays.u) + margin), splat(lo(rays.v) - margin),
                 splat(hi(rays.v) + margin), splat(far * (1 + 0x1p-20f))},
                {{splat(lo(x)), splat(lo(y)), splat(lo(rays.z))},
                 {splat(hi(x)), splat(hi(y)), splat(far)}}};
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

    const SceneObject& object_;
    std::uint32_t instance_;
    const mat3* from_world_;
    vec3 org_;
    float reach_;
    const PointRays& rays_;
    Shaft shaft_;

private:
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
/// instance; trace_singly(group) traces its rays, which no shaft can hold, in the whole scene; and
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
        const Box& b = scene_.top.bounds;
        const float reach =
            std::max(max_component(abs(b.lo - origin_)), max_component(abs(b.hi - origin_)));
        for (Bits left = query_.open(); left; left &= query_.open()) {
            const Bits lowest = left & (~left + 1);
            Bits carried = shaft_.set(origin_, living, left, reach);
            if (!carried) carried = shaft_.set(origin_, living, lowest, reach);
            if (carried) {
                walk(carried);
            } else {
                carried = lowest;
                query_.trace_singly(std::countr_zero(left));
            }
            left &= ~carried;
        }
    }

private:
    void walk(Bits carried) {
        for (int g = 0; g < W; ++g) far_[g] = carried >> g & 1 ? query_.reach(g, shaft_) : 0;
        NearestFirst stack;
        stack.push({0, WideLink::node(0), carried});
        for (NearestFirst::Entry entry; stack.pop(entry);) {
            const Bits groups = entry.reached & query_.open() & bits(splat(entry.z) <= load(far_));
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
                const Bits reached = groups & bits(may_meet(shaft_.child(node, i), of_groups));
                if (reached) stack.push({start[i], node.children[i], reached});
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
