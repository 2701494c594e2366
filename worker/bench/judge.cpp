#include "worker/bench/judge.h"

#include "worker/affine.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

using glm::dmat4;
using glm::dvec3;
using glm::dvec4;

struct Segment {
    dvec3 org, dir;
    double tmin, tmax;
};

/// Where the ray can be inside the box, widened by `margin`: from `lo` to `hi`, none when lo > hi.
struct Range {
    double lo, hi;
};

Range range_in_box(const Segment& ray, const dvec3& lo, const dvec3& hi, double margin) {
    Range range{ray.tmin, ray.tmax};
    for (int k = 0; k < 3; ++k) {
        const double to_lo = lo[k] - margin - ray.org[k], to_hi = hi[k] + margin - ray.org[k];
        if (ray.dir[k] == 0) {
            if (to_lo > 0 || to_hi < 0) return {1, 0};
            continue;
        }
        const auto [first, last] = std::minmax({to_lo / ray.dir[k], to_hi / ray.dir[k]});
        range = {std::max(range.lo, first), std::min(range.hi, last)};
    }
    return range;
}

void judge_triangle(Verdict& verdict, const Segment& ray, const dvec3& a, const dvec3& b,
                    const dvec3& c, double precision) {
    const dvec3 p = cross(ray.dir, c - a);
    const double det = dot(p, b - a);
    const dvec3 s = ray.org - a, q = cross(s, b - a);
    const double u = dot(s, p) / det, w = dot(ray.dir, q) / det, t = dot(c - a, q) / det;
    const double speed = length(ray.dir);
    const double reach = length(s) + length(b - a) + length(c - a) + length(ray.org);
    const double height = std::abs(det) / (speed * std::max(length(b - a), length(c - a)));
    const double slack = precision * reach / height;
    const double inside = std::min({u, w, 1 - u - w});
    // A float holds t no better than this, however exact the decision.
    const double t_slack = float_precision * (reach / speed + std::abs(t)) + slack * std::abs(t);
    if (inside > slack && t > ray.tmin + t_slack && t < ray.tmax - t_slack)
        verdict.sure = std::min(verdict.sure, t + t_slack);
    if (inside < -slack || t < ray.tmin - t_slack || t > ray.tmax + t_slack) return;
    // Of a triangle that is seen edge-on, only its box tells where it may be hit.
    const Range range =
        range_in_box(ray, min(min(a, b), c), max(max(a, b), c), std::max(precision, 1e-9) * reach);
    if (range.lo > range.hi) return;
    const double at_box = range.lo - float_precision * (reach / speed + range.lo);
    verdict.possible = std::min(
        verdict.possible, std::isfinite(t - t_slack) ? std::max(t - t_slack, at_box) : at_box);
}

}  // namespace

Verdict judge(const TestScene& scene, const Ray& ray, double precision,
              std::optional<std::uint32_t> left_out) {
    Verdict verdict;
    const Segment segment{dvec3(ray.org), dvec3(ray.dir), ray.tmin, ray.tmax};
    for (const TracerInstance& instance : scene.instances) {
        if (!inverse_affine(instance.world_from_object)) continue;
        const dmat4 m(instance.world_from_object);
        const Mesh& mesh = scene.meshes[instance.object];
        for (std::uint32_t i = 0; i < mesh.triangles.size(); ++i) {
            const uvec3& v = mesh.triangles[i];
            const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y], &c = mesh.positions[v.z];
            if (i == left_out || is_degenerate({a, b, c})) continue;
            judge_triangle(verdict, segment, dvec3(m * dvec4(a, 1)), dvec3(m * dvec4(b, 1)),
                           dvec3(m * dvec4(c, 1)), precision);
        }
    }
    return verdict;
}

}  // namespace tessera
