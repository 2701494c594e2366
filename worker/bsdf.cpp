#include "worker/bsdf.h"

#include <array>

namespace tessera {
namespace {

/// Smoother GGX is not told apart from this; floats could not follow it.
constexpr float least_alpha = 1e-3f;

float pow5(float x) { return x * x * x * x * x; }

/// The root that masking and shadowing share.
float ggx_root(float cosine, float alpha) {
    return std::sqrt(alpha * alpha + (1 - alpha * alpha) * cosine * cosine);
}

/// Share of microfacets that are seen from a direction of that cosine.
float masking(float cosine, float alpha) { return 2 * cosine / (cosine + ggx_root(cosine, alpha)); }

/// Height-correlated masking and shadowing over 4 cos_o cos_i.
float visibility(float cos_o, float cos_i, float alpha) {
    return 0.5f / (cos_i * ggx_root(cos_o, alpha) + cos_o * ggx_root(cos_i, alpha));
}

float ggx_density(const vec3& n, const vec3& h, float alpha) {
    // One minus the squared cosine would lose all digits on smooth surfaces.
    const float cosine = dot(n, h);
    const vec3 sine = cross(n, h);
    const float d = cosine * cosine * alpha * alpha + dot(sine, sine);
    return alpha * alpha / (pi * d * d);
}

/// Heitz 2018: the hemisphere's projection along the stretched view.
vec3 sample_visible_normal(const vec3& wo, float alpha, const vec2& u) {
    const vec3 v = normalize(vec3(alpha * wo.x, alpha * wo.y, wo.z));
    const float l2 = v.x * v.x + v.y * v.y;
    const vec3 s = l2 > 0 ? vec3(-v.y, v.x, 0) / std::sqrt(l2) : vec3(1, 0, 0);
    const vec2 d = sample_disc(u);
    const float half = 0.5f * (1 + v.z);
    const float y = (1 - half) * std::sqrt(std::max(0.0f, 1 - d.x * d.x)) + half * d.y;
    const float z = std::sqrt(std::max(0.0f, 1 - d.x * d.x - y * y));
    const vec3 h = d.x * s + y * cross(v, s) + z * v;
    return normalize(vec3(alpha * h.x, alpha * h.y, std::max(h.z, 1e-6f)));
}

/// The albedo of GGX lobes by angle and roughness, and its mean over angles.
class AlbedoTable {
public:
    AlbedoTable() {
        for (int r = 0; r < size; ++r) {
            const float alpha = alpha_of(float(r) / (size - 1));
            for (int c = 0; c < size; ++c) at_[r][c] = integrate(cosine_of(c), alpha);
            for (int c = 0; c < mean_steps; ++c) {
                const float cosine = (float(c) + 0.5f) / mean_steps;
                mean_[r] += interpolate(at_[r], cosine) * (2 * cosine / mean_steps);
            }
        }
    }

    vec2 albedo(float cosine, float alpha) const {
        const Row row = row_of(alpha);
        return glm::mix(interpolate(at_[row.index], cosine),
                        interpolate(at_[row.index + 1], cosine), row.share);
    }
    vec2 mean(float alpha) const {
        const Row row = row_of(alpha);
        return glm::mix(mean_[row.index], mean_[row.index + 1], row.share);
    }

private:
    static constexpr int size = 32;
    static constexpr int mean_steps = 256;
    static constexpr std::uint32_t samples = 256;
    using Angles = std::array<vec2, size>;

    struct Row {
        int index;
        float share;
    };

    // Rows are spaced by the root of alpha, angles closer where they graze.
    static float alpha_of(float roughness) { return std::max(roughness * roughness, least_alpha); }
    static float cosine_of(int i) {
        return std::max(float(i * i) / float((size - 1) * (size - 1)), 1e-4f);
    }

    static Row row_of(float alpha) {
        const float x = std::sqrt(std::clamp(alpha, 0.0f, 1.0f)) * (size - 1);
        const int index = std::min(int(x), size - 2);
        return {index, x - float(index)};
    }
    static vec2 interpolate(const Angles& row, float cosine) {
        const float x = std::sqrt(std::clamp(cosine, 0.0f, 1.0f)) * (size - 1);
        const int index = std::min(int(x), size - 2);
        return glm::mix(row[std::size_t(index)], row[std::size_t(index + 1)], x - float(index));
    }
    static vec2 integrate(float cosine, float alpha) {
        const vec3 wo(std::sqrt(std::max(0.0f, 1 - cosine * cosine)), 0, cosine);
        vec2 sum(0);
        for (std::uint32_t i = 0; i < samples; ++i) {
            const vec3 h = sample_visible_normal(wo, alpha, sobol_point(i, 0, 0));
            const float cos_h = dot(wo, h);
            const float cos_i = 2 * cos_h * h.z - wo.z;
            if (!(cos_i > 0)) continue;
            const float kept =
                visibility(cosine, cos_i, alpha) * 4 * cosine * cos_i / masking(cosine, alpha);
            const float schlick = pow5(1 - cos_h);
            sum += kept * vec2(1 - schlick, schlick);
        }
        return sum / float(samples);
    }

