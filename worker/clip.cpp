// Sutherland and Hodgman, "Reentrant Polygon Clipping" (1974), in double. Coordinates that a clip
// plane or an axis-aligned edge fixes stay exact, so triangles in an axis plane stay flat; others
// are rounded outwards to float.
#include "worker/clip.h"

#include <array>

namespace tessera {
namespace {

using glm::dvec3;

/// A convex polygon: a triangle cut by six planes has nine corners at most.
struct Polygon {
    std::array<dvec3, 9> corners;
    int count = 0;

    void add(const dvec3& p) { corners[count++] = p; }
};

/// Keeps what lies at or beyond `position` on the side `sign` (+1: above).
Polygon cut(const Polygon& in, int axis, double position, double sign) {
    Polygon out;
    for (int i = 0; i < in.count; ++i) {
        const dvec3& p = in.corners[i];
        const dvec3& q = in.corners[i + 1 == in.count ? 0 : i + 1];
        const double dp = sign * (p[axis] - position);
        const double dq = sign * (q[axis] - position);
        if (dp >= 0) out.add(p);
        if ((dp < 0 && dq > 0) || (dp > 0 && dq < 0)) {
            dvec3 between = p + dp / (dp - dq) * (q - p);
            between[axis] = position;
            out.add(between);
        }
    }
    return out;
}

float round_down(double x) {
    const float f = float(x);
    return double(f) > x ? std::nextafter(f, -infinity) : f;
}
float round_up(double x) { return -round_down(-x); }

Box bounds_of(const Polygon& polygon) {
    Box box;
    for (int i = 0; i < polygon.count; ++i) {
        const dvec3& p = polygon.corners[i];
        box.lo = min(box.lo, vec3(round_down(p.x), round_down(p.y), round_down(p.z)));
        box.hi = max(box.hi, vec3(round_up(p.x), round_up(p.y), round_up(p.z)));
    }
    return box;
}

Box intersection(const Box& a, const Box& b) { return {max(a.lo, b.lo), min(a.hi, b.hi)}; }

}  // namespace

Box clipped_bounds(const Triangle& triangle, const Box& cell) {
    Box whole;
    for (const vec3& p : {triangle.a, triangle.b, triangle.c}) whole.add(p);
    const Box loose = intersection(whole, cell);
    if (loose.empty() || loose == whole) return loose;

    // Cut by those planes only that the triangle crosses.
    Polygon polygon{{dvec3(triangle.a), dvec3(triangle.b), dvec3(triangle.c)}, 3};
    for (int axis = 0; axis < 3; ++axis) {
        if (whole.lo[axis] < cell.lo[axis]) polygon = cut(polygon, axis, cell.lo[axis], 1);
        if (whole.hi[axis] > cell.hi[axis]) polygon = cut(polygon, axis, cell.hi[axis], -1);
    }
    // A triangle that grazes the cell may be rounded away: keep it with its box.
    const Box tight = intersection(bounds_of(polygon), loose);
    return tight.empty() ? loose : tight;
}

}  // namespace tessera
