// Hundreds of shadow rays from one point at once: a light's view of a tile.
//
// Wald, Slusallek, Benthin and Wagner, "Interactive Rendering with Coherent Ray Tracing" (2001)
// trace packets of rays in SIMD lanes; Reshetov, Soupikov and Hurley, "Multi-Level Ray Tracing
// Algorithm" (2005) decide a node for a whole frustum of rays by interval arithmetic. Here both
// meet: a chunk of rays is cut into groups of 16, each lane carries the interval of slopes of one
// group, and one step decides a box for all of them. Where the groups are wide against the boxes
// they go on alone, ray by ray in the lanes; where few rays of a group are left those go on as
// single rays (worker/ray-inl.h). We differ in being exact: all tests of boxes and triangles are
// conservative in their rounding, and a ray whose hit the error bounds leave open is decided by the
// double test that decides for single rays (worker/triangle.h). So the answers are theirs, bit for
// bit.
//
// Coordinates here are relative to the rays' origin and permuted: z is an axis along which all of
// them advance, and a ray is u = (x / z), v = (y / z).
#if defined(TESSERA_SHAFT_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_SHAFT_INL_H
#undef TESSERA_SHAFT_INL_H
#else
#define TESSERA_SHAFT_INL_H
#endif

#include <algorithm>
#include <numeric>
#include <optional>

#include "worker/ray-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

constexpr int group_size = 16;
constexpr int chunk_size = W * group_size;  ///< a lane for each group
constexpr Bits all_rays = 0xffff;

/// Directions from one origin, in structure-of-arrays order.
struct Directions {
    alignas(64) float d[3][chunk_size];
    int count = 0;

    vec3 at(int i) const { return {d[0][i], d[1][i], d[2][i]}; }
    void add(const vec3& dir) {
        for (int k = 0; k < 3; ++k) d[k][count] = dir[k];
        ++count;
    }
    /// From the points, seen from `from`.
    void set(std::span<const vec3> points, const vec3& from) {
        count = 0;
        const Float org[3] = {splat(from.x), splat(from.y), splat(from.z)};
        for (; count + W <= int(points.size()); count += W) {
            Float p[3];
            hn::LoadInterleaved3(lanes_tag, &points[std::size_t(count)].x, p[0], p[1], p[2]);
            for (int k = 0; k < 3; ++k) store(p[k] - org[k], d[k] + count);
        }
        for (const vec3& point : points.subspan(std::size_t(count))) add(point - from);
        pad();
    }

    /// The last one again up to the end of its group.
    void pad() {
        for (int i = count; i % group_size != 0; ++i)
            for (int k = 0; k < 3; ++k) d[k][i] = d[k][count - 1];
    }
};

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

/// Of a block's triangles: the normals of the planes through the origin and each edge, which point
/// to where rays pass inside, and by how much a ray's distance from them may be wrong.
struct Edges {
    alignas(64) float normals[3][3][W];  ///< [edge][axis]
    alignas(64) float slack[W];
};

/// A chunk of rays as frusta.
class Shaft {
public:
    /// False when the rays have no axis in common along which they all advance well.
    bool set(const vec3& org, const Directions& rays, int first, int count);

    Slopes chunk() const { return splat_slopes(chunk_); }
    Slopes groups() const {
        return {load(groups_[0]), load(groups_[1]), load(groups_[2]), load(groups_[3]),
                load(groups_[4])};
    }
    Slopes group(int g) const {
        return {splat(groups_[0][g]), splat(groups_[1][g]), splat(groups_[2][g]),
                splat(groups_[3][g]), splat(groups_[4][g])};
    }
    /// Of W rays of group g, from ray `k`.
    Slopes rays(int g, int k) const {
        const Float u = load(u_ + g * group_size + k), v = load(v_ + g * group_size + k);
        const Float margin = splat(widening_);
        return {u - margin, u + margin, v - margin, v + margin, load(far_ + g * group_size + k)};
    }
    /// Bounds of where the rays end.
    Boxes chunk_ends() const {
        Boxes out;
        for (int k = 0; k < 3; ++k) {
            const bool flip = k == 2 && sign_ < 0;
            const float lo = ends_lo_[axes_[k]], hi = ends_hi_[axes_[k]];
            out.lo[k] = splat(flip ? -hi : lo);
            out.hi[k] = splat(flip ? -lo : hi);
        }
        return out;
    }
    Boxes group_ends(int g) const {
        Boxes out;
        for (int k = 0; k < 3; ++k) {
            Float lo = splat(infinity), hi = splat(-infinity);
            for (int i = 0; i < group_size; i += W) {
                const Float d = load(d_[k] + g * group_size + i);
                lo = hn::Min(lo, d), hi = hn::Max(hi, d);
            }
            out.lo[k] = hn::MinOfLanes(lanes_tag, lo);
            out.hi[k] = hn::MaxOfLanes(lanes_tag, hi);
        }
        return out;
    }
    /// How far the groups' rays stand apart at z = 1.
    Float spread() const { return load(spread_); }

