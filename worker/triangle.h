// Watertight ray/triangle test after Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection"
// (2013): the triangle is sheared into a space where the ray is the z axis, and three edge
// functions decide there. Neighbours evaluate a shared edge with the same products, and rounding
// never turns the sign of a difference of products, so a ray cannot slip between them.
//
// We differ in the precision. The decision, t and the barycentrics are computed in double, so that
// they are right to the last bit or so of a float and do not depend on who calls. In front stand
// float tests of many triangles or rays at once (worker/ray-inl.h, worker/facet-inl.h), which
// decide only where their error bounds say that double would decide the same.
#pragma once

#include <array>
#include <cmath>
#include <span>

#include "common/math.h"

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

/// Triangles side by side; `ids` as in Triangle, or no_triangle in free lanes.
template <int width>
struct alignas(4 * width) TriangleBlock {
    static constexpr std::uint32_t no_triangle = ~0u;

    float corners[3][3][width];  ///< [a, b, c][x, y, z]
    std::uint32_t ids[width];

    /// `triangles` holds one to `width`. Free lanes repeat the corners of the first, so that what
    /// rejects it rejects the whole block.
    static TriangleBlock of(std::span<const Triangle> triangles);
    Triangle lane(int i) const;
};

struct TriangleHit {
    float t = 0;
    float u = 0;  ///< weight of b
    float v = 0;  ///< weight of c
};

/// The axes, permuted so that `dir` is largest along the last.
inline std::array<int, 3> axes_of(const vec3& dir) {
    // Without branches, which rays of all directions would mispredict.
    constexpr std::array<int, 3> orders[] = {{1, 2, 0}, {2, 0, 1}, {0, 1, 2}};
    const float x = std::abs(dir.x), y = std::abs(dir.y), z = std::abs(dir.z);
    const int of_xy = x > y ? 0 : 1;
    const int before_z = int(x > z) | int(y > z);
    return orders[2 + before_z * (of_xy - 2)];
}

/// All the tests need of a ray, computed once.
class TriangleRay {
public:
    explicit TriangleRay(const Ray& ray);

    /// The hit with tmin < t < tmax, from either side; false where there is none.
    bool hits(const Triangle& triangle, TriangleHit& hit) const;
    template <int width>
    bool hits(const TriangleBlock<width>& block, int lane, TriangleHit& hit) const;

    /// The axes, permuted so that `dir` is largest along z, and the shear that turns it to z:
    /// dir.x / dir.z, dir.y / dir.z, 1 / dir.z.
    std::array<int, 3> axes() const { return {x_, y_, z_}; }
    glm::dvec3 shear() const { return {sx_, sy_, sz_}; }

private:
    /// Relative to the ray's origin and permuted.
    using Corners = std::array<glm::dvec3, 3>;
    bool decide(const Corners& corners, TriangleHit& hit) const;

    int x_, y_, z_;
    float tmin_, tmax_;
    glm::dvec3 org_;  ///< permuted
    double sx_, sy_, sz_;
};

template <int width>
TriangleBlock<width> TriangleBlock<width>::of(std::span<const Triangle> triangles) {
    TriangleBlock block;
    for (std::size_t i = 0; i < width; ++i) {
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

template <int width>
Triangle TriangleBlock<width>::lane(int i) const {
    const auto corner = [&](int k) {
        return vec3(corners[k][0][i], corners[k][1][i], corners[k][2][i]);
    };
    return {corner(0), corner(1), corner(2), ids[i]};
}

inline TriangleRay::TriangleRay(const Ray& ray) : tmin_(ray.tmin), tmax_(ray.tmax) {
    const auto [x, y, z] = axes_of(ray.dir);
    x_ = x, y_ = y, z_ = z;
    // Indexing a vec3 with a variable branches.
    const float *const org = &ray.org.x, *const dir = &ray.dir.x;
    org_ = {org[x_], org[y_], org[z_]};
    sz_ = 1 / double(dir[z_]);
    sx_ = dir[x_] * sz_;
    sy_ = dir[y_] * sz_;
}

inline bool TriangleRay::hits(const Triangle& triangle, TriangleHit& hit) const {
    const auto corner = [&](const vec3& p) {
        const float* const at = &p.x;
        return glm::dvec3(at[x_], at[y_], at[z_]) - org_;
    };
    return decide({corner(triangle.a), corner(triangle.b), corner(triangle.c)}, hit);
}

template <int width>
bool TriangleRay::hits(const TriangleBlock<width>& block, int lane, TriangleHit& hit) const {
    const auto corner = [&](const float(&p)[3][width]) {
        return glm::dvec3(p[x_][lane], p[y_][lane], p[z_][lane]) - org_;
    };
    return decide({corner(block.corners[0]), corner(block.corners[1]), corner(block.corners[2])},
                  hit);
}

inline bool TriangleRay::decide(const Corners& corners, TriangleHit& hit) const {
    const auto [a, b, c] = corners;
    const double az = a.z, bz = b.z, cz = c.z;
    const double ax = a.x - sx_ * az, ay = a.y - sy_ * az;
    const double bx = b.x - sx_ * bz, by = b.y - sy_ * bz;
    const double cx = c.x - sx_ * cz, cy = c.y - sy_ * cz;
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
