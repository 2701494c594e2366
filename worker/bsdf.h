// How surfaces scatter light: a closed set. A material becomes a Bsdf once per hit, and the Bsdf is
// what every light evaluates (Wald 2004, 13.3.3).
#pragma once

#include <cstdint>
#include <optional>

#include "common/scene.h"
#include "worker/sampling.h"

namespace tessera {

struct Bsdf {
    enum class Kind : std::uint8_t { lambert, mirror };

    Kind kind = Kind::lambert;
    vec3 reflectance{0};  ///< in [0, 1]

    bool specular() const { return kind == Kind::mirror; }
};

/// Metal smoother than this is a mirror; everything else is taken as Lambert.
inline bool is_mirror(float metallic, float roughness) {
    return metallic >= 0.9f && roughness < 0.1f;
}

inline Bsdf make_bsdf(const vec3& base_color, float metallic, float roughness) {
    const auto kind = is_mirror(metallic, roughness) ? Bsdf::Kind::mirror : Bsdf::Kind::lambert;
    return {kind, glm::clamp(base_color, 0.0f, 1.0f)};
}

/// Value of the BRDF, 1/sr, without the cosine; wo and wi point away from the surface of normal n.
inline vec3 eval(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi) {
    const bool reflects = !bsdf.specular() && dot(n, wo) > 0 && dot(n, wi) > 0;
    return reflects ? bsdf.reflectance / pi : vec3(0);
}

/// Density of sample() per solid angle; 0 for a mirror.
inline float pdf(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi) {
    return !bsdf.specular() && dot(n, wo) > 0 ? cosine_hemisphere_pdf(dot(n, wi)) : 0;
}

struct BsdfSample {
    vec3 wi{0};
    vec3 weight{0};  ///< BRDF * cosine / pdf
    float pdf = 0;   ///< per solid angle; 0 for a mirror
};

/// Nothing when wo is below the surface.
inline std::optional<BsdfSample> sample(const Bsdf& bsdf, const vec3& n, const vec3& wo,
                                        const vec2& u) {
    if (!(dot(n, wo) > 0)) return {};
    if (bsdf.specular()) return BsdfSample{2 * dot(n, wo) * n - wo, bsdf.reflectance, 0};
    const vec3 local = sample_cosine_hemisphere(u);
    return BsdfSample{Frame(n).world_from_local(local), bsdf.reflectance,
                      cosine_hemisphere_pdf(local.z)};
}

}  // namespace tessera