    Boxes children(const Node& node) const {
        Boxes out;
        for (int k = 0; k < 3; ++k) {
            const Float org = splat(org_[axes_[k]]);
            const Float lo = load(node.bounds[axes_[k]][0]) - org;
            const Float hi = load(node.bounds[axes_[k]][1]) - org;
            const bool flip = k == 2 && sign_ < 0;
            out.lo[k] = flip ? hn::Neg(hi) : lo;
            out.hi[k] = flip ? hn::Neg(lo) : hi;
        }
        return out;
    }

private:
    friend class Facet;
    friend Bits may_hit(const Block&, const Shaft&, const Slopes&, const Boxes&, Edges&);
    friend class ShaftOcclusion;
    friend class GroupClosest;

    static Slopes splat_slopes(const float* s) {
        return {splat(s[0]), splat(s[1]), splat(s[2]), splat(s[3]), splat(s[4])};
    }
    bool choose_axis(const Directions& rays, int first, int end);
    void bound_groups(int groups);

    vec3 org_;
    int axes_[3];
    float sign_;                     ///< of the directions along z
    float steepest_;                 ///< bounds all |u|, |v|, and 1
    float widening_;                 ///< what slopes are widened by against boxes
    float longest_;                  ///< bounds the directions' coordinates
    float ends_lo_[3], ends_hi_[3];  ///< bound them, by scene axis and relative to the origin
    float chunk_[5];
    alignas(64) float groups_[5][W];
    alignas(64) float spread_[W];
    // Of the rays: slopes, z where they end, directions.
    alignas(64) float u_[chunk_size], v_[chunk_size], far_[chunk_size];
    alignas(64) float d_[3][chunk_size];
};

inline bool Shaft::choose_axis(const Directions& rays, int first, int end) {
    Float lo[3], hi[3];
    for (int k = 0; k < 3; ++k) lo[k] = splat(infinity), hi[k] = splat(-infinity);
    Mask sound = hn::FirstN(lanes_tag, W);
    for (int k = 0; k < 3; ++k)
        for (int i = first; i < end; i += W) {
            const Float d = load(rays.d[k] + i);
            lo[k] = hn::Min(lo[k], d);
            hi[k] = hn::Max(hi[k], d);
            sound = hn::And(sound, hn::Abs(d) < splat(0x1p60f));  // NaN is not
        }
    if (bits(sound) != all_lanes) return false;
    float nearest[3],
        size[3];  // of the directions: least advance along the axis, largest coordinate
    longest_ = 0;
    for (int k = 0; k < 3; ++k) {
        const float least = hn::GetLane(hn::MinOfLanes(lanes_tag, lo[k]));
        const float most = hn::GetLane(hn::MaxOfLanes(lanes_tag, hi[k]));
        nearest[k] = least > 0 ? least : -most;
        size[k] = std::max(std::abs(least), std::abs(most));
        ends_lo_[k] = least, ends_hi_[k] = most;
        longest_ = std::max(longest_, size[k]);
        if (k == 0 || nearest[k] > nearest[axes_[2]]) {
            axes_[2] = k;
            sign_ = least > 0 ? 1.0f : -1.0f;
        }
    }
    axes_[0] = (axes_[2] + 1) % 3;
    axes_[1] = (axes_[2] + 2) % 3;
    return nearest[axes_[2]] > 0x1p-3f * std::max(size[axes_[0]], size[axes_[1]]) &&
           nearest[axes_[2]] > 0x1p-60f;
}

inline bool Shaft::set(const vec3& org, const Directions& rays, int first, int count) {
    const int end = first + (count + group_size - 1) / group_size * group_size;
    if (!choose_axis(rays, first, end)) return false;
    org_ = org;
    for (int i = first; i < end; i += W) {
        const Float x = load(rays.d[axes_[0]] + i), y = load(rays.d[axes_[1]] + i);
        const Float z = splat(sign_) * load(rays.d[axes_[2]] + i);
        const Float inv = splat(1) / z;
        const int to = i - first;
        store(x * inv, u_ + to);
        store(y * inv, v_ + to);
        store(z, far_ + to);
        store(x, d_[0] + to);
        store(y, d_[1] + to);
        store(z, d_[2] + to);
    }
    bound_groups((end - first) / group_size);
    return true;
}

