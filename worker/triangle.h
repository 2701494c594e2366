// Watertight ray/triangle test after Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection"
// (2013): the triangle is sheared into a space where the ray is the z axis, and three edge
// functions decide there. Neighbours evaluate a shared edge with the same products, and rounding
// never turns the sign of a difference of products, so a ray cannot slip between them.
//
// We differ in the precision. The decision, t and the barycentrics are computed in double, so that
// they are right to the last bit or so of a float and do not depend on who calls. In front stands
// the same test in float for four triangles at once, which only rejects, and only where its error
// bound says that double would too.
#pragma once

#include <cmath>
#include <span>

#include "common/math.h"
#include "worker/float4.h"

namespace tessera {

struct Triangle {
    vec3 a, b, c;
    std::uint32_t id = 0;  ///< index into the mesh's triangles
};

/// Twice the area vector vanishes or a vertex is not finite: such triangles are never hit.
inline bool is_degenerate(const Triangle& triangle) {
    const glm::dvec3 a(triangle.a);
    const glm::dvec3 n = cross(glm::dvec3(triangle.b) - a, glm::dvec3(triangle.c) - a);
    return !(is_finite(triangle.a) && is_finite(triangle.b) && is_finite(triangle.c)) ||
           n == glm::dvec3(0);
}

/// Four triangles side by side; `ids` as in Triangle, or no_triangle in free lanes.
struct TriangleBlock {
    static constexpr std::uint32_t no_triangle = ~0u;

    Float4 corners[3][3];  ///< [a, b, c][x, y, z]
    std::uint32_t ids[4];

    /// `triangles` holds one to four. Free lanes repeat the corners of the first, so that what
    /// rejects it rejects the whole block.
    static TriangleBlock of(std::span<const Triangle> triangles);
    Triangle lane(int i) const;
};

struct TriangleHit {
    float t = 0;
    float u = 0;  ///< weight of b
    float v = 0;  ///< weight of c
};

/// All the tests need of a ray, computed once.
class TriangleRay {
public:
    explicit TriangleRay(const Ray& ray);

    /// The lanes whose triangles the ray surely misses in tmin < t <= t_last.
    Mask4 surely_misses(const TriangleBlock& block, float t_last) const;

