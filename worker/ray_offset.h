// Keeps a secondary ray from hitting the surface it leaves. As in Wächter and Binder, "A Fast and
// Robust Method for Avoiding Self-Intersection" (2019), the origin moves along the geometric normal
// by a fixed number of units in the last place rather than by a global epsilon. We differ in
// counting ulps of the largest coordinate that went into the point, so that one rule serves axis
// planes, points near the origin and scenes of any size.
#pragma once

#include "common/math.h"

namespace tessera {

/// Largest absolute coordinate of `p`: the scale of its rounding errors.
inline float magnitude(const vec3& p) { return max_component(abs(p)); }

/// `p` moved off the surface it lies on, with unit geometric normal `ng`, to the side `towards`
/// points to. World space. `scale` is the largest absolute coordinate that `p` was computed from,
/// which exceeds that of `p` itself when it lies near the origin on a large triangle: pass the
/// magnitude() of the triangle's vertices, or of the scene's bounds.
inline vec3 offset_point(const vec3& p, const vec3& ng, const vec3& towards, float scale = 0) {
    // A point interpolated in float is wrong by a few ulps of `scale`, and as much again is rounded
    // away when it is moved to an instance's object space; 32 (2^-23 each) cover both.
    constexpr float relative = 32.0f / (1 << 23);
    const float distance = relative * std::max(scale, magnitude(p));
    return p + ng * std::copysign(distance, dot(ng, towards));
}

}  // namespace tessera
