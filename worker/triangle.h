// Watertight ray/triangle test after Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection"
// (2013): the triangle is sheared into a space where the ray is the z axis, and three edge
// functions decide there. Neighbours evaluate a shared edge with the same products, and rounding
// never turns the sign of a difference of products, so a ray cannot slip between them.
//
// We differ in the precision. The decision, t and the barycentrics are computed in double, so that
// they are right to the last bit or so of a float and do not depend on who calls; in front stands
// the same test in float, which only rejects, and only where its error bound says that double would
// too.
#pragma once

#include <array>
#include <cmath>

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

/// A ray's origin and its shear, axes permuted so that `dir` is largest along z.
template <class T>
struct Shear {
    std::array<T, 3> org;
    T sx, sy, sz;
};

/// A triangle seen along the ray: its vertices relative to the origin, sheared, and its edge
/// functions, which are the weights of its vertices but for a common factor.
template <class T>
struct ShearedTriangle {
    T ax, ay, az, bx, by, bz, cx, cy, cz;
    T u = cx * by - cy * bx;
    T v = ax * cy - ay * cx;
    T w = bx * ay - by * ax;

    bool signs_differ(T tolerance) const {
        return std::min({u, v, w}) < -tolerance && std::max({u, v, w}) > tolerance;
    }
    /// Largest distance of a vertex from the ray along x or y.
    T width() const {
        return std::max(
            {std::abs(ax), std::abs(ay), std::abs(bx), std::abs(by), std::abs(cx), std::abs(cy)});
    }
    T extent() const { return std::max({width(), std::abs(az), std::abs(bz), std::abs(cz)}); }
};

struct TriangleHit {
    float t = 0;
    float u = 0;  ///< weight of b
    float v = 0;  ///< weight of c
};

/// All the test needs of a ray, computed once.
class TriangleRay {
public:
    explicit TriangleRay(const Ray& ray);

    /// The hit with tmin < t < tmax, from either side; false where there is none.
    bool hits(const Triangle& triangle, TriangleHit& hit) const;

private:
    template <class T>
    Shear<T> shear(const Ray& ray) const;
    template <class T>
    ShearedTriangle<T> sheared(const Shear<T>& shear, const Triangle& triangle) const;

    int x_, y_, z_;
    float tmin_, tmax_;
    Shear<float> rough_;
    Shear<double> exact_;
};

inline TriangleRay::TriangleRay(const Ray& ray) : tmin_(ray.tmin), tmax_(ray.tmax) {
    const vec3 d = abs(ray.dir);
    z_ = d.x > d.y ? (d.x > d.z ? 0 : 2) : (d.y > d.z ? 1 : 2);
    x_ = z_ == 2 ? 0 : z_ + 1;
    y_ = x_ == 2 ? 0 : x_ + 1;
    rough_ = shear<float>(ray);
    exact_ = shear<double>(ray);
}

template <class T>
Shear<T> TriangleRay::shear(const Ray& ray) const {
    const T sz = 1 / T(ray.dir[z_]);
    return {{T(ray.org[x_]), T(ray.org[y_]), T(ray.org[z_])},
            T(ray.dir[x_]) * sz,
            T(ray.dir[y_]) * sz,
            sz};
}

template <class T>
inline ShearedTriangle<T> TriangleRay::sheared(const Shear<T>& s, const Triangle& triangle) const {
    const T az = T(triangle.a[z_]) - s.org[2];
    const T bz = T(triangle.b[z_]) - s.org[2];
    const T cz = T(triangle.c[z_]) - s.org[2];
    const auto x = [&](const vec3& p, T z) { return (T(p[x_]) - s.org[0]) - s.sx * z; };
    const auto y = [&](const vec3& p, T z) { return (T(p[y_]) - s.org[1]) - s.sy * z; };
    return {x(triangle.a, az), y(triangle.a, az), az, x(triangle.b, bz), y(triangle.b, bz), bz,
            x(triangle.c, cz), y(triangle.c, cz), cz};
}

inline bool TriangleRay::hits(const Triangle& triangle, TriangleHit& hit) const {
    // With vertices within M of the origin, M = extent(), and |sx|, |sy| <= 1, a sheared coordinate
    // is wrong by at most 6 M units of 2^-24, an edge function by 28 M^2.
    const ShearedTriangle<float> rough = sheared(rough_, triangle);
    if (rough.signs_differ(64 * 0x1p-24f * rough.extent() * rough.extent())) return false;

    const ShearedTriangle<double> e = sheared(exact_, triangle);
    if (e.signs_differ(0)) return false;
    // Edge functions of a triangle too small for its distance from the ray are but rounding errors.
    // So are those of one seen edge-on; what is not a number is a miss.
    const double det = e.u + e.v + e.w;
    if (!(std::abs(det) > 8 * 0x1p-53 * e.width() * e.width())) return false;
    const double scale = 1 / det;
    const double t = (e.u * e.az + e.v * e.bz + e.w * e.cz) * (exact_.sz * scale);
    hit = {float(t), float(e.v * scale), float(e.w * scale)};
    return hit.t > tmin_ && hit.t < tmax_;
}

}  // namespace tessera
