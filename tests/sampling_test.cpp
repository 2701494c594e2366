// Every sampler against its own density, by Pearson's chi-squared test: the null hypothesis is that
// samples follow the density, and a test that is right fails once in ten thousand seeds (the seeds
// are fixed). Bins expected to hold fewer than 5 samples are merged.
#include "worker/sampling.h"

#include <gtest/gtest.h>
#include <hwy/targets.h>

#include <array>
#include <functional>
#include <memory>
#include <random>

#include "worker/bench/render_fixture.h"
#include "worker/bsdf.h"
#include "worker/lights.h"
#include "worker/sample_table.h"

namespace tessera {
namespace {

class RandomPoints {
public:
    explicit RandomPoints(unsigned seed) : engine_(seed) {}
    float next() { return unit_float(std::uint32_t(engine_())); }
    vec2 next_2d() {
        const float x = next();
        return {x, next()};
    }

private:
    std::mt19937 engine_;
};

/// Upper quantile of the chi-squared distribution at 1e-4 (Wilson and Hilferty, 1931).
double critical_value(int degrees) {
    const double z = 3.719;
    const double a = 2.0 / (9.0 * degrees);
    return degrees * std::pow(1 - a + z * std::sqrt(a), 3);
}

void expect_frequencies(const std::vector<double>& observed, const std::vector<double>& expected) {
    double statistic = 0, merged_observed = 0, merged_expected = 0;
    int bins = 0;
    for (std::size_t i = 0; i < observed.size(); ++i) {
        merged_observed += observed[i];
        merged_expected += expected[i];
        if (merged_expected < 5) continue;
        const double d = merged_observed - merged_expected;
        statistic += d * d / merged_expected;
        merged_observed = merged_expected = 0;
        ++bins;
    }
    ASSERT_GT(bins, 1);
    EXPECT_LT(statistic, critical_value(bins - 1)) << bins << " bins";
    EXPECT_LT(merged_observed, 30) << "samples where the density is zero";
}

/// `sample` gives points of the unit square, or nothing; `density` is theirs there and integrates
/// to the share of samples that give a point.
void expect_density(const std::function<std::optional<vec2>(RandomPoints&)>& sample,
                    const std::function<double(const vec2&)>& density, int steps = 16) {
    const int bins = 16, samples = 50'000;
    std::vector<double> observed(bins * bins), expected(bins * bins);
    RandomPoints random(1);
    const auto bin = [](float x) { return std::clamp(int(x * bins), 0, bins - 1); };
    for (int i = 0; i < samples; ++i)
        if (const auto p = sample(random)) ++observed[bin(p->y) * bins + bin(p->x)];
    const int fine = bins * steps;  // the density is summed over a grid this fine
    for (int y = 0; y < fine; ++y)
        for (int x = 0; x < fine; ++x)
            expected[y / steps * bins + x / steps] +=
                samples * density((vec2(x, y) + 0.5f) / float(fine)) / (fine * fine);
    expect_frequencies(observed, expected);
}

/// Directions as points of the unit square; equal areas are equal solid angles.
vec2 square_from_direction(const vec3& d) {
    const float phi = std::atan2(d.y, d.x) / (2 * pi);
    return {(d.z + 1) / 2, phi < 0 ? phi + 1 : phi};
}
vec3 direction_from_square(const vec2& p) {
    const float z = 2 * p.x - 1, r = std::sqrt(1 - z * z), phi = 2 * pi * p.y;
    return {r * std::cos(phi), r * std::sin(phi), z};
}

void expect_directions(const std::function<std::optional<vec3>(RandomPoints&)>& sample,
                       const std::function<double(const vec3&)>& pdf, int steps = 16) {
    expect_density(
        [&](RandomPoints& random) -> std::optional<vec2> {
            const auto d = sample(random);
            if (!d) return {};
            return square_from_direction(*d);
        },
        [&](const vec2& p) { return 4 * double(pi) * pdf(direction_from_square(p)); }, steps);
}

TEST(Sampling, CosineHemisphereFollowsItsDensity) {
    expect_directions([](auto& r) { return sample_cosine_hemisphere(r.next_2d()); },
                      [](const vec3& d) { return cosine_hemisphere_pdf(d.z); });
}

TEST(Sampling, SphereFollowsItsDensity) {
    expect_directions([](auto& r) { return sample_sphere(r.next_2d()); },
                      [](const vec3&) { return sphere_pdf; });
}

TEST(Sampling, ConeFollowsItsDensity) {
    const float cos_max = 0.5f;  // falls on the border of a bin
    expect_directions([=](auto& r) { return sample_cone(r.next_2d(), cos_max); },
                      [=](const vec3& d) { return d.z > cos_max ? cone_pdf(cos_max) : 0; });
}

TEST(Sampling, TriangleIsUniform) {
    expect_density([](auto& r) { return sample_triangle(r.next_2d()); },
                   [](const vec2& b) {
                       const float sum = b.x + b.y;
                       return sum < 1 ? 2 : sum > 1 ? 0 : 1;
                   });
}

TEST(Sampling, DiscIsUniform) {
    // Polar coordinates with squared radius turn the disc into the square.
    expect_density(
        [](auto& r) {
            const vec2 p = sample_disc(r.next_2d());
            const float phi = std::atan2(p.y, p.x) / (2 * pi);
            return vec2(dot(p, p), phi < 0 ? phi + 1 : phi);
        },
        [](const vec2&) { return 1.0; });
}

TEST(Sampling, DistributionChoosesByWeight) {
    const std::array<float, 7> weights = {0, 3, 0.5f, -1, NAN, 6, 0};
    const Distribution d(weights);
    std::vector<double> observed(weights.size()), expected;
    constexpr int samples = 100'000;
    RandomPoints random(2);
    double u_sum = 0;
    for (int i = 0; i < samples; ++i) {
        const auto choice = d.sample(random.next());
        ++observed[choice.index];
        u_sum += choice.u;
        EXPECT_GE(choice.u, 0);
        EXPECT_LT(choice.u, 1);
        EXPECT_EQ(choice.probability, d.probability(choice.index));
    }
    for (const float w : weights) expected.push_back(w > 0 ? samples * w / 9.5 : 0);
    expect_frequencies(observed, expected);
    for (const std::size_t i : {0, 3, 4, 6}) EXPECT_EQ(observed[i], 0);
    EXPECT_NEAR(u_sum / samples, 0.5, 0.005);
    EXPECT_TRUE(Distribution(std::vector<float>{0, 0}).empty());
    EXPECT_TRUE(Distribution(std::vector<float>{}).empty());
    EXPECT_EQ(d.sample(0x1.fffffep-1f).index, 5u);
}

TEST(Sampling, BsdfFollowsItsDensity) {
    const vec3 n = normalize(vec3(0.3f, -0.5f, 0.8f));
    const vec3 wo = normalize(vec3(0.1f, 0.2f, 0.9f));
    const Bsdf bsdf = make_bsdf({.base_color = vec3(0.7f)}, 1);
    expect_directions(
        [&](auto& r) -> std::optional<vec3> {
            const auto s = sample(bsdf, n, wo, r.next(), r.next_2d());
            if (!s) return {};
            EXPECT_NEAR(s->pdf, pdf(bsdf, n, wo, s->wi), 1e-4f);
            const vec3 weight = eval(bsdf, n, wo, s->wi) * dot(n, s->wi) / s->pdf;
            EXPECT_LT(length(weight - s->weight), 1e-3f);
            return s->wi;
        },
        [&](const vec3& wi) { return pdf(bsdf, n, wo, wi); });
}

/// Runs `test` on every instruction set that this machine has.
void on_all_targets(const std::function<void()>& test) {
    for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
        hwy::SetSupportedTargetsForTest(target);
        test();
    }
    hwy::SetSupportedTargetsForTest(0);
}

/// Two lamps of different power over the origin, one of them two-sided and mirrored.
SceneBundle two_lamps() {
    SceneBundle bundle;
    add_shape(bundle, square(1, 2, false), emitter(vec3(1, 2, 3)));
    Material two_sided = emitter(vec3(5));
    two_sided.two_sided_emission = true;
    mat4 mirrored(1);
    mirrored[0][0] = -1;
    mirrored[3] = vec4(2.5f, 0.5f, 0, 1);
    add_shape(bundle, square(0.5f, 0.5f), two_sided, mirrored);
    return bundle;
}

struct LitScene {
    explicit LitScene(const SceneBundle& bundle)
        : surfaces(bundle.scene, bundle.blobs),
          lights(surfaces, surfaces.bounds()),
          tracer(build_tracer(TracerKind::embree, surfaces.tracer_objects(),
                              surfaces.tracer_instances(), 1)) {}
    Surfaces surfaces;
    Lights lights;
    std::unique_ptr<Tracer> tracer;
};

TEST(Sampling, LightSamplesFollowTheDensityThatHitsReport) {
    const LitScene scene(two_lamps());
    const vec3 from(0.2f, 0, 0.1f);
    expect_directions(
        [&](auto& r) -> std::optional<vec3> {
            const float u = r.next();
            const auto s = scene.lights.sample(from, u, r.next_2d());
            if (!s) return {};
            return s->wi;
        },
        [&](const vec3& d) -> double {
            const Ray ray{from, 0, d, infinity};
            const Hit hit = scene.tracer->closest_hit(ray);
            if (!hit.valid()) return 0;
            return scene.lights.pdf(from, hit, scene.surfaces.at(ray, hit));
        },
        64);
}

TEST(Sampling, LightSampleKnowsItsDensityAndRadiance) {
    const LitScene scene(two_lamps());
    const vec3 from(0.2f, 0, 0.1f);
    RandomPoints random(3);
    for (int i = 0; i < 1000; ++i) {
        const float u = random.next();
        const auto s = scene.lights.sample(from, u, random.next_2d());
        if (!s) continue;
        const Ray ray{from, 0, s->wi, infinity};
        const Hit hit = scene.tracer->closest_hit(ray);
        if (!hit.valid()) continue;  // through the very rim
        const SurfacePoint at = scene.surfaces.at(ray, hit);
        EXPECT_EQ(at.emission, s->radiance);
        EXPECT_NEAR(hit.t, s->distance, 1e-4f);
        EXPECT_NEAR(s->pdf, scene.lights.pdf(from, hit, at), 1e-3f * s->pdf);
    }
}

/// A receiver's one candidate is the lamp that sample() finds, bit for bit.
TEST(Sampling, LampsAreSampledTogetherAsOneByOne) {
    const LitScene scene(two_lamps());
    const LampTable& lamps = scene.lights.lamps();
    ASSERT_EQ(lamps.lamps.size(), 4u);
    on_all_targets([&] {
        RandomPoints random(3);
        auto requests = std::make_unique<LampRequests>();
        const std::size_t count = 201;
        for (std::size_t i = 0; i < count; ++i) {
            const vec3 n = sample_sphere(random.next_2d());
            for (int k = 0; k < 3; ++k) {
                requests->p[k][i] = 3 * random.next() - 1;
                requests->n[k][i] = requests->ng[k][i] = n[k];
                requests->throughput[k][i] = 1;
            }
            for (auto* u : {&requests->u_choice, &requests->u_place})
                for (int k = 0; k < 2; ++k) (*u)[k][i] = random.next();
        }
        sample_lamps(lamps, {}, count, *requests);
        for (std::size_t i = 0; i < count; ++i) {
            const auto at = [&](const LampRequests::Column* c) {
                return vec3(c[0][i], c[1][i], c[2][i]);
            };
            const auto s = scene.lights.sample(at(requests->p), requests->u_choice[0][i],
                                               {requests->u_place[0][i], requests->u_place[1][i]});
            const float cosine = s ? dot(at(requests->n), s->wi) : 0;
            const vec3 e = cosine > 0 ? s->radiance * (cosine / s->pdf) : vec3(0);
            EXPECT_EQ(at(requests->e), e);
            if (cosine > 0) {
                EXPECT_EQ(at(requests->end), s->end);
            }
        }
    });
}

SceneBundle one_light(LightKind kind) {
    SceneBundle bundle;
    Light light;
    light.kind = kind;
    light.direction = normalize(vec3(0, 0, 1));
    light.inner_angle = 0.4f;
    light.outer_angle = std::acos(0.5f);
    bundle.scene.lights.push_back(light);
    return bundle;
}

/// Emitted power per direction, as light paths carry it, must be the intensity.
TEST(Sampling, EmissionCarriesTheIntensityOfPointAndSpot) {
    for (const LightKind kind : {LightKind::point, LightKind::spot}) {
        const LitScene scene(one_light(kind));
        const bool spot = kind == LightKind::spot;
        const auto pdf = [&](const vec3& d) {
            return spot ? (d.z > 0.5f ? cone_pdf(0.5f) : 0) : sphere_pdf;
        };
        expect_directions(
            [&](auto& r) -> std::optional<vec3> {
                const vec2 place = r.next_2d();
                const auto e = scene.lights.sample_emission(r.next(), place, r.next_2d());
                const float share =
                    spot ? spot_falloff(scene.surfaces.scene().lights[0], e.ray.dir.z) : 1;
                EXPECT_NEAR(e.flux.x * pdf(e.ray.dir), share, 1e-3f);
                return e.ray.dir;
            },
            pdf);
    }
}

TEST(Sampling, EmissionOfALampFollowsCosineAndCarriesItsPower) {
    SceneBundle bundle;
    add_shape(bundle, square(1, 0), emitter(vec3(3)));
    const LitScene scene(bundle);
    expect_directions(
        [&](auto& r) -> std::optional<vec3> {
            const float u = r.next();
            const vec2 place = r.next_2d();
            const auto e = scene.lights.sample_emission(u, place, r.next_2d());
            EXPECT_NEAR(e.flux.x, 3 * 4 * pi, 1e-3f);
            EXPECT_LE(std::abs(e.ray.org.x), 1.0001f);
            EXPECT_LE(std::abs(e.ray.org.z), 1.0001f);
            EXPECT_GT(e.ray.org.y, 0);
            return e.ray.dir;
        },
        [](const vec3& d) { return cosine_hemisphere_pdf(d.y); });
}

/// Whether each elementary interval of volume 1 / count holds one of the points.
bool is_net(const std::vector<vec2>& points) {
    const std::size_t count = points.size();
    for (std::size_t columns = 1; columns <= count; columns *= 2) {
        const std::size_t rows = count / columns;
        std::vector<bool> taken(count);
        for (const vec2& p : points) {
            const std::size_t cell =
                std::size_t(p.y * float(rows)) * columns + std::size_t(p.x * float(columns));
            if (taken[cell]) return false;
            taken[cell] = true;
        }
    }
    return true;
}

std::vector<vec2> points_of(std::uint32_t first, std::uint32_t count, std::uint32_t pair,
                            std::uint32_t seed) {
    std::vector<vec2> points;
    for (std::uint32_t i = 0; i < count; ++i) points.push_back(sobol_point(first + i, pair, seed));
    return points;
}

TEST(Sampling, SequenceIsMadeOfNets) {
    for (std::uint32_t seed = 0; seed < 4; ++seed)
        for (std::uint32_t pair = 0; pair < 4; ++pair)
            for (const std::uint32_t count : {1u, 2u, 4u, 16u, 64u, 512u})
                for (const std::uint32_t block : {0u, 1u, 5u})
                    EXPECT_TRUE(is_net(points_of(block * count, count, pair, seed)))
                        << seed << " " << pair << " " << count << " " << block;
}

/// What makes pixels of a block and passes of a pixel well distributed.
TEST(Sampling, RoundsOfAPointAreMadeOfNetsAndKeepThoseOfARound) {
    for (const std::uint32_t seed : {0u, 7u}) {
        for (const std::uint32_t count : {4u, 16u, 64u, 512u}) {
            std::vector<vec2> rounds, points;
            for (std::uint32_t i = 0; i < count; ++i) {
                rounds.push_back(sobol_point(5, 2, seed, i + 1));
                points.push_back(sobol_point(3 * count + i, 2, seed, 6));
            }
            EXPECT_TRUE(is_net(rounds)) << seed << " " << count;
            EXPECT_TRUE(is_net(points)) << seed << " " << count;
        }
    }
}

TEST(Sampling, TablesHoldWhatSamplersGive) {
    on_all_targets([] {
        for (const std::uint32_t count : {0u, 1u, 37u}) {
            std::vector<std::uint32_t> indices;
            for (std::uint32_t i = 0; i < count; ++i) indices.push_back(hash(i) >> (i % 32));
            const SampleTable table(indices, 11, 4, 3);
            for (std::uint32_t i = 0; i < count; ++i) {
                Sampler made = table[i], plain(indices[i], 11, 4);
                for (int pair = 0; pair < 5; ++pair) EXPECT_EQ(made.next(), plain.next());
            }
        }
    });
}

/// Squared L2 star discrepancy (Warnock, 1972).
double discrepancy(const std::vector<vec2>& points) {
    const double n = double(points.size());
    double single = 0, pairs = 0;
    for (const vec2& p : points) {
        single += (1 - double(p.x) * p.x) * (1 - double(p.y) * p.y);
        for (const vec2& q : points)
            pairs += (1 - double(std::max(p.x, q.x))) * (1 - double(std::max(p.y, q.y)));
    }
    return 1.0 / 9 - single / (2 * n) + pairs / (n * n);
}

/// Interleaved sets are contiguous blocks of one sequence: each is even, and their union more so.
TEST(Sampling, SetsAndTheirUnionHaveLowDiscrepancy) {
    const auto random_expectation = [](double n) { return (1.0 / 4 - 1.0 / 9) / n; };
    for (const std::uint32_t n : {3u, 5u}) {
        for (const std::uint32_t size : {11u, 16u}) {
            double of_sets = 0, of_union = 0;
            for (std::uint32_t seed = 0; seed < 8; ++seed) {
                for (std::uint32_t set = 0; set < n * n; ++set)
                    of_sets += discrepancy(points_of(set * size, size, 1, seed)) / (8 * n * n);
                of_union += discrepancy(points_of(0, n * n * size, 1, seed)) / 8;
            }
            EXPECT_LT(of_sets, 0.35 * random_expectation(size)) << n << " " << size;
            EXPECT_LT(of_union, 0.1 * random_expectation(n * n * size)) << n << " " << size;
        }
    }
}

/// Small lamps by chance; some shine all around.
std::vector<LightBounds> random_lights(std::size_t count) {
    RandomPoints r(5);
    std::vector<LightBounds> lights(count);
    for (LightBounds& light : lights) {
        const vec3 place(r.next(), r.next(), r.next());
        light.box.add(place);
        light.box.add(place + 0.02f * vec3(r.next(), r.next(), r.next()));
        light.axis = sample_sphere(r.next_2d());
        light.cos_spread = r.next() < 0.2f ? -1.0f : 1.0f;
        light.power = r.next();
    }
    return lights;
}

TEST(LightTree, TakesLightsAsOftenAsItSays) {
    const std::vector<LightBounds> lights = random_lights(57);
    const LightTree tree(lights);
    RandomPoints r(6);
    for (const vec3& p : {vec3(0.5f), vec3(3, 0, 0), vec3(0.1f, 0.2f, 0.9f)}) {
        std::vector<double> observed(lights.size()), expected;
        double sum = 0;
        constexpr int samples = 20000;
        for (int i = 0; i < samples; ++i) {
            const auto choice = tree.sample(p, r.next());
            if (!choice) continue;
            ++observed[choice->index];
            EXPECT_NEAR(choice->probability, tree.probability(p, choice->index),
                        1e-4f * choice->probability);
        }
        for (std::uint32_t i = 0; i < lights.size(); ++i) {
            expected.push_back(samples * double(tree.probability(p, i)));
            sum += double(tree.probability(p, i));
        }
        EXPECT_LT(sum, 1.0001);
        // Less than one: a half may look as if it shone where neither of its own halves does.
        EXPECT_GT(sum, 0.5);
        expect_frequencies(observed, expected);
    }
}

TEST(LightTree, LeavesOutOnlyWhatCannotShine) {
    const std::vector<LightBounds> lights = random_lights(40);
    const LightTree tree(lights);
    RandomPoints r(7);
    for (int i = 0; i < 500; ++i) {
        const vec3 p = 4.0f * vec3(r.next(), r.next(), r.next()) - 1.5f;
        for (std::uint32_t k = 0; k < lights.size(); ++k) {
            const LightBounds& light = lights[k];
            const bool shines = light.cos_spread < 0 ||
                                dot(light.axis, p - light.box.hi) > 0.001f ||
                                dot(light.axis, p - light.box.lo) > 0.001f;
            EXPECT_TRUE(!shines || tree.probability(p, k) > 0) << i << " " << k;
        }
    }
}

}  // namespace
}  // namespace tessera
