// How surfaces scatter light: a closed set of lobes. A material becomes a Bsdf once per hit, as
// seen from one direction, and the Bsdf is what every light evaluates (Wald 2004, 13.3.3).
//
// Lambert; GGX reflection with height-correlated shadowing (Heitz, "Understanding the
// Masking-Shadowing Function in Microfacet-Based BRDFs", 2014), sampled by visible normals (Heitz,
// "Sampling the GGX Distribution of Visible Normals", 2018), Schlick's Fresnel term; mirrors and
// glass, smooth or rough (Walter, Marschner, Li and Torrance, "Microfacet Models for Refraction
// through Rough Surfaces", 2007). Rough glass is followed like smooth glass, by a ray that meets
// one of its microfacets: it has no value to be evaluated. Under a glossy coat the diffuse lobe
// gets what the coat leaves, coming and going (Kelemen and Szirmay-Kalos, "A Microfacet Based
// Coupled Specular-Matte BRDF Model", 2001): white coated surfaces reflect all light. We differ
// from glTF's example in that only, and like it follow no second reflection between microfacets, so
// rough metal is a little dark.
#pragma once

#include <cstdint>
#include <optional>

#include "common/scene.h"
#include "worker/sampling.h"

namespace tessera {

/// The lobes that scatter into more than single directions. Broad ones are smooth enough to be
/// lit by a few virtual point lights, narrow ones want rays.
enum class Lobes : std::uint8_t { broad = 1, narrow = 2, all = 3 };

constexpr bool includes(Lobes set, Lobes lobe) {
    return (std::uint8_t(set) & std::uint8_t(lobe)) != 0;
}

/// What scatters light at one point, as seen from a direction `wo`: with that wo alone it may be
/// evaluated and sampled.
struct Bsdf {
    /// Ideal reflection and refraction, which have no finite value: of mirrors, of smooth glass,
    /// and of each microfacet of rough glass.
    enum class Delta : std::uint8_t { none, mirror, glass, thin_glass };

    vec3 diffuse{0};          ///< share of light from wo that the diffuse lobe scatters, in [0, 1]
    vec3 specular{0};         ///< the same of the GGX lobe
    vec3 f0{0};               ///< GGX: reflectance of a microfacet seen straight on
    float f90 = 0;            ///< and at grazing angles
    float alpha = 1;          ///< GGX roughness
    float diffuse_scale = 1;  ///< diffuse under a coat: one over its mean share of light
    float delta_share = 0;    ///< chance that light meets the ideal lobes rather than the others
    vec3 delta_tint{0};       ///< mirror: reflectance; glass: what a refraction lets through
    float eta = 1;            ///< glass: index of refraction on wo's side over the other's
    float delta_alpha = 0;    ///< GGX roughness of glass; 0: smooth
    bool glossy = false;      ///< has the GGX lobe
    Delta delta = Delta::none;

    /// GGX smoother than this is narrow: traced, not lit by VPLs.
    static constexpr float narrow_alpha = 0.2f;

    bool is_lambert() const { return !glossy && delta == Delta::none; }
    /// Nothing but ideal reflection or refraction.
    bool is_delta() const { return delta_share == 1; }
    bool has_narrow() const { return glossy && alpha < narrow_alpha; }
    /// Whether broad lobes are not all there is.
    bool has_rest() const { return has_narrow() || delta != Delta::none; }
    /// Share of light from wo that `lobes` scatter.
    vec3 reflectance(Lobes lobes = Lobes::broad) const {
        vec3 sum = includes(lobes, Lobes::broad) ? diffuse : vec3(0);
        if (glossy && includes(lobes, has_narrow() ? Lobes::narrow : Lobes::broad)) sum += specular;
        return sum;
    }
};

/// A material's values at one point.
struct SurfaceLook {
    vec3 base_color{0.8f};
    float metallic = 0;
    float roughness = 1;
    float specular = 0;  ///< strength of the coat of what is no metal
    float ior = 1.5f;
    float transmission = 0;  ///< share of what the coat lets through that passes as through glass
    bool thin_walled = false;
};

/// Metal smoother than this is a mirror.
inline bool is_mirror(float metallic, float roughness) {
    return metallic >= 0.9f && roughness < 0.1f;
}

/// Nothing but a diffuse lobe: what most surfaces of most scenes are.
inline Bsdf lambert_bsdf(const vec3& base_color) {
    Bsdf b;
    b.diffuse = glm::clamp(base_color, 0.0f, 1.0f);
    return b;
}

/// `cos_o`: between wo and the shading normal; `outside`: whether wo is on the surface's front.
/// Colours are clamped to [0, 1].
Bsdf make_bsdf(const SurfaceLook& look, float cos_o, bool outside = true);

/// Value of the BRDF, 1/sr, without the cosine; wo and wi point away from the surface of normal n.
vec3 eval(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi,
          Lobes lobes = Lobes::all);

/// Density of sample() per solid angle.
float pdf(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi,
          Lobes lobes = Lobes::all);

/// eval() against that of a Lambert surface which scatters the same share of light. 1 where `lobes`
/// scatter nothing.
vec3 glossy_shape(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi, Lobes lobes);
/// The same of any surface.
inline vec3 shape(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi,
                  Lobes lobes = Lobes::broad) {
    return bsdf.glossy ? glossy_shape(bsdf, n, wo, wi, lobes) : vec3(1);
}

struct BsdfSample {
    vec3 wi{0};
    vec3 weight{0};  ///< BRDF * cosine / pdf
    float pdf = 0;   ///< per solid angle; 0 for ideal reflection and refraction
    /// What radiance along wi is multiplied with beyond `weight` when it comes out of another
    /// medium; flux is not.
    float radiance_scale = 1;
};

/// Nothing when wo is below the surface or no light comes that way.
std::optional<BsdfSample> sample(const Bsdf& bsdf, const vec3& n, const vec3& wo, float u_lobe,
                                 const vec2& u, Lobes lobes = Lobes::all);

/// Chooses between reflection and refraction by Fresnel's law. Call only when there are ideal
/// lobes; their share is part of the weight. `u_facet` chooses a microfacet of rough glass. Light
/// that meets a second one is lost.
std::optional<BsdfSample> sample_delta(const Bsdf& bsdf, const vec3& n, const vec3& wo, float u,
                                       const vec2& u_facet = vec2(0));

/// Reflectance of a smooth dielectric; `eta`: index of refraction on this side over the other's.
float fresnel_dielectric(float cos_i, float eta);

/// Share of the light from a direction of cosine `cosine` that a GGX lobe of roughness `alpha`
/// reflects: f0 * x + f90 * y.
vec2 directional_albedo(float cosine, float alpha);

}  // namespace tessera
