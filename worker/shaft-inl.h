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

/// Numbers that are at most `half` from `middle`, but for rounding.
struct Interval {
    Float middle, half;
};

/// Boxes relative to the origin, in one lane or in all.
struct Boxes {
    Float lo[3], hi[3];
};

HWY_INLINE Float extent_of(const Boxes& box) {
    return max3(box.hi[0] - box.lo[0], box.hi[1] - box.lo[1], box.hi[2] - box.lo[2]);
}

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
    /// them. `lanes(i, d)` sets `d` to the directions of ray `i` of every group, from the origin to
    /// where it ends and along the scene's axes, and returns the groups in which that ray counts;
    /// no geometry is farther than `reach` from the origin along any axis.
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
    /// The groups' least and greatest slopes, u or v.
    Float slopes(int k, int hi) const { return load(groups_[2 * k + hi]); }
    /// The same as intervals, and those along each axis in which the groups' rays end.
    Interval slopes(int k) const { return slope_intervals_[k].get(); }
    Interval ends(int k) const { return end_intervals_[k].get(); }
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
    struct StoredInterval {
        alignas(64) float middle[W], half[W];

        void set(Float lo, Float hi) {
            store(splat(0.5f) * (lo + hi), middle);
            store(splat(0.5f) * (hi - lo), half);
        }
        Interval get() const { return {load(middle), load(half)}; }
    };

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
    float ends_lo_[3], ends_hi_[3];    ///< bound the directions, by scene axis
    float chunk_[5], chunk_spread_;    ///< Slopes of all rays; how far they stand apart
    StoredInterval end_intervals_[3];  ///< by axis, permuted
    StoredInterval slope_intervals_[2];
    alignas(64) float groups_[5][W];  ///< Slopes
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
    for (int k = 0; k < 3; ++k) end_intervals_[k].set(e.lo[k], e.hi[k]);
    store(e.hi[2] * splat(1 + 0x1p-20f), groups_[4]);
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
    slope_intervals_[0].set(u_lo - margin, u_hi + margin);
    slope_intervals_[1].set(v_lo - margin, v_hi + margin);
    for (const int i : {0, 2}) chunk_[i] -= widening_;
    for (const int i : {1, 3}) chunk_[i] += widening_;
    chunk_[4] = (sign_ > 0 ? ends_hi_[axes_[2]] : -ends_lo_[axes_[2]]) * (1 + 0x1p-20f);
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