inline void Shaft::bound_groups(int groups) {
    for (int g = 0; g < groups; ++g) {
        Float lo_u = splat(infinity), lo_v = lo_u, hi_u = splat(-infinity), hi_v = hi_u, far = hi_u;
        for (int k = 0; k < group_size; k += W) {
            const Float u = load(u_ + g * group_size + k), v = load(v_ + g * group_size + k);
            lo_u = hn::Min(lo_u, u), hi_u = hn::Max(hi_u, u);
            lo_v = hn::Min(lo_v, v), hi_v = hn::Max(hi_v, v);
            far = hn::Max(far, load(far_ + g * group_size + k));
        }
        groups_[0][g] = hn::GetLane(hn::MinOfLanes(lanes_tag, lo_u));
        groups_[1][g] = hn::GetLane(hn::MaxOfLanes(lanes_tag, hi_u));
        groups_[2][g] = hn::GetLane(hn::MinOfLanes(lanes_tag, lo_v));
        groups_[3][g] = hn::GetLane(hn::MaxOfLanes(lanes_tag, hi_v));
        groups_[4][g] = hn::GetLane(hn::MaxOfLanes(lanes_tag, far));
    }
    // Free lanes repeat the first group, lest they widen the chunk.
    for (int g = groups; g < W; ++g)
        for (auto& of_groups : groups_) of_groups[g] = of_groups[0];
    const Slopes s = this->groups();
    chunk_[0] = hn::GetLane(hn::MinOfLanes(lanes_tag, s.u_lo));
    chunk_[1] = hn::GetLane(hn::MaxOfLanes(lanes_tag, s.u_hi));
    chunk_[2] = hn::GetLane(hn::MinOfLanes(lanes_tag, s.v_lo));
    chunk_[3] = hn::GetLane(hn::MaxOfLanes(lanes_tag, s.v_hi));
    chunk_[4] = hn::GetLane(hn::MaxOfLanes(lanes_tag, s.far));
    steepest_ = 1;
    for (int i = 0; i < 4; ++i) steepest_ = std::max(steepest_, std::abs(chunk_[i]));
    store(hn::Max(s.u_hi - s.u_lo, s.v_hi - s.v_lo), spread_);

    // A slope, a box relative to the origin and their product are each wrong by 2^-23 at most.
    widening_ = 0x1p-20f * steepest_;
    const Float margin = splat(widening_), longer = splat(1 + 0x1p-20f);
    store(s.u_lo - margin, groups_[0]);
    store(s.u_hi + margin, groups_[1]);
    store(s.v_lo - margin, groups_[2]);
    store(s.v_hi + margin, groups_[3]);
    store(s.far * longer, groups_[4]);
    for (const int i : {0, 2}) chunk_[i] -= widening_;
    for (const int i : {1, 3}) chunk_[i] += widening_;
    chunk_[4] *= 1 + 0x1p-20f;
}

