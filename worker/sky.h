// Light from infinitely far away: one colour or a picture by latitude and longitude, chosen from by
// what each texel brings (Pharr, Jakob and Humphreys, "Physically Based Rendering", 2016, 14.2.4).
// We differ in weighing each texel by the exact mean of the bilinear interpolation over it, so that
// no direction that shines is left out and none is favoured.
#pragma once

#include <vector>

#include "common/scene.h"
#include "worker/sampling.h"

namespace tessera {

class Sky {
public:
    Sky() = default;
    /// `picture`: the environment's texture; null for one colour all over.
    Sky(const Environment& environment, const Texture* picture);

    /// Whether it is black.
    bool empty() const { return rows_.empty(); }
    /// Radiance that comes from the unit direction `dir`.
    vec3 radiance(const vec3& dir) const;
    /// Irradiance that it sends through a plane, over all of both sides, as a mean of channels.
    float mean_irradiance() const { return mean_irradiance_; }

    struct Direction {
        vec3 dir{0};    ///< unit, to where the light comes from
        float pdf = 0;  ///< per solid angle
    };
    /// Call only when not empty.
    Direction sample(const vec2& u) const;
    float pdf(const vec3& dir) const;

private:
    vec2 texcoord(const vec3& dir) const;
    float density(std::uint32_t row, std::uint32_t column, float sine) const;

    Texture picture_;
    vec3 scale_{0};
    float rotation_ = 0;
    Distribution rows_;
    std::vector<Distribution> columns_;  ///< of each row
    float mean_irradiance_ = 0;
};

}  // namespace tessera
