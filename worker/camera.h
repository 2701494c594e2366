// The pinhole camera.
#pragma once

#include <optional>

#include "common/image.h"
#include "common/scene.h"

namespace tessera {

class Pinhole {
public:
    /// A camera that looks nowhere (eye == at, or `up` along the view) looks along -z or takes
    /// another up.
    Pinhole(const Camera& camera, ImageSize size);

    /// The ray through `raster`, in pixels from the top left; its direction is a unit vector.
    Ray ray(const vec2& raster) const;
    /// Where `p` is seen, in pixels as in ray(); nothing unless it is in front of the eye.
    std::optional<vec2> raster(const vec3& p) const;
    /// Width of a pixel at unit distance in the middle of the picture.
    float pixel_width() const { return length(right_); }

private:
    vec3 eye_;
    vec3 forward_;  ///< unit
    vec2 middle_;   ///< of the picture, in pixels
    vec3 corner_;   ///< from the eye to the picture's top left, at unit distance
    vec3 right_;    ///< per pixel
    vec3 down_;     ///< per pixel
};

inline Pinhole::Pinhole(const Camera& camera, ImageSize size)
    : eye_(camera.eye), middle_(0.5f * vec2(size.width, size.height)) {
    const auto usable = [](const vec3& v) { return dot(v, v) > 1e-20f && is_finite(v); };
    const vec3 view = camera.at - camera.eye;
    forward_ = usable(view) ? normalize(view) : vec3(0, 0, -1);
    vec3 side = cross(forward_, camera.up);
    if (!usable(side)) side = Frame(forward_).s;
    side = normalize(side);
    const float half_height = std::tan(glm::radians(std::clamp(camera.fov_y, 0.01f, 179.0f)) / 2);
    const float pixel = 2 * half_height / float(size.height);
    right_ = pixel * side;
    down_ = pixel * cross(forward_, side);
    corner_ = forward_ - middle_.x * right_ - middle_.y * down_;
}

inline Ray Pinhole::ray(const vec2& raster) const {
    return {eye_, 0, normalize(corner_ + raster.x * right_ + raster.y * down_), infinity};
}

inline std::optional<vec2> Pinhole::raster(const vec3& p) const {
    const vec3 v = p - eye_;
    const float depth = dot(v, forward_);
    if (!(depth > 0)) return {};
    const vec2 at(dot(v, right_) / dot(right_, right_), dot(v, down_) / dot(down_, down_));
    return at / depth + middle_;
}

}  // namespace tessera