/// The lanes whose triangles a ray of `s` that ends in `ends` may hit: those that no side of the
/// frustum keeps out, that do not have all of it on one side, and none of whose edges has. Fills
/// `edges` for them.
HWY_INLINE Bits may_hit(const Block& block, const Shaft& shaft, const Slopes& s, const Boxes& ends,
                        Edges& edges) {
    Float p[3][3];  // [axis][corner]
    for (int axis = 0; axis < 3; ++axis) {
        const Float org = splat(shaft.org_[shaft.axes_[axis]]);
        for (int k = 0; k < 3; ++k) {
            p[axis][k] = load(block.corners[k][shaft.axes_[axis]]) - org;
            if (axis == 2) p[axis][k] = splat(shaft.sign_) * p[axis][k];
        }
    }
    Float size = hn::Zero(lanes_tag);
    Float left = splat(-infinity), low = left, deep = left;
    Float right = splat(infinity), high = right, shallow = right;
    for (int k = 0; k < 3; ++k) {
        const Float x = p[0][k], y = p[1][k], z = p[2][k];
        size = hn::Max(size, max3(hn::Abs(x), hn::Abs(y), hn::Abs(z)));
        // How far inside the four sides the corner lies.
        left = hn::Max(left, hn::NegMulAdd(s.u_lo, z, x));
        right = hn::Min(right, hn::NegMulAdd(s.u_hi, z, x));
        low = hn::Max(low, hn::NegMulAdd(s.v_lo, z, y));
        high = hn::Min(high, hn::NegMulAdd(s.v_hi, z, y));
        deep = hn::Max(deep, z);
        shallow = hn::Min(shallow, z);
    }
    const Float slack = splat(0x1p-21f * shaft.steepest_) * size;
    const Mask inside = hn::And(hn::And(left >= hn::Neg(slack), right <= slack),
                                hn::And(low >= hn::Neg(slack), high <= slack));
    const Mask within = hn::And(deep >= hn::Neg(slack), shallow <= s.far + slack);
    const Bits met = bits(hn::And(inside, within));
    if (!met) return 0;

    // The plane's normal, and the distances of the origin and of the ends from the plane. Ends and
    // origin lie close to surfaces, so all is measured from a corner, where errors are small.
    Float e[3], f[3], extent = hn::Zero(lanes_tag);
    for (int k = 0; k < 3; ++k) {
        e[k] = p[k][1] - p[k][0];
        f[k] = p[k][2] - p[k][1];
        extent = hn::Max(extent, hn::Max(hn::Abs(e[k]), hn::Abs(f[k])));
    }
    Float origin = hn::Zero(lanes_tag), nearest = origin, farthest = origin;
    Float error = origin, ends_error = origin;
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        const Float back = e[j] * f[i];
        const Float n = hn::MulSub(e[i], f[j], back);
        const Float n_size = hn::Abs(back) + hn::Abs(n);
        const Float lo = ends.lo[k] - p[k][0], hi = ends.hi[k] - p[k][0];
        origin = hn::NegMulAdd(n, p[k][0], origin);
        nearest = nearest + hn::Min(n * lo, n * hi);
        farthest = farthest + hn::Max(n * lo, n * hi);
        error = hn::MulAdd(n_size, hn::Abs(p[k][0]), error);
        ends_error = hn::MulAdd(n_size, hn::Max(hn::Abs(lo), hn::Abs(hi)), ends_error);
    }
    // What the double test may be wrong by is far less, whatever the triangle's shape.
    const Float least = splat(0x1p-40f) * extent * extent * size;
    error = hn::MulAdd(splat(0x1p-20f), error, least);
    ends_error = hn::MulAdd(splat(0x1p-20f), ends_error, error);
    const Mask above = hn::And(origin > error, nearest > ends_error);
    const Mask below = hn::And(origin < hn::Neg(error), farthest < hn::Neg(ends_error));
    const Bits cross_plane = met & ~bits(hn::Or(above, below));
    if (!cross_plane) return 0;

    // Normals that point inwards, as far as the origin's side of the plane is known.
    const Mask known = hn::Abs(origin) > error;
    const Float slack_of_edges =
        splat(0x1p-18f * shaft.steepest_) * size * hn::MulAdd(splat(0x1p-20f), size, extent);
    const Float edge_slack = hn::IfThenElse(known, slack_of_edges, splat(infinity));
    store(edge_slack, edges.slack);
    const Float towards = hn::CopySign(splat(1), hn::Neg(origin));
    Float most = splat(infinity);
    for (int k = 0; k < 3; ++k) {
        Float d[3], n[3];
        for (int i = 0; i < 3; ++i)
            d[i] = towards * (k == 0 ? e[i] : k == 1 ? f[i] : p[i][0] - p[i][2]);
        for (int i = 0; i < 3; ++i) {
            const int j = (i + 1) % 3, l = (i + 2) % 3;
            n[i] = hn::MulSub(p[j][k], d[l], p[l][k] * d[j]);
            store(n[i], edges.normals[k][i]);
        }
        most = hn::Min(most, hn::Max(n[0] * s.u_lo, n[0] * s.u_hi) +
                                 hn::Max(n[1] * s.v_lo, n[1] * s.v_hi) + n[2]);
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
                const int axis = shaft.axes_[k];
                out[k] = double(p[axis]) - double(shaft.org_[axis]);
            }
            out.z *= double(shaft.sign_);
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
            std::max(std::max(largest(a), largest(b)), double(shaft.longest_)) + extent;
        plane_slack_ = 0x1p-44 * extent * extent * reach;
        double edge_size = 0;
        for (int i = 0; i < 3; ++i) {
            for (int k = 0; k < 3; ++k) edges_[i][k] = float(edges[i][k]);
            edge_size = std::max(
                edge_size, std::abs(edges[i].x) + std::abs(edges[i].y) + std::abs(edges[i].z));
        }
        // Six roundings of 2^-24, and those of the double test.
        slack_ = float(0x1p-21 * edge_size * double(shaft.steepest_) + 0x1p-44 * extent * reach);
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

/// The rays of a chunk against one object, in the object's space.
class ShaftOcclusion {
public:
    ShaftOcclusion(const SceneObject& object, std::uint32_t instance, const Shaft& shaft, int count,
                   OccluderCache* cache)
        : object_(object), instance_(instance), shaft_(shaft), count_(count), cache_(cache) {
        for (int g = 0; g < W; ++g) {
            const int left = std::clamp(count - g * group_size, 0, group_size);
            alive_[g] = (Bits(1) << left) - 1;
            if (left > 0) live_ |= Bits(1) << g;
        }
    }

    void run() {
        ask_cache();
        walk();
    }

    template <class F>
    HWY_INLINE void for_each_blocked(F&& f) const {
        for (int g = 0; g * group_size < count_; ++g) {
            const Bits there = (Bits(1) << std::min(count_ - g * group_size, group_size)) - 1;
            for_each_bit(there & ~alive_[g], [&](int i) { f(g * group_size + i); });
        }
    }

private:
    /// A group is wide where its rays are this share of a box's extent apart.
    static constexpr float wide = 1.0f / 8;
    /// So few rays are faster one by one.
    static constexpr int few = 1;

    void ask_cache() {
        if (!cache_) return;
        const auto known = cache_->blocks;
        for (const OccluderCache::Block& b : known)
            if (b.instance == instance_ && live_) test_block(b.first, live_);
    }

