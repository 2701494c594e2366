#include "worker/shaders.h"

#include <gtest/gtest.h>

#include <cmath>

#include "worker/bench/render_fixture.h"
#include "worker/solid_texture.h"
#include "worker/surface.h"

namespace tessera {
namespace {

vec3 place(std::uint32_t i) {
    const vec2 a = sobol_point(i, 0, 1), b = sobol_point(i, 1, 1);
    return 20.0f * vec3(a.x, a.y, b.x) - 10.0f;
}

tessera_shading point_at(const vec3& p, float footprint) {
    return {.position = {p.x, p.y, p.z},
            .normal = {0, 0, 1},
            .uv = {},
            .footprint = footprint,
            .base_color = {0.8f, 0.5f, 0.2f},
            .roughness = 0.5f,
            .metallic = 0,
            .specular = 0,
            .transmission = 0,
            .slope = {}};
}

BoundShader bound(const std::string& name) {
    std::vector<std::string> complaints;
    BoundShader shader =
        bind_shader(*built_in_shaders(), {.name = "m", .shader = name}, complaints);
    EXPECT_TRUE(complaints.empty());
    return shader;
}

constexpr const char* all_names[] = {"wood", "marble", "brick"};

TEST(NoiseTest, IsWithinBoundsWithMeanZeroAndZeroAtTheLattice) {
    double sum = 0;
    constexpr std::uint32_t count = 1 << 16;
    for (std::uint32_t i = 0; i < count; ++i) {
        const float value = noise(place(i)).value;
        EXPECT_LE(std::abs(value), 1.5f);
        sum += double(value);
        EXPECT_EQ(noise(glm::floor(place(i))).value, 0);
    }
    EXPECT_NEAR(sum / count, 0, 0.01);
}

TEST(NoiseTest, GradientIsThatOfDifferences) {
    for (std::uint32_t i = 0; i < 1000; ++i) {
        const vec3 p = place(i);
        const Slope s = noise(p);
        for (int axis = 0; axis < 3; ++axis) {
            constexpr float step = 1e-2f;
            vec3 d(0);
            d[axis] = step;
            const float difference = (noise(p + d).value - noise(p - d).value) / (2 * step);
            EXPECT_NEAR(s.gradient[axis], difference, 0.02f);
        }
    }
}

/// The same bits on every machine and from every compiler: no library function has a say.
TEST(NoiseTest, IsTheSameEverywhere) {
    std::uint32_t sum = 0;
    for (std::uint32_t i = 0; i < 1000; ++i) {
        const Slope s = noise(place(i));
        for (const float f : {s.value, s.gradient.x, s.gradient.y, s.gradient.z})
            sum = hash(sum, std::bit_cast<std::uint32_t>(f + 0.0f));
    }
    EXPECT_EQ(sum, 2591801811u);
}

TEST(WaveTest, MeanIsThatOfManyPointsAndSlopeIsThatOfDifferences) {
    for (const float peak : {0.2f, 0.5f, 0.9f}) {
        const Wave wave{peak};
        for (const float width : {0.05f, 0.4f, 1.0f, 3.3f}) {
            for (float x = -2; x < 2; x += 0.173f) {
                double sum = 0;
                constexpr int steps = 2000;
                for (int i = 0; i < steps; ++i) {
                    const double at = double(x) + double(width) * ((i + 0.5) / steps - 0.5);
                    const double part = at - std::floor(at);
                    sum +=
                        part < double(peak) ? part / double(peak) : (1 - part) / (1 - double(peak));
                }
                const vec2 mean = wave.mean(x, width);
                EXPECT_NEAR(mean.x, sum / steps, 2e-3);
                const float step = 1e-2f;
                EXPECT_NEAR(
                    mean.y,
                    (wave.mean(x + step, width).x - wave.mean(x - step, width).x) / (2 * step),
                    0.3f / width * step / std::min(peak, 1 - peak) + 0.02f);
            }
        }
    }
}

/// A pixel sees the mean of what points see: from afar a texture has one colour, and its mean is
/// the same at every distance.
TEST(SolidTextureTest, FilteringKeepsTheMeanAndEndsContrast) {
    for (const char* name : all_names) {
        const BoundShader shader = bound(name);
        vec3 means[3];
        float spread[3];
        const float footprints[3] = {0, 0.03f, 5};
        for (int f = 0; f < 3; ++f) {
            constexpr std::uint32_t count = 1 << 14;
            vec3 sum(0);
            float squares = 0;
            for (std::uint32_t i = 0; i < count; ++i) {
                tessera_shading point = point_at(place(i), footprints[f]);
                shader.shade(point);
                const vec3 c(point.base_color[0], point.base_color[1], point.base_color[2]);
                sum += c;
                squares += dot(c, c);
            }
            means[f] = sum / float(count);
            spread[f] = squares / float(count) - dot(means[f], means[f]);
        }
        for (int f = 1; f < 3; ++f)
            for (int c = 0; c < 3; ++c) EXPECT_NEAR(means[f][c], means[0][c], 0.01f) << name;
        EXPECT_GT(spread[0], 0.002f) << name;
        EXPECT_LT(spread[1], spread[0]) << name;
        EXPECT_LT(spread[2], 1e-4f) << name;
    }
}

TEST(SolidTextureTest, StaysAColourAtPlacesBeyondAllReason) {
    for (const char* name : all_names) {
        const BoundShader shader = bound(name);
        for (const float far : {1e6f, 1e12f, 3e38f, -3e38f}) {
            tessera_shading point = point_at(vec3(far, 0.3f * far, -far), 0);
            shader.shade(point);
            for (const float c : point.base_color) {
                EXPECT_GE(c, -0.01f) << name;
                EXPECT_LE(c, 1.4f) << name;
            }
        }
    }
}

// ---- in a scene ---------------------------------------------------------------------------------

Material with_shader(const std::string& name) {
    Material m = lambert(vec3(0.7f));
    m.shader = name;
    return m;
}

SurfacePoint seen(const SceneBundle& bundle, const vec3& from, float pixel = 0) {
    const Surfaces surfaces(bundle.scene, bundle.blobs);
    const auto tracer = build_tracer(TracerKind::embree, surfaces.tracer_objects(),
                                     surfaces.tracer_instances(), 1, nullptr);
    const Ray rays[] = {{from, 0, vec3(0, -1, 0), infinity}};
    Hit hits[1];
    tracer->closest_hits(rays, hits);
    TriangleCache cache;
    SurfacePoint s;
    surfaces.find(rays[0], hits[0], cache, s, pixel);
    return s;
}

TEST(ShaderInSceneTest, TextureMovesWithItsObject) {
    mat4 moved(1);
    moved[3] = vec4(0.31f, 0.2f, -0.17f, 1);
    for (const char* name : all_names) {
        SceneBundle here, there;
        add_shape(here, square(1, 0), with_shader(name));
        add_shape(there, square(1, 0), with_shader(name), moved);
        const vec3 from(0.123f, 1, 0.321f);
        const SurfacePoint a = seen(here, from), b = seen(there, from + vec3(moved[3]));
        for (int c = 0; c < 3; ++c) {
            EXPECT_NEAR(a.bsdf.diffuse[c], b.bsdf.diffuse[c], 1e-3f) << name;
            EXPECT_NEAR(a.n[c], b.n[c], 1e-2f) << name;
        }
    }
}

TEST(ShaderInSceneTest, BumpTiltsTheNormalAndADistantPixelSeesNone) {
    SceneBundle bundle;
    add_shape(bundle, square(1, 0), with_shader("brick"));
    float most = 0;
    for (int i = 0; i < 50; ++i) {
        const vec3 from(0.0173f * float(i) - 0.4f, 1, 0.0091f * float(i));
        const SurfacePoint near = seen(bundle, from), far = seen(bundle, from, 10);
        EXPECT_NEAR(length(near.n), 1, 1e-5f);
        EXPECT_GT(dot(near.n, near.wo), 0);
        most = std::max(most, 1 - near.n.y);
        EXPECT_NEAR(far.n.y, 1, 1e-4f);
    }
    EXPECT_GT(most, 0.01f);
}

TEST(ShaderInSceneTest, UnknownShadersAndParametersAreReportedAndIgnored) {
    SceneBundle bundle;
    Material m = with_shader("wood");
    m.shader_parameters = {{"ring", vec3(0.1f)}, {"rnig", vec3(0.2f)}};
    add_shape(bundle, square(1, 0), m);
    add_shape(bundle, square(1, 1), with_shader("velvet"));
    const Surfaces surfaces(bundle.scene, bundle.blobs);
    ASSERT_EQ(surfaces.shader_complaints().size(), 2u);
    EXPECT_NE(surfaces.shader_complaints()[0].find("'rnig'"), std::string::npos);
    EXPECT_NE(surfaces.shader_complaints()[1].find("'velvet'"), std::string::npos);
    EXPECT_EQ(seen(bundle, {0, 2, 0}).bsdf.diffuse, vec3(0.7f)) << "the plain material";
}

TEST(ShaderInSceneTest, PictureIsDarkerWhereTheTextureIs) {
    SceneBundle bundle;
    Material m = with_shader("marble");
    add_shape(bundle, square(1, 0), m);
    add_shape(bundle, square(1, 2, false), emitter(vec3(1)));
    const Camera camera{.name = "", .eye = {1.5f, 1, 0}, .at = {0, 0, 0}, .fov_y = 40};
    const FrameSpec spec = frame_of(Integrator::igi, {16, 16}, camera, 4);
    const vec3 veined = mean_radiance(bundle, spec);
    bundle.scene.materials[0].shader.clear();
    const vec3 plain = mean_radiance(bundle, spec);
    EXPECT_LT(veined.x, 0.9f * plain.x);
    EXPECT_GT(veined.x, 0.3f * plain.x);
}

// ---- plug-ins -----------------------------------------------------------------------------------

TEST(PluginTest, AreLoadedOrComplainedAboutByFile) {
    ShaderTable table;
    const std::vector<std::string> complaints = table.load(TESSERA_TEST_PLUGINS);
    std::string all;
    for (const std::string& c : complaints) all += c + "\n";
    EXPECT_EQ(complaints.size(), 3u) << all;
    for (const char* file : {"no_object.so", "no_symbol.so", "old_version.so"})
        EXPECT_NE(all.find(file), std::string::npos) << all;
    EXPECT_NE(all.find("version 999"), std::string::npos) << all;
    EXPECT_NE(all.find(TESSERA_SHADER_ENTRY), std::string::npos) << all;

    const tessera_shader* checker = table.find("checker");
    ASSERT_NE(checker, nullptr);
    std::vector<std::string> unknown;
    const BoundShader shader =
        bind_shader(table,
                    {.name = "m",
                     .shader = "checker",
                     .shader_parameters = {{"size", vec3(0.5f)}, {"colour", vec3(1)}}},
                    unknown);
    EXPECT_EQ(unknown.size(), 1u);
    tessera_shading white = point_at({0.2f, 0.2f, 0.2f}, 0);
    tessera_shading black = point_at({0.7f, 0.2f, 0.2f}, 0);
    shader.shade(white);
    shader.shade(black);
    EXPECT_EQ(white.base_color[0], 0.8f);
    EXPECT_EQ(black.base_color[0], 0);
}

TEST(PluginTest, AFolderThatIsNotThereIsTheUsersFault) {
    ShaderTable table;
    EXPECT_THROW(table.load("no such folder"), std::runtime_error);
}

}  // namespace
}  // namespace tessera
