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

/// A triangle's edge functions (weights of its vertices but for a common factor) and its vertices
/// relative to the ray's origin along z.
template <class T>
struct Edges {
    T u, v, w;
    T az, bz, cz;
    T extent;  ///< largest absolute coordinate of a vertex relative to the origin

    bool signs_differ(T tolerance) const {
        return std::min({u, v, w}) < -tolerance && std::max({u, v, w}) > tolerance;
    }
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
    Edges<T> edges(const Shear<T>& shear, const Triangle& triangle) const;

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
inline Edges<T> TriangleRay::edges(const Shear<T>& s, const Triangle& triangle) const {
    const T az = T(triangle.a[z_]) - s.org[2];
    const T bz = T(triangle.b[z_]) - s.org[2];
    const T cz = T(triangle.c[z_]) - s.org[2];
    const T ax0 = T(triangle.a[x_]) - s.org[0], ay0 = T(triangle.a[y_]) - s.org[1];
    const T bx0 = T(triangle.b[x_]) - s.org[0], by0 = T(triangle.b[y_]) - s.org[1];
    const T cx0 = T(triangle.c[x_]) - s.org[0], cy0 = T(triangle.c[y_]) - s.org[1];
    const T ax = ax0 - s.sx * az, ay = ay0 - s.sy * az;
    const T bx = bx0 - s.sx * bz, by = by0 - s.sy * bz;
    const T cx = cx0 - s.sx * cz, cy = cy0 - s.sy * cz;
    const T extent =
        std::max({std::abs(ax0), std::abs(ay0), std::abs(az), std::abs(bx0), std::abs(by0),
                  std::abs(bz), std::abs(cx0), std::abs(cy0), std::abs(cz)});
    return {cx * by - cy * bx, ax * cy - ay * cx, bx * ay - by * ax, az, bz, cz, extent};
}

inline bool TriangleRay::hits(const Triangle& triangle, TriangleHit& hit) const {
    // With vertices within M of the origin and |sx|, |sy| <= 1, a sheared coordinate is at most 2 M
    // and wrong by less than 8 M units of 2^-24, an edge function by less than 80 M^2 of them.
    const Edges<float> rough = edges(rough_, triangle);
    if (rough.signs_differ(128 * 0x1p-24f * rough.extent * rough.extent)) return false;

    const Edges<double> e = edges(exact_, triangle);
    if (e.signs_differ(0)) return false;
    const double scale = 1 / (e.u + e.v + e.w);
    const double t = (e.u * e.az + e.v * e.bz + e.w * e.cz) * (exact_.sz * scale);
    hit = {float(t), float(e.v * scale), float(e.w * scale)};
    // Edge-on triangles divide by zero; what is not a number is a miss.
    return hit.t > tmin_ && hit.t < tmax_;
}

}  // namespace tessera
