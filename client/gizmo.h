// Three arrows at what is selected, along the axes of the world: which of them lies under the
// pointer, and how far along it the pointer has come. Pure. Points of the picture are as eye_ray()
// takes them.
#pragma once

#include <optional>

#include "common/scene.h"

namespace tessera {

struct Gizmo {
    vec3 origin{0};
    float length = 0;  ///< of each arrow, metres

    static vec3 axis(int arrow);
    vec3 tip(int arrow) const { return origin + length * axis(arrow); }
};

/// As large in the picture, wherever it is.
Gizmo gizmo_at(const Camera& camera, const vec3& origin);

/// The arrow (0 to 2) under a point of the picture, if there is one.
std::optional<int> arrow_at(const Camera& camera, const Gizmo& gizmo, const vec2& point);

/// Metres from the origin to where the line of the arrow comes nearest to the ray; nothing when the
/// ray goes along it.
std::optional<float> distance_along(const Gizmo& gizmo, int arrow, const Ray& ray);

}  // namespace tessera
