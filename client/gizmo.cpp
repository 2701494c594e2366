#include "client/gizmo.h"

#include <algorithm>
#include <cmath>

#include "client/camera_control.h"

namespace tessera {
namespace {

/// Of half the picture's height: the length of an arrow, and how far from it a hand may be.
constexpr float arrow_length = 0.3f, reach = 0.035f;
/// The part of an arrow that is left to what lies under it.
constexpr float held_from = 0.3f;

float distance_to_segment(const vec2& p, const vec2& a, const vec2& b) {
    const vec2 ab = b - a;
    const float t = std::clamp(dot(p - a, ab) / std::max(dot(ab, ab), 1e-12f), 0.0f, 1.0f);
    return length(p - (a + t * ab));
}

}  // namespace

vec3 Gizmo::axis(int arrow) {
    vec3 out(0);
    out[arrow] = 1;
    return out;
}

Gizmo gizmo_at(const Camera& camera, const vec3& origin) {
    const float away = length(origin - camera.eye);
    return {.origin = origin,
            .length = arrow_length * away * std::tan(0.5f * glm::radians(camera.fov_y))};
}

std::optional<int> arrow_at(const Camera& camera, const Gizmo& gizmo, const vec2& point) {
    const auto base = projected(camera, gizmo.origin);
    if (!base) return std::nullopt;
    std::optional<int> nearest;
    float distance = reach;
    for (int arrow = 0; arrow < 3; ++arrow) {
        const auto tip = projected(camera, gizmo.tip(arrow));
        if (!tip) continue;
        // Near the origin it is not said which one is meant.
        const float d = distance_to_segment(point, *base + held_from * (*tip - *base), *tip);
        if (d >= distance) continue;
        distance = d;
        nearest = arrow;
    }
    return nearest;
}

std::optional<float> distance_along(const Gizmo& gizmo, int arrow, const Ray& ray) {
    const vec3 a = Gizmo::axis(arrow), d = normalize(ray.dir), w = gizmo.origin - ray.org;
    const float b = dot(a, d), apart = 1 - b * b;
    if (apart < 1e-6f) return std::nullopt;
    return (b * dot(d, w) - dot(a, w)) / apart;
}

}  // namespace tessera