    /// The hit with tmin < t < tmax, from either side; false where there is none.
    bool hits(const Triangle& triangle, TriangleHit& hit) const;

private:
    int x_, y_, z_;  ///< the axes, permuted so that `dir` is largest along z
    float tmin_, tmax_;
    glm::dvec3 org_;       ///< permuted
    double sx_, sy_, sz_;  ///< the shear: dir.x / dir.z, dir.y / dir.z, 1 / dir.z
    float rough_org_[3], rough_sx_, rough_sy_, rough_sz_;
};

inline TriangleBlock TriangleBlock::of(std::span<const Triangle> triangles) {
    TriangleBlock block;
    for (std::size_t i = 0; i < 4; ++i) {
        const bool free = i >= triangles.size();
        const Triangle& triangle = triangles[free ? 0 : i];
        for (int k = 0; k < 3; ++k) {
            block.corners[0][k][i] = triangle.a[k];
            block.corners[1][k][i] = triangle.b[k];
            block.corners[2][k][i] = triangle.c[k];
        }
        block.ids[i] = free ? no_triangle : triangle.id;
    }
    return block;
}

inline Triangle TriangleBlock::lane(int i) const {
    const auto corner = [&](int k) {
        return vec3(corners[k][0][i], corners[k][1][i], corners[k][2][i]);
    };
    return {corner(0), corner(1), corner(2), ids[i]};
}

inline TriangleRay::TriangleRay(const Ray& ray) : tmin_(ray.tmin), tmax_(ray.tmax) {
    const vec3 d = abs(ray.dir);
    z_ = d.x > d.y ? (d.x > d.z ? 0 : 2) : (d.y > d.z ? 1 : 2);
    x_ = z_ == 2 ? 0 : z_ + 1;
    y_ = x_ == 2 ? 0 : x_ + 1;
    org_ = {ray.org[x_], ray.org[y_], ray.org[z_]};
    sz_ = 1 / double(ray.dir[z_]);
    sx_ = ray.dir[x_] * sz_;
    sy_ = ray.dir[y_] * sz_;
    for (int k = 0; k < 3; ++k) rough_org_[k] = float(org_[k]);
    rough_sx_ = float(sx_);
    rough_sy_ = float(sy_);
    rough_sz_ = float(sz_);
}

inline Mask4 TriangleRay::surely_misses(const TriangleBlock& block, float t_last) const {
    Float4 x[3], y[3], t[3], width{}, depth{};
    for (int k = 0; k < 3; ++k) {
        const Float4 z = block.corners[k][z_] - rough_org_[2];
        t[k] = z * rough_sz_;
        x[k] = (block.corners[k][x_] - rough_org_[0]) - rough_sx_ * z;
        y[k] = (block.corners[k][y_] - rough_org_[1]) - rough_sy_ * z;
        width = max(width, max(abs(x[k]), abs(y[k])));
        depth = max(depth, abs(z));
    }
    const Float4 extent = max(width, depth);
    const Float4 u = x[2] * y[1] - y[2] * x[1];
    const Float4 v = x[0] * y[2] - y[0] * x[2];
    const Float4 w = x[1] * y[0] - y[1] * x[0];
    // Counted in units of 2^-24: with M = extent and |sx|, |sy| <= 1, a sheared coordinate is wrong
    // by at most 6 M, and an edge function, with coordinates up to W = width, by 30 M W + 72 M^2.
    constexpr float unit = 0x1p-24f;
    const Float4 error = (64 * unit) * extent * (width + (4 * unit) * extent);
    const Mask4 beside = (min(u, min(v, w)) < -error) & (max(u, max(v, w)) > error);
    // A hit lies between the vertices; each t is wrong by at most 2 of these units.
    constexpr float slack = 8 * unit;
    const Mask4 before = max(t[0], max(t[1], t[2])) * (1 + slack) < tmin_;
    const Mask4 behind = min(t[0], min(t[1], t[2])) * (1 - slack) > t_last;
    return beside | before | behind;
}

inline bool TriangleRay::hits(const Triangle& triangle, TriangleHit& hit) const {
    const double az = triangle.a[z_] - org_.z;
    const double bz = triangle.b[z_] - org_.z;
    const double cz = triangle.c[z_] - org_.z;
    const double ax = (triangle.a[x_] - org_.x) - sx_ * az,
                 ay = (triangle.a[y_] - org_.y) - sy_ * az;
    const double bx = (triangle.b[x_] - org_.x) - sx_ * bz,
                 by = (triangle.b[y_] - org_.y) - sy_ * bz;
    const double cx = (triangle.c[x_] - org_.x) - sx_ * cz,
                 cy = (triangle.c[y_] - org_.y) - sy_ * cz;
    const double u = cx * by - cy * bx;
    const double v = ax * cy - ay * cx;
    const double w = bx * ay - by * ax;
    if (std::min({u, v, w}) < 0 && std::max({u, v, w}) > 0) return false;

    // Edge functions of a triangle too small for its distance from the ray are but rounding errors,
    // and so are those of one seen edge-on. What is not a number is a miss.
    const double det = u + v + w;
    const double width = std::max(
        {std::abs(ax), std::abs(ay), std::abs(bx), std::abs(by), std::abs(cx), std::abs(cy)});
    if (!(std::abs(det) > 8 * 0x1p-53 * width * width)) return false;
    const double scale = 1 / det;
    const double t = (u * az + v * bz + w * cz) * (sz_ * scale);
    hit = {float(t), float(v * scale), float(w * scale)};
    return hit.t > tmin_ && hit.t < tmax_;
}

}  // namespace tessera
