// Triangles as the common origin of a shaft's rays sees them.
//
// With one origin for all rays a triangle's edges span planes through it, and what side of them a
// ray passes takes two multiplications (Wald, "Realtime Ray Tracing and Interactive Global
// Illumination", 2004, 7.2 prepares triangles for any ray; here the origin is prepared, too). A
// block of triangles is prepared at once in float, with bounds of what may be wrong; what those
// leave open is set up once more in double.
#if defined(TESSERA_FACET_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_FACET_INL_H
#undef TESSERA_FACET_INL_H
#else
#define TESSERA_FACET_INL_H
#endif

#include "worker/shaft-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

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

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