    void walk() {
        struct Entry {
            WideLink link;
            Bits groups;
        };
        Entry stack[wide_stack_size<W>];
        int top = 0;
        stack[top++] = {WideLink::node(0), live_};
        while (top > 0 && live_) {
            const auto [link, groups] = stack[--top];
            if (!(groups & live_)) continue;
            if (link.is_leaf()) {
                for (std::uint32_t i = 0; i < link.count(); ++i)
                    test_block(link.first() + i, groups & live_);
                continue;
            }
            const Node& node = object_.tree.nodes[link.first()];
            const Boxes boxes = shaft_.children(node);
            alignas(64) float lo[3][W], hi[3][W], extent[W];
            for (int k = 0; k < 3; ++k) store(boxes.lo[k], lo[k]), store(boxes.hi[k], hi[k]);
            store(max3(boxes.hi[0] - boxes.lo[0], boxes.hi[1] - boxes.lo[1],
                       boxes.hi[2] - boxes.lo[2]),
                  extent);
            const Slopes all = shaft_.groups();
            for (Bits met = bits(may_meet(boxes, shaft_.chunk())); met; met &= met - 1) {
                const int i = std::countr_zero(met);
                const Boxes box{{splat(lo[0][i]), splat(lo[1][i]), splat(lo[2][i])},
                                {splat(hi[0][i]), splat(hi[1][i]), splat(hi[2][i])}};
                const Bits reached = bits(may_meet(box, all)) & groups & live_;
                if (!reached) continue;
                const Bits apart =
                    reached & bits(shaft_.spread() * splat(lo[2][i]) > splat(wide * extent[i]));
                for (Bits rest = apart; rest; rest &= rest - 1)
                    walk_group(std::countr_zero(rest), node.children[i]);
                if (reached & ~apart) stack[top++] = {node.children[i], reached & ~apart};
            }
        }
    }

    /// One group from a node on: its rays in the lanes.
    HWY_NOINLINE void walk_group(int g, WideLink from) {
        struct Entry {
            WideLink link;
            Bits rays;
        };
        Entry stack[wide_stack_size<W>];
        int top = 0;
        stack[top++] = {from, alive_[g]};
        const Slopes slopes = shaft_.group(g);
        const Boxes ends = shaft_.group_ends(g);
        while (top > 0 && alive_[g]) {
            auto [link, rays] = stack[--top];
            rays &= alive_[g];
            if (std::popcount(rays) <= few) {
                trace_singly(g, rays, link);
                continue;
            }
            if (link.is_leaf()) {
                for (std::uint32_t i = 0; i < link.count(); ++i)
                    test_block(link.first() + i, g, slopes, ends);
                continue;
            }
            const Node& node = object_.tree.nodes[link.first()];
            const Boxes boxes = shaft_.children(node);
            alignas(64) float lo[3][W], hi[3][W];
            for (int k = 0; k < 3; ++k) store(boxes.lo[k], lo[k]), store(boxes.hi[k], hi[k]);
            for (Bits met = bits(may_meet(boxes, slopes)); met; met &= met - 1) {
                const int i = std::countr_zero(met);
                const Boxes box{{splat(lo[0][i]), splat(lo[1][i]), splat(lo[2][i])},
                                {splat(hi[0][i]), splat(hi[1][i]), splat(hi[2][i])}};
                Bits reached = 0;
                for (int k = 0; k < group_size; k += W)
                    reached |= bits(may_meet(box, shaft_.rays(g, k))) << k;
                reached &= rays;
                if (reached) stack[top++] = {node.children[i], reached};
            }
        }
    }

    void trace_singly(int g, Bits rays, WideLink from) {
        for (; rays; rays &= rays - 1) {
            const int i = std::countr_zero(rays);
            Query<true> query(1);
            query.trace(object_, ray(g * group_size + i), instance_, from);
            if (query.found()) block(g, Bits(1) << i);
        }
    }

    /// A block of triangles against groups.
    void test_block(std::uint32_t index, Bits groups) {
        const Block& block = object_.blocks[index];
        const Slopes all = shaft_.groups();
        Edges edges;
        bool useful = false;
        for (Bits may = may_hit(block, shaft_, shaft_.chunk(), shaft_.chunk_ends(), edges); may;
             may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            const Bits met = groups_met(edges, lane, all) & groups & live_;
            if (met) useful |= test(block, lane, edges, met);
        }
        if (useful) remember(index);
    }

    /// The same against one group.
    void test_block(std::uint32_t index, int g, const Slopes& slopes, const Boxes& ends) {
        const Block& block = object_.blocks[index];
        Edges edges;
        bool useful = false;
        for (Bits may = may_hit(block, shaft_, slopes, ends, edges); may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            useful |= test(block, lane, edges, Bits(1) << g);
        }
        if (useful) remember(index);
    }

    /// The groups of which not every ray passes outside one edge.
    static HWY_INLINE Bits groups_met(const Edges& edges, int lane, const Slopes& s) {
        Float least = splat(infinity);
        for (const auto& n : edges.normals) {
            const float x = n[0][lane], y = n[1][lane];
            least = hn::Min(least, hn::MulAdd(splat(x), x > 0 ? s.u_hi : s.u_lo,
                                              hn::MulAdd(splat(y), y > 0 ? s.v_hi : s.v_lo,
                                                         splat(n[2][lane]))));
        }
        return bits(hn::Not(least < splat(-edges.slack[lane])));
    }

