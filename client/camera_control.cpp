#include "client/camera_control.h"

namespace tessera {
namespace {

/// Radians for a drag over the whole height of the picture.
constexpr float full_turn = pi;
/// The view stays this far from straight up and down, radians.
constexpr float pole = 0.02f;

struct Axes {
    vec3 right, up, forward;
};

Axes axes_of(const Camera& camera) {
    const vec3 forward = normalize(camera.at - camera.eye);
    const vec3 right = normalize(cross(forward, camera.up));
    return {right, cross(right, forward), forward};
}

vec3 rotated(const vec3& v, const vec3& axis, float angle) {
    return v * std::cos(angle) + cross(axis, v) * std::sin(angle) +
           axis * dot(axis, v) * (1 - std::cos(angle));
}

/// The view direction `v` turned sideways and upwards, but not over the pole.
vec3 turned(const Camera& camera, const vec3& v, const vec2& angles) {
    const vec3 up = normalize(camera.up);
    const float elevation = std::asin(std::clamp(dot(normalize(v), up), -1.0f, 1.0f));
    const float wanted =
        std::clamp(elevation + angles.y, -pi / 2 + pole, std::max(pi / 2 - pole, elevation));
    const vec3 sideways = normalize(cross(v, up));
    return rotated(rotated(v, sideways, wanted - elevation), up, angles.x);
}

}  // namespace

Camera orbited(const Camera& camera, const vec2& drag) {
    Camera out = camera;
    out.eye = camera.at - turned(camera, camera.at - camera.eye, drag * -full_turn);
    return out;
}

Camera turned(const Camera& camera, const vec2& drag) {
    Camera out = camera;
    out.at = camera.eye + turned(camera, camera.at - camera.eye, drag * -full_turn);
    return out;
}

Camera panned(const Camera& camera, const vec2& drag) {
    const Axes axes = axes_of(camera);
    const float height =
        2 * length(camera.at - camera.eye) * std::tan(glm::radians(camera.fov_y) / 2);
    const vec3 by = -height * (drag.x * axes.right + drag.y * axes.up);
    Camera out = camera;
    out.eye += by;
    out.at += by;
    return out;
}

Camera approached(const Camera& camera, float factor) {
    // Nearer than this, rounding would turn the view.
    const float nearest = 1e-3f * (1 + length(camera.at));
    const vec3 away = camera.eye - camera.at;
    Camera out = camera;
    out.eye = camera.at + away * std::max(1 / factor, nearest / length(away));
    return out;
}

Camera flown(const Camera& camera, const vec3& by) {
    const Axes axes = axes_of(camera);
    const vec3 step = by.x * axes.right + by.y * normalize(camera.up) + by.z * axes.forward;
    Camera out = camera;
    out.eye += step;
    out.at += step;
    return out;
}

Ray eye_ray(const Camera& camera, const vec2& point) {
    const Axes axes = axes_of(camera);
    const float half = std::tan(glm::radians(camera.fov_y) / 2);
    return {.org = camera.eye,
            .dir = normalize(axes.forward + half * (point.x * axes.right + point.y * axes.up))};
}

std::optional<vec2> projected(const Camera& camera, const vec3& p) {
    const Axes axes = axes_of(camera);
    const vec3 to = p - camera.eye;
    const float distance = dot(to, axes.forward) * std::tan(glm::radians(camera.fov_y) / 2);
    if (!(distance > 0)) return std::nullopt;
    return vec2(dot(to, axes.right), dot(to, axes.up)) / distance;
}

}  // namespace tessera
