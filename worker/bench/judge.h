// The third opinion when tracers differ: brute force in double, which says what an exact tracer may
// answer within rounding.
#pragma once

#include <optional>

#include "worker/bench/tracer_scenes.h"

namespace tessera {

/// The closest t of triangles that the ray surely hits, and the closest of those that it hits or
/// grazes within rounding. Each is moved by its own uncertainty to the side that allows more.
struct Verdict {
    double sure = infinity;
    double possible = infinity;

    bool allows(const Hit& hit) const {
        const double t = hit.valid() ? double(hit.t) : double(infinity);
        return t <= sure && (t >= possible || !hit.valid());
    }
    bool allows(bool blocked) const { return blocked ? possible < infinity : sure == infinity; }
};

/// Relative errors of positions that a tracer is forgiven: float's, where a ray passes through an
/// instance's matrix; double's, where its input is exact.
inline constexpr double float_precision = 1e-6;
inline constexpr double double_precision = 1e-12;

/// Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection" (1997), in double, over
/// every triangle that the tracer's contract counts, but for `left_out` of every mesh.
Verdict judge(const TestScene& scene, const Ray& ray, double precision = float_precision,
              std::optional<std::uint32_t> left_out = {});

}  // namespace tessera