    std::array<Angles, size> at_;
    std::array<vec2, size> mean_{};
};

const AlbedoTable& albedo_table() {
    static const AlbedoTable table;
    return table;
}

/// What the coat lets through to the diffuse lobe.
float coat_leaves(const Bsdf& b, const vec2& albedo) {
    return std::max(1 - max_component(b.f0) * albedo.x - b.f90 * albedo.y, 0.0f);
}

vec3 ggx(const Bsdf& b, const vec3& n, const vec3& wo, const vec3& wi) {
    const vec3 h = normalize(wo + wi);
    const vec3 fresnel = b.f0 + (b.f90 - b.f0) * pow5(1 - std::min(dot(wo, h), 1.0f));
    return fresnel * ((1 - b.delta_share) * ggx_density(n, h, b.alpha) *
                      visibility(dot(n, wo), dot(n, wi), b.alpha));
}

float ggx_pdf(const Bsdf& b, const vec3& n, const vec3& wo, const vec3& wi) {
    const float cosine = dot(n, wo);
    return masking(cosine, b.alpha) * ggx_density(n, normalize(wo + wi), b.alpha) / (4 * cosine);
}

bool with_diffuse(Lobes lobes) { return includes(lobes, Lobes::broad); }

bool with_ggx(const Bsdf& b, Lobes lobes) {
    return b.glossy && includes(lobes, b.has_narrow() ? Lobes::narrow : Lobes::broad);
}

/// Chance of sampling the GGX lobe rather than the diffuse one.
float ggx_chance(const Bsdf& b, Lobes lobes) {
    if (!with_ggx(b, lobes)) return 0;
    const float s = mean_component(b.specular);
    const float d = with_diffuse(lobes) ? mean_component(b.diffuse) : 0;
    return d > 0 ? s / (s + d) : 1;
}

/// Adds the GGX coat, and takes its share from what lies below.
void add_coat(const SurfaceLook& look, const vec3& base, float cos_o, Bsdf& b) {
    const float ratio = (look.ior - 1) / (look.ior + 1);
    const float metallic = std::clamp(look.metallic, 0.0f, 1.0f);
    const float strength = std::clamp(look.specular, 0.0f, 1.0f);
    b.glossy = true;
    b.f0 = glm::mix(vec3(strength * ratio * ratio), base, metallic);
    b.f90 = glm::mix(strength, 1.0f, metallic);
    b.alpha = std::clamp(look.roughness * look.roughness, least_alpha, 1.0f);
    const vec2 albedo = albedo_table().albedo(cos_o, b.alpha);
    b.specular = b.f0 * albedo.x + b.f90 * albedo.y;
    b.diffuse *= (1 - metallic) * coat_leaves(b, albedo);
    b.diffuse_scale = 1 / std::max(coat_leaves(b, albedo_table().mean(b.alpha)), 1e-6f);
}

vec3 visible_facet(const vec3& n, const vec3& wo, float alpha, const vec2& u) {
    const Frame frame(n);
    return frame.world_from_local(sample_visible_normal(frame.local_from_world(wo), alpha, u));
}

/// What rough glass sends along `s`, `cosine` from the normal of the side that it must leave on:
/// what other facets do not catch.
std::optional<BsdfSample> unshadowed(const Bsdf& bsdf, float cosine, BsdfSample s) {
    if (!(cosine > 0)) return {};
    s.weight *= masking(cosine, bsdf.delta_alpha);
    return s;
}

/// Lets a share of the light meet glass in place of the other lobes.
void add_glass(const SurfaceLook& look, const vec3& base, bool outside, Bsdf& b) {
    const float share =
        std::clamp(look.transmission, 0.0f, 1.0f) * (1 - std::clamp(look.metallic, 0.0f, 1.0f));
    if (!(share > 0)) return;
    b.delta = look.thin_walled ? Bsdf::Delta::thin_glass : Bsdf::Delta::glass;
    b.delta_share = share;
    b.delta_tint = base;
    b.eta = outside || look.thin_walled ? 1 / look.ior : look.ior;
    const float alpha = std::min(look.roughness * look.roughness, 1.0f);
    b.delta_alpha = alpha > least_alpha ? alpha : 0;
    b.glossy &= share < 1;
    b.diffuse *= 1 - share;
    b.specular *= 1 - share;
}

}  // namespace

vec2 directional_albedo(float cosine, float alpha) { return albedo_table().albedo(cosine, alpha); }

float fresnel_dielectric(float cos_i, float eta) {
    const float sin2_t = eta * eta * (1 - cos_i * cos_i);
    if (sin2_t >= 1) return 1;
    const float cos_t = std::sqrt(1 - sin2_t);
    const float parallel = (cos_i - eta * cos_t) / (cos_i + eta * cos_t);
    const float across = (eta * cos_i - cos_t) / (eta * cos_i + cos_t);
    return 0.5f * (parallel * parallel + across * across);
}

Bsdf make_bsdf(const SurfaceLook& look, float cos_o, bool outside) {
    const vec3 base = glm::clamp(look.base_color, 0.0f, 1.0f);
    Bsdf b;
    if (is_mirror(look.metallic, look.roughness)) {
        b.delta = Bsdf::Delta::mirror;
        b.delta_share = 1;
        b.delta_tint = base;
        return b;
    }
    b.diffuse = base;
    if (look.metallic > 0 || look.specular > 0) add_coat(look, base, cos_o, b);
    if (look.transmission > 0) add_glass(look, base, outside, b);
    return b;
}

vec3 eval(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi, Lobes lobes) {
    const float cos_i = dot(n, wi);
    if (!(dot(n, wo) > 0 && cos_i > 0)) return vec3(0);
    if (!bsdf.glossy) return with_diffuse(lobes) ? bsdf.diffuse / pi : vec3(0);
    vec3 value(0);
    if (with_diffuse(lobes) && bsdf.diffuse != vec3(0))
        value = bsdf.diffuse * (coat_leaves(bsdf, albedo_table().albedo(cos_i, bsdf.alpha)) *
                                bsdf.diffuse_scale / pi);
    if (with_ggx(bsdf, lobes)) value += ggx(bsdf, n, wo, wi);
    return value;
}

float pdf(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi, Lobes lobes) {
    const float cos_i = dot(n, wi);
    if (!(dot(n, wo) > 0 && cos_i > 0)) return 0;
    const float chance = ggx_chance(bsdf, lobes);
    float density = (1 - chance) * cosine_hemisphere_pdf(cos_i);
    if (chance > 0) density += chance * ggx_pdf(bsdf, n, wo, wi);
    return density;
}

vec3 glossy_shape(const Bsdf& bsdf, const vec3& n, const vec3& wo, const vec3& wi, Lobes lobes) {
    const vec3 reflectance = bsdf.reflectance(lobes);
    const vec3 value = pi * eval(bsdf, n, wo, wi, lobes);
    vec3 ratio(1);
    for (int c = 0; c < 3; ++c)
        if (reflectance[c] > 0) ratio[c] = value[c] / reflectance[c];
    return ratio;
}

std::optional<BsdfSample> sample(const Bsdf& bsdf, const vec3& n, const vec3& wo, float u_lobe,
                                 const vec2& u, Lobes lobes) {
    if (!(dot(n, wo) > 0)) return {};
    const Frame frame(n);
    if (bsdf.is_lambert()) {
        const vec3 local = sample_cosine_hemisphere(u);
        return BsdfSample{frame.world_from_local(local), bsdf.diffuse,
                          cosine_hemisphere_pdf(local.z)};
    }
    BsdfSample s;
    if (u_lobe < ggx_chance(bsdf, lobes)) {
        const vec3 local = frame.local_from_world(wo);
        const vec3 h = sample_visible_normal(local, bsdf.alpha, u);
        s.wi = frame.world_from_local(2 * dot(local, h) * h - local);
    } else {
        s.wi = frame.world_from_local(sample_cosine_hemisphere(u));
    }
    s.pdf = pdf(bsdf, n, wo, s.wi, lobes);
    if (!(s.pdf > 0) || !std::isfinite(s.pdf)) return {};
    s.weight = eval(bsdf, n, wo, s.wi, lobes) * (dot(n, s.wi) / s.pdf);
    return s;
}

std::optional<BsdfSample> sample_delta(const Bsdf& bsdf, const vec3& n, const vec3& wo, float u,
                                       const vec2& u_facet) {
    if (!(dot(n, wo) > 0)) return {};
    const bool rough = bsdf.delta_alpha > 0;
    const vec3 h = rough ? visible_facet(n, wo, bsdf.delta_alpha, u_facet) : n;
    const float cosine = std::min(dot(h, wo), 1.0f);
    if (!(cosine > 0)) return {};
    const vec3 reflected = 2 * cosine * h - wo;
    if (bsdf.delta == Bsdf::Delta::mirror) return BsdfSample{reflected, bsdf.delta_tint, 0};
    const bool thin = bsdf.delta == Bsdf::Delta::thin_glass;
    float reflectance = fresnel_dielectric(cosine, bsdf.eta);
    // Light goes to and fro between the two sides of a pane: the sum of the geometric series.
    if (thin) reflectance = 2 * reflectance / (1 + reflectance);
    BsdfSample s{reflected, vec3(bsdf.delta_share), 0};
    if (u < reflectance) return rough ? unshadowed(bsdf, dot(n, s.wi), s) : s;
    s.weight *= bsdf.delta_tint;
    if (thin) {
        // What a rough pane lets through spreads as what it reflects.
        s.wi = rough ? reflected - 2 * dot(reflected, n) * n : -wo;
    } else {
        const float cos_t =
            std::sqrt(std::max(0.0f, 1 - bsdf.eta * bsdf.eta * (1 - cosine * cosine)));
        s.wi = normalize((bsdf.eta * cosine - cos_t) * h - bsdf.eta * wo);
        s.radiance_scale = bsdf.eta * bsdf.eta;
    }
    return rough ? unshadowed(bsdf, -dot(n, s.wi), s) : s;
}

}  // namespace tessera
