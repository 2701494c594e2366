#include "worker/caustics.h"

#include <gtest/gtest.h>

#include "worker/bench/render_fixture.h"
#include "worker/camera.h"

namespace tessera {
namespace {

Material glass(bool thin) {
    Material m = lambert(vec3(1));
    m.roughness = 0;
    m.transmission = 1;
    m.thin_walled = thin;
    return m;
}

Light point_light(const vec3& position, float intensity) {
    return {.name = "bulb", .position = position, .intensity = vec3(intensity)};
}

Mesh ball(const vec3& centre, float radius) {
    MeshBuilder builder;
    builder.ball(centre, radius, 64);
    return builder.take();
}

FrameSpec look_at_floor(Integrator integrator, std::uint32_t passes, float fov) {
    const Camera camera{.name = "", .eye = {1.2f, 0.6f, 0}, .at = {0, 0, 0}, .fov_y = fov};
    FrameSpec spec = frame_of(integrator, {24, 24}, camera, passes);
    spec.settings.bounces = 0;
    return spec;
}

vec3 random_point(std::uint32_t i) {
    const vec2 a = sobol_point(i, 0, 7), b = sobol_point(i, 1, 7);
    return {a.x, a.y, b.x};
}

// ---- the map ------------------------------------------------------------------------------------

TEST(PhotonMapTest, FindsWhatLookingAtAllPhotonsFinds) {
    std::vector<Photon> photons;
    for (std::uint32_t i = 0; i < 3000; ++i)
        photons.push_back({random_point(i), vec3(0, 1, 0), vec3(0, 1, 0), vec3(1)});
    for (const float radius : {0.01f, 0.1f, 0.7f}) {
        const PhotonMap map(photons, radius);
        for (std::uint32_t i = 0; i < 300; ++i) {
            SurfacePoint s;
            s.p = 1.4f * random_point(i + 5000) - 0.2f;
            s.ng = s.n = vec3(0, 1, 0);
            std::size_t expected = 0, found = 0;
            for (const Photon& photon : photons) {
                const vec3 d = photon.p - s.p;
                expected += dot(d, d) < radius * radius;
            }
            map.find(s, [&](const Photon&, float density) {
                EXPECT_GE(density, 0);
                ++found;
            });
            EXPECT_EQ(found, expected);
        }
    }
}

TEST(PhotonMapTest, DensityIntegratesToOne) {
    const float radius = 0.2f;
    const PhotonMap map({{vec3(0), vec3(0, 1, 0), vec3(0, 1, 0), vec3(1)}}, radius);
    double sum = 0;
    constexpr int steps = 400;
    for (int y = 0; y < steps; ++y) {
        for (int x = 0; x < steps; ++x) {
            SurfacePoint s;
            s.p =
                0.5f * vec3((float(x) + 0.5f) / steps - 0.5f, 0, (float(y) + 0.5f) / steps - 0.5f);
            s.ng = s.n = vec3(0, 1, 0);
            map.find(s, [&](const Photon&, float density) { sum += double(density); });
        }
    }
    EXPECT_NEAR(sum * 0.25 / (steps * steps), 1, 1e-3);
}

/// Knaus and Zwicker: the radius goes with pass^(-1/6), so its square times the number of passes
/// grows without bound, and the variance of the mean vanishes.
TEST(PhotonMapTest, RadiusShrinksAsTheTheoryAsks) {
    EXPECT_EQ(radius_share(0), 1);
    for (std::uint32_t pass = 100; pass < 5000; pass *= 3) {
        EXPECT_LT(radius_share(pass), radius_share(pass - 1));
        const float ratio = radius_share(8 * pass) / radius_share(pass);
        EXPECT_NEAR(ratio, std::pow(8.0f, -1.0f / 6), 0.005f);
    }
}

// ---- the plan -----------------------------------------------------------------------------------

TEST(CausticsTest, AreOnlyPlannedWhereALightMeetsAnIdealSurface) {
    SceneBundle bundle;
    add_shape(bundle, square(1, 0), lambert(vec3(0.5f)));
    bundle.scene.lights.push_back(point_light({0, 2, 0}, 1));
    const Surfaces matt(bundle.scene, bundle.blobs);
    EXPECT_FALSE(Caustics(matt).wanted(Integrator::igi));

    add_shape(bundle, square(0.5f, 1), glass(true));
    const Surfaces with_pane(bundle.scene, bundle.blobs);
    EXPECT_TRUE(Caustics(with_pane).wanted(Integrator::igi));
    EXPECT_TRUE(Caustics(with_pane).wanted(Integrator::path));

    bundle.scene.lights.clear();
    add_shape(bundle, square(5, 3, false), emitter(vec3(1)));
    const Surfaces large_lamp(bundle.scene, bundle.blobs);
    EXPECT_FALSE(Caustics(large_lamp).wanted(Integrator::igi));

    add_shape(bundle, square(0.1f, 2.5f, false), emitter(vec3(1)));
    const Surfaces small_lamp(bundle.scene, bundle.blobs);
    EXPECT_TRUE(Caustics(small_lamp).wanted(Integrator::igi));
    EXPECT_FALSE(Caustics(small_lamp).by_photons(2));
    EXPECT_TRUE(Caustics(small_lamp).by_photons(3));
    EXPECT_FALSE(Caustics(small_lamp).wanted(Integrator::path)) << "rays find it there";
}

// ---- pictures -----------------------------------------------------------------------------------

/// What a pane lets through at that cosine: both its sides, to and fro.
float pane_transmits(float cosine) {
    const float r = fresnel_dielectric(cosine, 1 / 1.5f);
    return 1 - 2 * r / (1 + r);
}

/// A pane under a light without size: each point of the floor gets what the pane lets through.
void expect_light_through_pane(const Light& light) {
    SceneBundle bundle;
    add_shape(bundle, square(4, 0), lambert(vec3(0.5f)));
    add_shape(bundle, square(1.5f, 1), glass(true));
    bundle.scene.lights.push_back(light);
    for (const Integrator integrator : {Integrator::igi, Integrator::path}) {
        const FrameSpec spec = look_at_floor(integrator, 64, 25);
        const Pinhole camera(spec.camera, spec.size);
        double expected = 0;
        for (int y = 0; y < spec.size.height; ++y) {
            for (int x = 0; x < spec.size.width; ++x) {
                const Ray ray = camera.ray(vec2(float(x) + 0.5f, float(y) + 0.5f));
                const vec3 p = ray.org - ray.dir * (ray.org.y / ray.dir.y);
                vec3 to = light.position - p;
                float e = 1 / dot(to, to);
                if (light.kind == LightKind::directional) to = -light.direction, e = 1;
                const float cosine = normalize(to).y;
                if (light.kind == LightKind::spot)
                    e *= spot_falloff(light, dot(-normalize(to), light.direction));
                expected +=
                    double(0.5f / pi * light.intensity.x * e * cosine * pane_transmits(cosine));
            }
        }
        expected /= double(spec.size.pixels());
        const double found = double(mean_radiance(bundle, spec).x);
        EXPECT_NEAR(found / expected, 1, 0.03) << int(integrator);
    }
}

TEST(CausticsTest, PointLightShinesThroughAPane) {
    expect_light_through_pane(point_light({0.1f, 2, 0.2f}, 3));
}

TEST(CausticsTest, SpotLightShinesThroughAPane) {
    Light spot = point_light({0, 2, 0}, 3);
    spot.kind = LightKind::spot;
    spot.direction = {0, -1, 0};
    spot.inner_angle = 0.2f;
    spot.outer_angle = 0.5f;
    expect_light_through_pane(spot);
}

TEST(CausticsTest, SunShinesThroughAPane) {
    Light sun = point_light(vec3(0), 3);
    sun.kind = LightKind::directional;
    sun.direction = normalize(vec3(0.2f, -1, 0.1f));
    expect_light_through_pane(sun);
}

struct Estimate {
    double mean = 0;
    double variance = 0;  ///< of the mean
};

/// Mean radiance of pictures of several seeds.
Estimate estimate(const SceneBundle& bundle, FrameSpec spec) {
    constexpr int seeds = 8;
    Renderer renderer(bundle.scene, bundle.blobs, {});
    double sum = 0, squares = 0;
    for (int seed = 0; seed < seeds; ++seed) {
        spec.frame = spec.settings.seed = std::uint32_t(seed + 1);
        const double mean = double(mean_radiance(spec, render_all(renderer, spec)).x);
        sum += mean / seeds;
        squares += mean * mean / seeds;
    }
    return {sum, (squares - sum * sum) / (seeds - 1)};
}

/// In igi the lamp's light comes through the ball by photons, in the path tracer rays find it.
TEST(CausticsTest, PhotonsAndRaysAgreeOnALampBehindAGlassBall) {
    SceneBundle bundle;
    add_shape(bundle, square(4, 0), lambert(vec3(0.5f)));
    add_shape(bundle, ball({0, 0.7f, 0}, 0.4f), glass(false));
    add_shape(bundle, square(0.2f, 2.2f, false), emitter(vec3(20)));
    const Estimate igi = estimate(bundle, look_at_floor(Integrator::igi, 32, 30));
    const Estimate path = estimate(bundle, look_at_floor(Integrator::path, 512, 30));
    const double error = std::sqrt(igi.variance + path.variance);
    EXPECT_LT(error, 0.01 * path.mean);
    EXPECT_NEAR(igi.mean, path.mean, 4 * error + 0.003 * path.mean);
}

TEST(CausticsTest, SameBitsInAnyOrder) {
    SceneBundle bundle;
    add_shape(bundle, square(4, 0), lambert(vec3(0.5f)));
    add_shape(bundle, ball({0, 0.7f, 0}, 0.4f), glass(false));
    bundle.scene.lights.push_back(point_light({0, 2, 0}, 3));
    FrameSpec spec = look_at_floor(Integrator::igi, 3, 30);
    std::vector<TileTask> tasks = tasks_of(spec);
    Renderer forwards(bundle.scene, bundle.blobs, {}), backwards(bundle.scene, bundle.blobs, {});
    forwards.begin_frame(spec);
    backwards.begin_frame(spec);
    std::vector<std::vector<float>> there, back;
    for (const TileTask& task : tasks) there.push_back(forwards.render(task)->data);
    std::ranges::reverse(tasks);
    for (const TileTask& task : tasks) back.push_back(backwards.render(task)->data);
    std::ranges::reverse(back);
    EXPECT_EQ(there, back);
}

}  // namespace
}  // namespace tessera
