// Laws of the BRDFs: energy, reciprocity, densities that integrate to one, samples that weigh what
// the value says; Snell and Fresnel for glass.
#include "worker/bsdf.h"

#include <gtest/gtest.h>

#include <random>

namespace tessera {
namespace {

const vec3 up(0, 0, 1);

vec3 at_cosine(float cosine, float phi = 0.3f) {
    const float sine = std::sqrt(1 - cosine * cosine);
    return {sine * std::cos(phi), sine * std::sin(phi), cosine};
}

SurfaceLook plastic(float roughness) {
    return {.base_color = vec3(1), .roughness = roughness, .specular = 1};
}
SurfaceLook metal(float roughness) {
    return {.base_color = {1, 0.7f, 0.3f}, .metallic = 1, .roughness = roughness};
}

std::vector<SurfaceLook> looks() {
    std::vector<SurfaceLook> all;
    for (const float r : {0.12f, 0.3f, 0.5f, 1.0f}) {
        all.push_back(plastic(r));
        all.push_back(metal(r));
        SurfaceLook half = plastic(r);
        half.metallic = 0.4f;
        half.base_color = {0.2f, 0.9f, 0.5f};
        all.push_back(half);
    }
    all.push_back({.base_color = vec3(0.5f)});
    return all;
}

/// Mean weight of samples: the share of light reflected.
vec3 albedo_by_sampling(const Bsdf& bsdf, const vec3& wo, std::uint32_t samples) {
    vec3 sum(0);
    for (std::uint32_t i = 0; i < samples; ++i) {
        Sampler sampler(i, 7);
        const float u_lobe = sampler.next().x;
        if (const auto s = sample(bsdf, up, wo, u_lobe, sampler.next())) sum += s->weight;
    }
    return sum / float(samples);
}

TEST(Bsdf, WhiteCoatedSurfacesReflectAllLight) {
    for (const float roughness : {0.05f, 0.3f, 0.5f, 0.8f, 1.0f})
        for (const float cosine : {0.1f, 0.4f, 0.9f, 1.0f}) {
            const vec3 wo = at_cosine(cosine);
            const vec3 share = albedo_by_sampling(make_bsdf(plastic(roughness), cosine), wo, 4096);
            EXPECT_NEAR(share.x, 1, 0.012f) << roughness << " " << cosine;
        }
}

TEST(Bsdf, NothingReflectsMoreLightThanItGets) {
    for (const SurfaceLook& look : looks())
        for (const float cosine : {0.02f, 0.3f, 0.7f, 1.0f}) {
            const Bsdf bsdf = make_bsdf(look, cosine);
            const vec3 share = albedo_by_sampling(bsdf, at_cosine(cosine), 1024);
            EXPECT_LT(max_component(share), 1.02f);
            // What it says of itself is what it does.
            for (int c = 0; c < 3; ++c)
                EXPECT_NEAR(share[c], bsdf.reflectance(Lobes::all)[c], 0.025f) << look.roughness;
        }
}

TEST(Bsdf, AlbedoAgreesWithQuadrature) {
    // Over wi by brute force, where the lobe is broad enough for a grid.
    for (const float alpha : {0.25f, 0.6f, 1.0f}) {
        const float cosine = 0.6f;
        SurfaceLook look = metal(std::sqrt(alpha));
        look.base_color = vec3(1);
        const Bsdf bsdf = make_bsdf(look, cosine);
        const vec3 wo = at_cosine(cosine);
        constexpr int n = 200;
        double sum = 0;
        for (int i = 0; i < n; ++i)
            for (int j = 0; j < n; ++j) {
                const vec3 wi = at_cosine((float(i) + 0.5f) / n, 2 * pi * float(j) / n);
                sum += double(eval(bsdf, up, wo, wi).x * wi.z) * 2 * double(pi) / (n * n);
            }
        const vec2 albedo = directional_albedo(cosine, alpha);
        EXPECT_NEAR(albedo.x + albedo.y, sum, 0.005);
    }
}

TEST(Bsdf, LightMayGoEitherWay) {
    for (const SurfaceLook& look : looks())
        for (const float a : {0.2f, 0.6f, 1.0f})
            for (const float b : {0.3f, 0.9f}) {
                const vec3 wo = at_cosine(a), wi = at_cosine(b, 2);
                const vec3 there = eval(make_bsdf(look, a), up, wo, wi);
                const vec3 back = eval(make_bsdf(look, b), up, wi, wo);
                for (int c = 0; c < 3; ++c)
                    EXPECT_NEAR(there[c], back[c], 1e-4f * there[c] + 1e-7f);
            }
}

TEST(Bsdf, SamplesWeighWhatTheValueSays) {
    for (const SurfaceLook& look : looks()) {
        const vec3 wo = at_cosine(0.5f);
        const Bsdf bsdf = make_bsdf(look, wo.z);
        for (const Lobes lobes : {Lobes::broad, Lobes::narrow, Lobes::all})
            for (std::uint32_t i = 0; i < 64; ++i) {
                if (bsdf.reflectance(lobes) == vec3(0)) continue;
                const auto s = sample(bsdf, up, wo, float(i) / 64, sobol_point(i, 1, 3), lobes);
                if (!s) continue;
                EXPECT_NEAR(s->pdf, pdf(bsdf, up, wo, s->wi, lobes), 1e-4f * s->pdf);
                const vec3 weight = eval(bsdf, up, wo, s->wi, lobes) * s->wi.z / s->pdf;
                for (int c = 0; c < 3; ++c) EXPECT_NEAR(s->weight[c], weight[c], 1e-3f);
                const vec3 again = shape(bsdf, up, wo, s->wi, lobes) * bsdf.reflectance(lobes) / pi;
                const vec3 value = eval(bsdf, up, wo, s->wi, lobes);
                for (int c = 0; c < 3; ++c) EXPECT_NEAR(again[c], value[c], 1e-4f * value[c]);
            }
    }
}

TEST(Bsdf, LobesAddUp) {
    const vec3 wo = at_cosine(0.5f), wi = at_cosine(0.6f, 3.3f);
    for (const SurfaceLook& look : looks()) {
        const Bsdf bsdf = make_bsdf(look, wo.z);
        const vec3 sum =
            eval(bsdf, up, wo, wi, Lobes::broad) + eval(bsdf, up, wo, wi, Lobes::narrow);
        const vec3 all = eval(bsdf, up, wo, wi);
        for (int c = 0; c < 3; ++c) EXPECT_NEAR(sum[c], all[c], 1e-5f * all[c]);
    }
}

TEST(Bsdf, GlassBendsLightAsSnellSaysAndKeepsIt) {
    SurfaceLook look{.base_color = vec3(1), .roughness = 0, .transmission = 1};
    for (const bool outside : {true, false})
        for (const float cosine : {0.05f, 0.5f, 0.74f, 0.76f, 1.0f}) {
            const vec3 wo = at_cosine(cosine);
            const Bsdf bsdf = make_bsdf(look, cosine, outside);
            EXPECT_TRUE(bsdf.is_delta());
            const float reflectance = fresnel_dielectric(cosine, bsdf.eta);
            const bool total = !outside && std::sqrt(1 - cosine * cosine) * 1.5f >= 1;
            EXPECT_EQ(reflectance == 1, total) << cosine;
            const auto reflected = sample_delta(bsdf, up, wo, 0);
            EXPECT_NEAR(reflected->wi.z, cosine, 1e-6f);
            if (total) continue;
            const auto refracted = sample_delta(bsdf, up, wo, 0.9999f);
            EXPECT_LT(refracted->wi.z, 0);
            EXPECT_NEAR(length(refracted->wi), 1, 1e-5f);
            EXPECT_NEAR(length(vec2(refracted->wi)), bsdf.eta * length(vec2(wo)), 1e-5f);
            EXPECT_EQ(refracted->weight, vec3(1));
            // The way back has the same Fresnel factor and undoes the scale of radiance.
            const Bsdf back = make_bsdf(look, -refracted->wi.z, !outside);
            EXPECT_NEAR(fresnel_dielectric(-refracted->wi.z, back.eta), reflectance, 1e-4f);
            EXPECT_NEAR(refracted->radiance_scale * back.eta * back.eta, 1, 1e-5f);
        }
}

/// Share of light from wo that rough glass sends into each of `bins` equal steps of wi.z, by Walter
/// et al.'s formulas (2007, equations 13 to 21), integrated.
std::vector<double> walter_shares(const vec3& wo, float alpha, float eta, std::size_t bins) {
    const auto g1 = [&](float c) {
        return 2 * c / (c + std::sqrt(alpha * alpha + (1 - alpha * alpha) * c * c));
    };
    std::vector<double> shares(bins);
    constexpr int rows = 1600, columns = 800;
    for (int row = 0; row < rows; ++row) {
        for (int column = 0; column < columns; ++column) {
            const float z = 2 * (float(row) + 0.5f) / rows - 1;
            const float phi = 2 * pi * (float(column) + 0.5f) / columns;
            const float r = std::sqrt(1 - z * z);
            const vec3 wi(r * std::cos(phi), r * std::sin(phi), z);
            // `eta`: index on wo's side over the other's.
            const bool reflects = z > 0;
            const vec3 sum = reflects ? wo + wi : eta * wo + wi;
            const vec3 h = normalize(sum.z > 0 ? sum : -sum);
            const float cos_o = dot(wo, h), cos_i = dot(wi, h);
            if (!(h.z > 0 && cos_o > 0 && (cos_i > 0) == reflects)) continue;
            const float fresnel = fresnel_dielectric(cos_o, eta);
            const float d =
                alpha * alpha / (pi * std::pow(h.z * h.z * (alpha * alpha - 1) + 1, 2.0f));
            const float visible = g1(wo.z) * cos_o * d / wo.z;
            const float jacobian =
                reflects ? 1 / (4 * cos_o) : -cos_i / std::pow(eta * cos_o + cos_i, 2.0f);
            const float share =
                visible * jacobian * g1(std::abs(z)) * (reflects ? fresnel : 1 - fresnel);
            shares[std::size_t(float(bins) * (z + 1) / 2)] +=
                double(share * 4 * pi / rows / columns);
        }
    }
    return shares;
}

TEST(Bsdf, RoughGlassScattersAsItsFormulasSay) {
    for (const float roughness : {0.4f, 0.6f, 1.0f}) {
        for (const bool outside : {true, false}) {
            const SurfaceLook look{
                .base_color = vec3(1), .roughness = roughness, .transmission = 1};
            const vec3 wo = at_cosine(0.8f);
            const Bsdf bsdf = make_bsdf(look, wo.z, outside);
            constexpr std::size_t bins = 12;
            const auto expected = walter_shares(wo, bsdf.delta_alpha, bsdf.eta, bins);
            std::vector<double> found(bins);
            constexpr std::uint32_t count = 1 << 18;
            double all = 0;
            for (std::uint32_t i = 0; i < count; ++i) {
                Sampler sampler(i, 1);
                const float u = sampler.next().x;
                const auto s = sample_delta(bsdf, up, wo, u, sampler.next());
                if (!s) continue;
                EXPECT_NEAR(length(s->wi), 1, 1e-4f);
                const auto bin = std::size_t(double(bins) * (double(s->wi.z) + 1) / 2);
                found[std::min(bin, bins - 1)] += double(s->weight.x) / count;
                all += double(s->weight.x) / count;
            }
            for (std::size_t i = 0; i < bins; ++i)
                EXPECT_NEAR(found[i], expected[i], 0.004) << roughness << outside << i;
            EXPECT_LE(all, 1);
            EXPECT_GT(all, outside && roughness < 0.7f ? 0.9 : 0.4)
                << "what is lost between facets";
        }
    }
}

TEST(Bsdf, RoughPaneKeepsLightAndSpreadsIt) {
    const SurfaceLook look{
        .base_color = vec3(1), .roughness = 0.3f, .transmission = 1, .thin_walled = true};
    const vec3 wo = at_cosine(0.7f);
    const Bsdf bsdf = make_bsdf(look, wo.z);
    double all = 0;
    vec3 mean(0);
    constexpr std::uint32_t count = 1 << 14;
    for (std::uint32_t i = 0; i < count; ++i) {
        Sampler sampler(i, 1);
        const float u = sampler.next().x;
        const auto s = sample_delta(bsdf, up, wo, u, sampler.next());
        if (!s) continue;
        all += double(s->weight.x) / count;
        if (s->wi.z < 0) mean += s->wi / float(count);
    }
    EXPECT_GT(all, 0.97);
    EXPECT_LE(all, 1);
    EXPECT_GT(dot(normalize(mean), -wo), 0.99f);
}

}  // namespace
}  // namespace tessera