    /// Blocks the rays of the groups that hit the triangle; tells whether there are any.
    HWY_INLINE bool test(const Block& block, int lane, const Edges& edges, Bits groups) {
        Float n[3][3];
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < 3; ++i) n[k][i] = splat(edges.normals[k][i][lane]);
        const Float slack = splat(-edges.slack[lane]);
        std::optional<Facet> facet;
        bool any = false;
        for (; groups; groups &= groups - 1) {
            const int g = std::countr_zero(groups);
            for (int k = 0; k < group_size; k += W) {
                const int at = g * group_size + k;
                const Float u = load(shaft_.u_ + at), v = load(shaft_.v_ + at);
                const auto distance = [&](int i) HWY_ATTR {
                    return hn::MulAdd(n[i][0], u, hn::MulAdd(n[i][1], v, n[i][2]));
                };
                const Float least = min3(distance(0), distance(1), distance(2));
                const Bits maybe = bits(hn::Not(least < slack)) & alive_[g] >> k;
                if (!maybe) continue;
                if (!facet) facet.emplace(block.lane(lane), shaft_);
                any |= decide(*facet, block, lane, g, k, maybe);
            }
        }
        return any;
    }

    /// Blocks those of the rays that hit the triangle.
    HWY_INLINE bool decide(const Facet& facet, const Block& block, int lane, int g, int k,
                           Bits rays) {
        const int at = g * group_size + k;
        Bits crossed, maybe_crossed;
        facet.crossed(shaft_.d_[0] + at, shaft_.d_[1] + at, shaft_.d_[2] + at, crossed,
                      maybe_crossed);
        rays &= maybe_crossed;
        if (!rays) return false;
        Bits inside, maybe_inside;
        facet.inside(load(shaft_.u_ + at), load(shaft_.v_ + at), inside, maybe_inside);
        Bits hit = rays & inside & crossed;
        for (Bits open = rays & maybe_inside & ~hit; open; open &= open - 1) {
            const int i = std::countr_zero(open);
            TriangleHit found;
            if (TriangleRay(ray(at + i)).hits(block.lane(lane), found)) hit |= Bits(1) << i;
        }
        if (hit) this->block(g, hit << k);
        return hit != 0;
    }

    void block(int g, Bits rays) {
        alive_[g] &= ~rays;
        if (!alive_[g]) live_ &= ~(Bits(1) << g);
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

    Ray ray(int i) const {
        vec3 dir;
        for (int k = 0; k < 3; ++k) dir[shaft_.axes_[k]] = shaft_.d_[k][i];
        dir[shaft_.axes_[2]] *= shaft_.sign_;
        return {shaft_.org_, 0, dir, 1};
    }

    const SceneObject& object_;
    std::uint32_t instance_;
    const Shaft& shaft_;
    int count_;
    OccluderCache* cache_;
    Bits alive_[W];  ///< the rays of each group that nothing blocks yet
    Bits live_ = 0;  ///< the groups that have any
};

/// Sets the flags of the rays that the object blocks; `flag(i)` is that of ray i.
template <class Flag>
void occlude(const SceneObject& object, std::uint32_t instance, const vec3& org,
             const Directions& rays, int first, int count, OccluderCache* cache, Flag&& flag) {
    Shaft shaft;
    if (shaft.set(org, rays, first, count)) {
        ShaftOcclusion occlusion(object, instance, shaft, count, cache);
        occlusion.run();
        occlusion.for_each_blocked([&](int i) { flag(first + i) = 1; });
    } else if (count > group_size) {
        for (int i = 0; i < count; i += group_size)
            occlude(object, instance, org, rays, first + i, std::min(group_size, count - i), cache,
                    flag);
    } else {
        for (int i = first; i < first + count; ++i) {
            Query<true> query(1);
            const Ray ray{org, 0, rays.at(i), 1};
            if (!is_finite(ray.org) || !is_finite(ray.dir)) continue;
            query.trace(object, ray, instance);
            if (query.found()) flag(i) = 1;
        }
    }
}

/// The same for all instances: those that the chunk's frustum meets, each in its own space, with
/// the rays that nothing blocks yet.
void occlude_instances(const Scene& scene, const vec3& org, const Directions& rays, int first,
                       int count, OccluderCache* cache, std::uint8_t* flags) {
    Shaft shaft;
    if (!shaft.set(org, rays, first, count)) {
        if (count > group_size) {
            for (int i = 0; i < count; i += group_size)
                occlude_instances(scene, org, rays, first + i, std::min(group_size, count - i),
                                  cache, flags);
            return;
        }
        for (int i = first; i < first + count; ++i)
            flags[i] = trace<true>(scene, {org, 0, rays.at(i), 1}).valid();
        return;
    }
    int left[chunk_size];
    int left_count = count;
    std::iota(left, left + count, first);
    Mailbox mailbox;
    WideLink stack[wide_stack_size<W>];
    int top = 0;
    stack[top++] = WideLink::node(0);
    while (top > 0 && left_count > 0) {
        const WideLink link = stack[--top];
        if (!link.is_leaf()) {
            const Node& node = scene.top.nodes[link.first()];
            for_each_bit(bits(may_meet(shaft.children(node), shaft.chunk())),
                         [&](int i) { stack[top++] = node.children[i]; });
            continue;
        }
        for (const std::uint32_t item : std::span(&scene.items[link.first()], link.count())) {
            if (left_count == 0 || mailbox.test_and_set(item)) continue;
            const WideInstance& instance = scene.instances[item];
            Directions seen;
            for (int i = 0; i < left_count; ++i)
                seen.add(instance.object_from_world.vector(rays.at(left[i])));
            seen.pad();
            occlude(scene.objects[instance.object], instance.id,
                    instance.object_from_world.point(org), seen, 0, left_count, cache,
                    [&](int i) -> std::uint8_t& { return flags[left[i]]; });
            left_count =
                int(std::remove_if(left, left + left_count, [&](int i) { return flags[i] != 0; }) -
                    left);
        }
    }
}

void occluded_from(const Scene& scene, const vec3& origin, std::span<const vec3> targets,
                   std::span<std::uint8_t> blocked, OccluderCache* cache) {
    std::ranges::fill(blocked, std::uint8_t(0));
    for (std::size_t start = 0; start < targets.size(); start += chunk_size) {
        const std::size_t count = std::min<std::size_t>(chunk_size, targets.size() - start);
        std::uint8_t* const flags = blocked.data() + start;
        Directions rays;
        rays.set(targets.subspan(start, count), origin);
        if (scene.single)
            occlude(scene.objects[0], 0, origin, rays, 0, int(count), cache,
                    [&](int i) -> std::uint8_t& { return flags[i]; });
        else
            occlude_instances(scene, origin, rays, 0, int(count), cache, flags);
    }
}

/// TriangleRay::hits for 16 rays from one origin: the same operations in the same order, and so the
/// same bits, of as many rays at once as doubles fit.
class ExactGroup {
public:
    /// False when the directions are largest along different axes.
    bool set(const vec3& org, std::span<const vec3> dirs) {
        for (int i = 0; i < group_size; ++i) {
            const vec3& dir = dirs[std::min(std::size_t(i), dirs.size() - 1)];
            const TriangleRay ray(Ray{org, 0, dir, infinity});
            if (i == 0) axes_ = ray.axes();
            if (ray.axes() != axes_) return false;
            const glm::dvec3 shear = ray.shear();
            sx_[i] = shear.x, sy_[i] = shear.y, sz_[i] = shear.z;
            t_[i] = infinity;
            ids_[i] = Block::no_triangle;
        }
        for (int k = 0; k < 3; ++k) org_[k] = org[axes_[std::size_t(k)]];
        return true;
    }

    /// Tests rays `first` to `first` + W - 1.
    HWY_INLINE void test(const Block& block, int lane, int first) {
        double x[3], y[3], z[3];
        for (int k = 0; k < 3; ++k) {
            x[k] = block.corners[k][axes_[0]][lane] - org_[0];
            y[k] = block.corners[k][axes_[1]][lane] - org_[1];
            z[k] = block.corners[k][axes_[2]][lane] - org_[2];
        }
        for (int i = first; i < first + W; i += W / 2) test_half(x, y, z, block.ids[lane], i);
    }

    const float* t() const { return t_; }
    Hit hit(int i) const {
        return ids_[i] == Block::no_triangle ? Hit{} : Hit{t_[i], u_[i], v_[i], 0, ids_[i]};
    }

private:
    HWY_INLINE void test_half(const double* px, const double* py, const double* pz,
                              std::uint32_t id, int at) {
        constexpr hn::ScalableTag<double> tag;
        constexpr hn::Rebind<float, decltype(tag)> half;
        using Double = hn::Vec<decltype(tag)>;
        const auto set = [&](double a) HWY_ATTR { return hn::Set(tag, a); };
        const Double sx = hn::Load(tag, sx_ + at), sy = hn::Load(tag, sy_ + at);
        Double x[3], y[3], width = set(0);
        for (int k = 0; k < 3; ++k) {
            x[k] = set(px[k]) - sx * set(pz[k]);
            y[k] = set(py[k]) - sy * set(pz[k]);
            width = hn::Max(width, hn::Max(hn::Abs(x[k]), hn::Abs(y[k])));
        }
        const Double u = x[2] * y[1] - y[2] * x[1];
        const Double v = x[0] * y[2] - y[0] * x[2];
        const Double w = x[1] * y[0] - y[1] * x[0];
        const Double zero = set(0);
        const auto beside =
            hn::And(hn::Min(u, hn::Min(v, w)) < zero, hn::Max(u, hn::Max(v, w)) > zero);
        const Double det = u + v + w;
        const auto sound = hn::Abs(det) > set(8 * 0x1p-53) * width * width;
        const auto hits = hn::AndNot(beside, sound);
        if (hn::AllFalse(tag, hits)) return;
        const Double scale = set(1) / det;
        const Double t =
            (u * set(pz[0]) + v * set(pz[1]) + w * set(pz[2])) * (hn::Load(tag, sz_ + at) * scale);
        const auto t_rounded = hn::DemoteTo(half, t);
        alignas(64) float found_t[W], found_u[W], found_v[W];
        hn::Store(t_rounded, half, found_t);
        hn::Store(hn::DemoteTo(half, v * scale), half, found_u);
        hn::Store(hn::DemoteTo(half, w * scale), half, found_v);
        std::uint8_t bytes[8] = {};
        hn::StoreMaskBits(tag, hits, bytes);
        for (Bits hit = bytes[0]; hit; hit &= hit - 1) {
            const int i = std::countr_zero(hit), k = at + i;
            const float found = found_t[i];
            if (!(found > 0 && found < infinity)) continue;
            if (found < t_[k] || (found == t_[k] && id < ids_[k])) {
                t_[k] = found;
                u_[k] = found_u[i];
                v_[k] = found_v[i];
                ids_[k] = id;
            }
        }
    }

    std::array<int, 3> axes_;
    double org_[3];
    alignas(64) double sx_[group_size], sy_[group_size], sz_[group_size];
    alignas(64) float t_[group_size];
    float u_[group_size], v_[group_size];
    std::uint32_t ids_[group_size];
};

/// Up to 16 rays to their closest hits, the nearest boxes first.
class GroupClosest {
public:
    GroupClosest(const SceneObject& object, const Shaft& shaft, ExactGroup& exact)
        : object_(object), shaft_(shaft), exact_(exact) {}

    void run() {
        struct Entry {
            float z;
            WideLink link;
        };
        Entry stack[wide_stack_size<W>];
        int top = 0;
        stack[top++] = {0, WideLink::node(0)};
        while (top > 0) {
            const auto [z, link] = stack[--top];
            const Slopes slopes = reaching();
            if (z > hn::GetLane(slopes.far)) continue;
            if (link.is_leaf()) {
                for (std::uint32_t i = 0; i < link.count(); ++i)
                    test_block(object_.blocks[link.first() + i], slopes);
                continue;
            }
            const Node& node = object_.tree.nodes[link.first()];
            const Boxes boxes = shaft_.children(node);
            alignas(64) float start[W];
            store(boxes.lo[2], start);
            const int base = top;
            for (Bits met = bits(may_meet(boxes, slopes)); met; met &= met - 1) {
                const int i = std::countr_zero(met);
                int place = top++;
                for (; place != base && stack[place - 1].z < start[i]; --place)
                    stack[place] = stack[place - 1];
                stack[place] = {start[i], node.children[i]};
            }
        }
    }

private:
    /// The group's slopes, as far as its rays still matter.
    Slopes reaching() const {
        Slopes s = shaft_.group(0);
        Float far = splat(0);
        for (int k = 0; k < group_size; k += W)
            far = hn::Max(far, load(exact_.t() + k) * load(shaft_.far_ + k));
        s.far = hn::MaxOfLanes(lanes_tag, far) * splat(1 + 0x1p-20f);
        return s;
    }

    void test_block(const Block& block, const Slopes& slopes) {
        Boxes anywhere;
        for (int k = 0; k < 3; ++k)
            anywhere.lo[k] = splat(-infinity), anywhere.hi[k] = splat(infinity);
        Edges edges;
        for (Bits may = may_hit(block, shaft_, slopes, anywhere, edges); may; may &= may - 1) {
            const int lane = std::countr_zero(may);
            if (block.ids[lane] == Block::no_triangle) break;
            for (int k = 0; k < group_size; k += W)
                if (not_outside(edges, lane, k)) exact_.test(block, lane, k);
        }
    }

    HWY_INLINE Bits not_outside(const Edges& edges, int lane, int k) const {
        const Float u = load(shaft_.u_ + k);
        const Float v = load(shaft_.v_ + k);
        Float least = splat(infinity);
        for (const auto& n : edges.normals)
            least = hn::Min(least, hn::MulAdd(splat(n[0][lane]), u,
                                              hn::MulAdd(splat(n[1][lane]), v, splat(n[2][lane]))));
        return bits(hn::Not(least < splat(-edges.slack[lane])));
    }

    const SceneObject& object_;
    const Shaft& shaft_;
    ExactGroup& exact_;
};

void closest_from(const Scene& scene, const vec3& origin, std::span<const vec3> dirs,
                  std::span<Hit> hits) {
    for (std::size_t start = 0; start < dirs.size(); start += group_size) {
        const std::size_t count = std::min<std::size_t>(group_size, dirs.size() - start);
        const auto group = dirs.subspan(start, count);
        const auto out = hits.subspan(start, count);
        Directions rays;
        rays.set(group, vec3(0));
        Shaft shaft;
        ExactGroup exact;
        if (scene.single && is_finite(origin) && shaft.set(origin, rays, 0, int(count)) &&
            exact.set(origin, group)) {
            GroupClosest(scene.objects[0], shaft, exact).run();
            for (std::size_t i = 0; i < count; ++i) out[i] = exact.hit(int(i));
        } else {
            for (std::size_t i = 0; i < count; ++i)
                out[i] = trace<false>(scene, {origin, 0, group[i], infinity});
        }
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
