// Pictures whose radiance is known in closed form, by both integrators.
#include <gtest/gtest.h>

#include <glm/gtc/matrix_transform.hpp>
#include <map>

#include "worker/bench/render_fixture.h"
#include "worker/texture.h"

namespace tessera {
namespace {

class LightTransport : public testing::TestWithParam<Integrator> {
protected:
    /// Mean radiance of a small picture.
    vec3 look(const SceneBundle& bundle, const Camera& camera, std::uint32_t passes = 16) const {
        return mean_radiance(bundle, frame_of(GetParam(), {16, 16}, camera, passes));
    }
};

void expect_near(const vec3& got, const vec3& wanted, float relative) {
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(got[c], wanted[c], relative * wanted[c] + 1e-6f);
}

/// Looks straight down at the origin through a very small angle.
Camera from_above(float height = 1) {
    Camera camera;
    camera.eye = {0, height, 0};
    camera.up = {0, 0, -1};
    camera.fov_y = 0.5f;
    return camera;
}

SceneBundle floor_of(const Material& material) {
    SceneBundle bundle;
    add_shape(bundle, square(10, 0), material);
    return bundle;
}

void add_light(SceneBundle& bundle, LightKind kind, const vec3& position, const vec3& direction,
               const vec3& intensity) {
    Light light;
    light.kind = kind;
    light.position = position;
    light.direction = direction;
    light.intensity = intensity;
    bundle.scene.lights.push_back(light);
}

Material coated(const vec3& colour, float roughness, float metallic = 0) {
    Material m = lambert(colour);
    m.specular = 1;
    m.roughness = roughness;
    m.metallic = metallic;
    return m;
}

TEST_P(LightTransport, FurnaceGlowsAsItsGeometricSeries) {
    // In a closed room of one albedo and one emission every radiance is e + a e + a^2 e...
    SceneBundle bundle;
    Material m = lambert(vec3(0.5f, 0.3f, 0));
    m.emission = vec3(1, 2, 3);
    add_shape(bundle, room(vec3(-1), vec3(1)), m);
    Camera camera;
    camera.eye = {0.3f, 0.1f, 0.2f};
    camera.at = {-0.4f, -0.3f, 0};
    camera.fov_y = 120;
    expect_near(look(bundle, camera, 64), vec3(1 / 0.5f, 2 / 0.7f, 3), 0.015f);
}

TEST_P(LightTransport, PointLightInASphere) {
    // pbrt's integrator test: Kd = 0.5, I = pi at the centre; one bounce adds half of the light
    // that falls everywhere, so that the radiance is 0.5 + 0.25 + ... = 1.
    SceneBundle bundle;
    MeshBuilder builder;
    builder.ball(vec3(0), 1, 96);
    add_shape(bundle, builder.take(), lambert(vec3(0.5f)));
    add_light(bundle, LightKind::point, vec3(0), vec3(0, 0, -1), vec3(pi));
    Camera camera;
    camera.eye = {0.1f, 0.2f, 0.3f};
    camera.at = {0.5f, -0.5f, 0.2f};
    camera.fov_y = 100;
    expect_near(look(bundle, camera, 64), vec3(1), 0.01f);
}

TEST_P(LightTransport, PlaneUnderAPointLight) {
    SceneBundle bundle = floor_of(lambert(vec3(0.8f, 0.4f, 0.2f)));
    add_light(bundle, LightKind::point, {0, 2, 0}, {0, 0, -1}, vec3(3));
    expect_near(look(bundle, from_above()), vec3(0.8f, 0.4f, 0.2f) / pi * 3.0f / 4.0f, 1e-3f);
}

TEST_P(LightTransport, PlaneUnderADirectionalLight) {
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    add_light(bundle, LightKind::directional, vec3(0), normalize(vec3(0, -1, 1)), vec3(2));
    expect_near(look(bundle, from_above()), vec3(0.5f / pi * 2 * std::sqrt(0.5f)), 1e-3f);
}

TEST_P(LightTransport, PlaneUnderASpotLight) {
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    add_light(bundle, LightKind::spot, {0, 2, 0}, {0, -1, 0}, vec3(8));
    bundle.scene.lights[0].inner_angle = 0.1f;
    bundle.scene.lights[0].outer_angle = 0.3f;
    expect_near(look(bundle, from_above()), vec3(0.5f / pi * 8 / 4), 1e-3f);
    // Between the angles the falloff of glTF, outside of them nothing.
    bundle.scene.lights[0].direction = {std::sin(0.2f), -std::cos(0.2f), 0};
    const float share = (std::cos(0.2f) - std::cos(0.3f)) / (std::cos(0.1f) - std::cos(0.3f));
    expect_near(look(bundle, from_above()), vec3(share * share * 0.5f / pi * 8 / 4), 0.01f);
    bundle.scene.lights[0].direction = {std::sin(0.4f), -std::cos(0.4f), 0};
    EXPECT_EQ(look(bundle, from_above()), vec3(0));
}

TEST_P(LightTransport, PlaneUnderASquareLamp) {
    // Configuration factor of a parallel rectangle over one of its corners, four times.
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    add_shape(bundle, square(1, 2, false), emitter(vec3(4, 2, 1)));
    const float a = 0.5f;  // half side over height
    const float b = a / std::sqrt(1 + a * a);
    const float factor = 4 * (2 * b * std::atan(b)) / (2 * pi);
    expect_near(look(bundle, from_above(), 64), factor * 0.5f * vec3(4, 2, 1), 0.01f);
}

TEST_P(LightTransport, RimsOfLampsHoldTheirMean) {
    // A lamp of a few pixels: whether a pixel gets more rays must not depend on what it saw.
    SceneBundle bundle;
    add_shape(bundle, square(0.31f, 0), emitter(vec3(9)));
    Camera camera = from_above();
    camera.fov_y = 90;
    expect_near(look(bundle, camera, 256), vec3(9 * 0.31f * 0.31f), 0.01f);
}

TEST_P(LightTransport, RimsOfLampsAreAsSmoothAtBordersOfTiles) {
    // The lamp reaches over 0.3 of the first pixels of the tiles around the one in the middle.
    constexpr int side = 3 * tile_size;
    constexpr float reach = 0.5f * tile_size + 0.3f;
    SceneBundle bundle;
    add_shape(bundle, square(2 * reach / side, 0), emitter(vec3(9)));
    Camera camera = from_above();
    camera.fov_y = 90;
    const FrameSpec spec = frame_of(GetParam(), {side, side}, camera, 1);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const std::vector<TileResult> tiles = render_all(renderer, spec);
    for (const std::size_t tile : {1u, 3u, 5u, 7u})
        for (int i = 1; i < tile_size - 1; ++i) {
            const int border = tile < 4 ? tile_size - 1 : 0;
            const int pixel = tile % 3 == 1 ? border * tile_size + i : i * tile_size + border;
            EXPECT_NEAR(tiles[tile].data[std::size_t(3 * pixel)], 9 * 0.3f, 0.5f) << tile;
        }
}

TEST_P(LightTransport, CeilingBesideALampThatHangsCloseBelow) {
    // Strips of the ceiling around the back of a lamp at distance h: from the edge on, the lamp is
    // nearly a half plane, whose irradiance at distance x from its edge is
    // pi / 2 * (1 - x / sqrt(x^2 + h^2)).
    constexpr float h = 1e-3f;
    SceneBundle bundle;
    add_shape(bundle, square(0.1f, 0), lambert(vec3(0.5f)));
    const mat4 beside = glm::translate(mat4(1), vec3(-0.1f - h, h, 0));
    add_shape(bundle, square(0.1f, 0, false), emitter(vec3(2)), beside);
    // Seen from the lamp's side, a patch so small that x is h all over it.
    Camera camera = from_above(0.5f * h);
    camera.fov_y = 5;
    const float share = 0.5f * (1 - std::sqrt(0.5f));
    expect_near(look(bundle, camera, 256), vec3(0.5f * 2 * share), 0.02f);
}

TEST_P(LightTransport, LampsShineFromTheirFrontUnlessTwoSided) {
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    Material lamp = emitter(vec3(4));
    add_shape(bundle, square(1, 2, true), lamp);
    EXPECT_EQ(look(bundle, from_above()), vec3(0));
    EXPECT_GT(look(bundle, from_above(3)).x, 3.9f);
    bundle.scene.materials[1].two_sided_emission = true;
    EXPECT_GT(look(bundle, from_above()).x, 0.1f);
    // Mirroring an instance keeps its front.
    bundle.scene.materials[1].two_sided_emission = false;
    bundle.scene.instances[1].world_from_object[0][0] = -1;
    EXPECT_EQ(look(bundle, from_above()), vec3(0));
    EXPECT_GT(look(bundle, from_above(3)).x, 3.9f);
}

TEST_P(LightTransport, MirrorsReflect) {
    Material mirror = lambert(vec3(0.9f, 0.5f, 0.1f));
    mirror.metallic = 1;
    mirror.roughness = 0;
    SceneBundle bundle = floor_of(mirror);
    add_shape(bundle, square(5, 3, false), emitter(vec3(2)));
    expect_near(look(bundle, from_above()), 2.0f * vec3(0.9f, 0.5f, 0.1f), 1e-4f);
    // Rough metal shows a share of all the light above it.
    bundle.scene.materials[0].roughness = 0.9f;
    EXPECT_LT(look(bundle, from_above()).x, 1.75f);
}

TEST_P(LightTransport, MirrorsFacingEachOtherEnd) {
    Material mirror = lambert(vec3(1));
    mirror.metallic = 1;
    mirror.roughness = 0;
    SceneBundle bundle = floor_of(mirror);
    add_shape(bundle, square(10, 2, false), mirror);
    add_light(bundle, LightKind::point, {0, 1.5f, 0}, {0, -1, 0}, vec3(1));
    EXPECT_EQ(look(bundle, from_above()), vec3(0));
}

TEST_P(LightTransport, TexturesScaleTheAlbedo) {
    SceneBundle bundle;
    Material m = lambert(vec3(1, 1, 0.5f));
    m.base_color_map.texture =
        std::int32_t(add_texture(bundle, {.width = 1, .height = 1, .rgba = {188, 0, 255, 255}}));
    add_shape(bundle, square(10, 0), m);
    add_light(bundle, LightKind::directional, vec3(0), {0, -1, 0}, vec3(pi));
    expect_near(look(bundle, from_above()), vec3(0.5029f, 0, 0.5f), 2e-3f);
}

TEST_P(LightTransport, SkyOverALambertPlaneAndBall) {
    // Irradiance of the open sky is pi times its radiance.
    SceneBundle bundle = floor_of(lambert({0.8f, 0.4f, 0.2f}));
    bundle.scene.environment.radiance = {2, 1, 3};
    expect_near(look(bundle, from_above(), 64), vec3(1.6f, 0.4f, 0.6f), 0.005f);
    // Straight up is the sky itself.
    Camera up = from_above();
    up.at = {0, 2, 0};
    expect_near(look(bundle, up), vec3(2, 1, 3), 1e-4f);
    // Half of the sky is dark: a picture of two rows.
    bundle.scene.environment.texture = std::int32_t(
        add_texture(bundle, {.width = 1, .height = 2, .rgba = {}, .radiance = {vec3(1), vec3(0)}}));
    const vec3 level = look(bundle, from_above(), 256);
    // Interpolated between the rows' middles: 1 down to 45 degrees, then linear in the angle.
    // Irradiance over 2 pi: 1/4 + the integral of (3/4 - t/pi... over the rest.
    double sum = 0;
    constexpr int n = 1000;
    for (int i = 0; i < n; ++i) {
        const double theta = (i + 0.5) / n * double(pi) / 2;
        const double radiance = std::min(1.0, 1.5 - 2 * theta / double(pi));
        sum += 2 * radiance * std::cos(theta) * std::sin(theta) * double(pi) / 2 / n;
    }
    expect_near(level, float(sum) * vec3(1.6f, 0.4f, 0.6f), 0.005f);
}

TEST_P(LightTransport, WithoutLightAllIsBlack) {
    EXPECT_EQ(look(floor_of(lambert(vec3(0.5f))), from_above()), vec3(0));
    EXPECT_EQ(look(SceneBundle{}, from_above()), vec3(0));
}

TEST_P(LightTransport, PicturesScaleWithTheirLight) {
    SceneBundle bundle = room_with_ball(lambert(vec3(0.5f)), coated(vec3(0.8f), 0.2f, 1));
    const vec3 usual = look(bundle, at_ball(), 4);
    for (const float scale : {0x1p-20f, 0x1p30f}) {
        bundle.scene.materials[1].emission = vec3(5 * scale);
        expect_near(look(bundle, at_ball(), 4), scale * usual, 1e-3f);
    }
}

TEST_P(LightTransport, ReflectanceIsClamped) {
    SceneBundle bundle = floor_of(lambert({5, 1, -3}));
    add_light(bundle, LightKind::directional, vec3(0), {0, -1, 0}, vec3(pi));
    expect_near(look(bundle, from_above()), vec3(1, 1, 0), 1e-4f);
    const Renderer renderer(bundle.scene, bundle.blobs, {});
    EXPECT_NE(renderer.plan().left_out.back().find("clamped"), std::string::npos);
}

TEST_P(LightTransport, ManyLightsThatAreAllHidden) {
    // Lamps in a closed box above the floor: nothing arrives, and nothing goes wrong.
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    add_shape(bundle, room({-1, 1, -1}, {1, 2, 1}), lambert(vec3(0.9f)));
    for (int i = 0; i < 64; ++i) {
        mat4 place(1);
        place[3] = vec4(0.2f * float(i % 8) - 0.7f, 1.9f, 0.2f * float(i / 8) - 0.7f, 1);
        add_shape(bundle, square(0.05f, 0, false), emitter(vec3(10)), place);
    }
    Camera aside = from_above(3);
    aside.eye.x = aside.at.x = 4;
    EXPECT_EQ(look(bundle, aside), vec3(0));
    // Inside of it, many lamps are the sum of their light, however they are chosen.
    Camera inside;
    inside.eye = {0, 1.5f, 0};
    inside.at = {0.3f, 1, 0.2f};
    const vec3 all = look(bundle, inside, 64);
    for (std::size_t i = 2 + 24; i < bundle.scene.materials.size(); ++i)
        bundle.scene.materials[i].emission = vec3(0);
    const vec3 few = look(bundle, inside, 64);
    for (std::size_t i = 2; i < bundle.scene.materials.size(); ++i)
        bundle.scene.materials[i].emission = vec3(i < 2 + 24 ? 0 : 10);
    expect_near(few + look(bundle, inside, 64), all, 0.03f);
}

TEST_P(LightTransport, TexelsThatAreNotFiniteAreBlack) {
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    Material lamp = emitter(vec3(1));
    lamp.emission_map.texture = std::int32_t(add_texture(
        bundle, {.width = 2, .height = 1, .rgba = {}, .radiance = {vec3(NAN), vec3(4)}}));
    add_shape(bundle, square(1, 2, false), lamp);
    bundle.scene.environment = {.radiance = vec3(0.1f), .texture = lamp.emission_map.texture};
    const vec3 seen = look(bundle, from_above());
    EXPECT_TRUE(is_finite(seen));
    EXPECT_GT(seen.x, 0.1f);
    const Renderer renderer(bundle.scene, bundle.blobs, {});
    const auto& left_out = renderer.plan().left_out;
    EXPECT_TRUE(std::ranges::any_of(
        left_out, [](const std::string& line) { return line.starts_with("1 texels"); }));
}

TEST_P(LightTransport, BouncesAreLimited) {
    SceneBundle bundle;
    add_shape(bundle, room(vec3(-1), vec3(1)), lambert(vec3(0.5f)));
    add_light(bundle, LightKind::point, vec3(0), {0, -1, 0}, vec3(pi));
    Camera camera;
    camera.eye = {0.3f, 0.1f, 0.2f};
    camera.at = {-0.4f, -0.3f, 0};
    camera.fov_y = 90;
    FrameSpec spec = frame_of(GetParam(), {16, 16}, camera, 32);
    // Light that was scattered once more is about albedo times as much, never more.
    std::vector<float> means;
    for (const std::uint32_t bounces : {0, 1, 2, 64}) {
        spec.settings.bounces = bounces;
        means.push_back(mean_radiance(bundle, spec).x);
    }
    spec.settings.bounces = 0;
    spec.extra = spec.extra.with(Channel::indirect);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    for (const TileResult& r : render_all(renderer, spec)) {
        const std::size_t at = channel_offset(spec, Channel::indirect, 256);
        for (std::size_t i = 0; i < 3 * 256; ++i) EXPECT_EQ(r.data[at + i], 0);
    }
    EXPECT_NEAR((means[2] - means[1]) / (means[1] - means[0]), 0.5f, 0.1f);
    EXPECT_NEAR((means[3] - means[2]) / (means[2] - means[1]), 1, 0.15f);
}

TEST_P(LightTransport, DegenerateInputGivesFinitePictures) {
    SceneBundle bundle = floor_of(lambert(vec3(5)));
    Mesh broken = square(1, 0.5f, false);
    broken.positions.insert(broken.positions.end(), {vec3(NAN), vec3(infinity), vec3(0)});
    const auto first = std::uint32_t(broken.positions.size() - 3);
    broken.slots.clear();
    broken.normals.resize(broken.positions.size(), vec3(0));
    broken.texcoords.resize(broken.positions.size(), vec2(NAN));
    broken.triangles.insert(broken.triangles.end(), {{0, 0, 1}, {first, 0, 1}, {0, first + 1, 1}});
    add_shape(bundle, broken, emitter(vec3(1e20f)));
    add_shape(bundle, broken, emitter(vec3(1)), mat4(0));
    add_light(bundle, LightKind::point, {0, 0, 0}, {0, 0, 0}, vec3(1));
    add_light(bundle, LightKind::spot, {0, 0.2f, 0}, {0, 0, 0}, vec3(1));
    bundle.scene.lights.back().inner_angle = bundle.scene.lights.back().outer_angle = 0;
    Camera on_itself, along_up;
    on_itself.at = on_itself.eye;
    along_up.up = along_up.at - along_up.eye;
    for (const Camera& camera : {from_above(), on_itself, along_up}) {
        const FrameSpec spec = frame_of(GetParam(), {20, 18}, camera, 2);
        Renderer renderer(bundle.scene, bundle.blobs, {});
        for (const TileResult& r : render_all(renderer, spec)) {
            const std::size_t pixels = tile_rect(spec.size, r.task.tile).pixels();
            for (std::size_t i = 0; i < 3 * pixels; ++i) EXPECT_TRUE(std::isfinite(r.data[i]));
        }
    }
}

struct MeanAndError {
    vec3 mean{0};
    vec3 error{0};  ///< standard, of the mean
};

/// From pictures with independent seeds.
MeanAndError mean_over_seeds(const SceneBundle& bundle, FrameSpec spec) {
    constexpr int seeds = 8;
    Renderer renderer(bundle.scene, bundle.blobs, {});
    vec3 sum(0), squares(0);
    for (int i = 0; i < seeds; ++i) {
        spec.frame = spec.settings.seed = std::uint32_t(i + 1);
        const vec3 mean = mean_radiance(spec, render_all(renderer, spec));
        sum += mean;
        squares += mean * mean;
    }
    const vec3 mean = sum / float(seeds);
    const vec3 variance = glm::max(squares / float(seeds) - mean * mean, vec3(0));
    return {mean, glm::sqrt(variance / float(seeds - 1))};
}

TEST(Igi, AgreesWithThePathTracerWhereTheBoundTakesMuchAway) {
    // A corner of bright walls, lit by a small lamp: light goes to and fro within the bound.
    SceneBundle bundle;
    add_shape(bundle, room(vec3(-1), vec3(1)), lambert(vec3(0.8f, 0.7f, 0.5f)));
    add_shape(bundle, square(0.3f, 0.999f, false), emitter(vec3(10)));
    Camera camera;
    camera.eye = {0.2f, 0.3f, 0.1f};
    camera.at = {-1, -1, -1};
    camera.fov_y = 60;
    const ImageSize size{24, 24};
    const MeanAndError igi = mean_over_seeds(bundle, frame_of(Integrator::igi, size, camera, 48));
    const MeanAndError path = mean_over_seeds(bundle, frame_of(Integrator::path, size, camera, 96));
    for (int c = 0; c < 3; ++c) {
        EXPECT_LT(igi.error[c], 0.006f * igi.mean[c]);
        EXPECT_NEAR(igi.mean[c], path.mean[c], 4 * std::hypot(igi.error[c], path.error[c]));
    }
}

/// Refined igi against path: equal within what their noise allows, which is little.
void expect_agreement(const SceneBundle& bundle, const Camera& camera, std::uint32_t passes) {
    const ImageSize size{16, 16};
    const auto igi = mean_over_seeds(bundle, frame_of(Integrator::igi, size, camera, passes));
    const auto path = mean_over_seeds(bundle, frame_of(Integrator::path, size, camera, 2 * passes));
    for (int c = 0; c < 3; ++c) {
        const float noise = std::hypot(igi.error[c], path.error[c]);
        EXPECT_LT(noise, 0.015f * path.mean[c]);
        EXPECT_NEAR(igi.mean[c], path.mean[c], 4 * noise);
    }
}

TEST(Igi, AgreesWithThePathTracerOnBroadGloss) {
    expect_agreement(
        room_with_ball(coated({0.6f, 0.5f, 0.4f}, 0.6f), coated({0.9f, 0.6f, 0.3f}, 0.5f, 1)),
        at_ball(), 12);
}

TEST(Igi, AgreesWithThePathTracerOnNarrowGloss) {
    expect_agreement(
        room_with_ball(coated({0.6f, 0.5f, 0.4f}, 0.3f), coated({0.9f, 0.6f, 0.3f}, 0.2f, 1)),
        at_ball(), 12);
}

TEST(Igi, AgreesWithThePathTracerThroughGlassAndBesideMirrors) {
    Material glass = lambert({0.9f, 0.8f, 0.9f});
    glass.transmission = 1;
    glass.roughness = 0;
    SceneBundle bundle = room_with_ball(lambert(vec3(0.5f)), glass);
    MeshBuilder builder;
    builder.ball({0.5f, -0.7f, -0.5f}, 0.3f, 32);
    add_shape(bundle, builder.take(), coated(vec3(0.9f), 0, 1));
    expect_agreement(bundle, at_ball(), 16);
    // A pane that also scatters.
    bundle.scene.materials[2].transmission = 0.5f;
    bundle.scene.materials[2].thin_walled = true;
    bundle.scene.materials[2].specular = 1;
    bundle.scene.materials[2].roughness = 0.3f;
    expect_agreement(bundle, at_ball(), 16);
}

TEST(Igi, AgreesWithThePathTracerUnderASkyWithASun) {
    Texture picture{.width = 32, .height = 16, .rgba = {}};
    for (std::uint32_t i = 0; i < 32 * 16; ++i)
        picture.radiance.emplace_back(0.3f, 0.4f, i < 256 ? 0.6f : 0.1f);
    picture.radiance[3 * 32 + 13] = vec3(300, 250, 200);
    SceneBundle bundle;
    bundle.scene.environment = {.radiance = vec3(1),
                                .texture = std::int32_t(add_texture(bundle, picture)),
                                .rotation = 0.4f};
    add_shape(bundle, square(2, -0.8f), coated(vec3(0.5f), 0.7f));
    MeshBuilder builder;
    builder.ball({-0.4f, -0.4f, -0.4f}, 0.4f, 32);
    add_shape(bundle, builder.take(), coated({0.9f, 0.6f, 0.3f}, 0.3f));
    expect_agreement(bundle, at_ball(), 16);
}

/// A square whose texture has alpha 1 on the left, 0.25 on the right.
SceneBundle half_there(AlphaMode mode) {
    SceneBundle bundle = floor_of(lambert(vec3(0.5f)));
    Material m = emitter(vec3(1));
    m.base_color_map.texture =
        std::int32_t(add_texture(bundle, {.width = 2,
                                          .height = 1,
                                          .wrap_u = Wrap::clamp,
                                          .rgba = {255, 255, 255, 255, 255, 255, 255, 64}}));
    m.alpha_mode = mode;
    add_shape(bundle, square(1, 1), m);
    add_light(bundle, LightKind::directional, vec3(0), {0, -1, 0}, vec3(pi));
    return bundle;
}

TEST_P(LightTransport, RaysPassHoles) {
    Camera left = from_above(3), right = left;
    left.eye.x = left.at.x = -0.9f;
    right.eye.x = right.at.x = 0.9f;
    // Where the mask is there it shines; beside it both eye and light look through.
    SceneBundle bundle = half_there(AlphaMode::mask);
    expect_near(look(bundle, left), vec3(1), 1e-3f);
    const vec3 through = look(bundle, right, 64);
    EXPECT_GT(through.x, 0.5f);
    bundle.scene.materials[1].alpha_mode = AlphaMode::opaque;
    expect_near(look(bundle, right), vec3(1), 1e-3f);
    // Of a quarter of a surface both see a quarter, and so three quarters of the rest.
    bundle = half_there(AlphaMode::blend);
    bundle.scene.materials[1].emission = vec3(0);
    const float quarter = 64.0f / 255;
    expect_near(look(bundle, right, 512), vec3(0.5f * (1 - quarter) * (1 - quarter)), 0.03f);
}

TEST_P(LightTransport, NormalMapsTiltTheSurface) {
    SceneBundle bundle;
    // Towards +u, that is +x on this square, by half a right angle.
    const auto byte = std::uint8_t(std::lround((std::sqrt(0.5) + 1) / 2 * 255));
    Material m = lambert(vec3(0.5f));
    m.normal_map.texture = std::int32_t(add_texture(
        bundle, {.width = 1, .height = 1, .srgb = false, .rgba = {byte, 128, byte, 255}}));
    add_shape(bundle, square(10, 0), m);
    add_light(bundle, LightKind::directional, vec3(0), normalize(vec3(-1, -1, 0)), vec3(pi));
    expect_near(look(bundle, from_above()), vec3(0.5f), 0.01f);
    bundle.scene.lights[0].direction = normalize(vec3(1, -1, 0));
    EXPECT_LT(look(bundle, from_above()).x, 0.01f);
    // Green points up in the picture, which is away from +z here; a mirrored instance likewise.
    bundle.scene.textures[0] = bundle.blobs.insert(
        encode(Texture{.width = 1, .height = 1, .srgb = false, .rgba = {128, byte, byte, 255}}));
    bundle.scene.lights[0].direction = normalize(vec3(0, -1, 1));
    expect_near(look(bundle, from_above()), vec3(0.5f), 0.01f);
    bundle.scene.instances[0].world_from_object[0][0] = -1;
    expect_near(look(bundle, from_above()), vec3(0.5f), 0.01f);
}

TEST_P(LightTransport, WhiteGlassAndCoatsVanishInAFurnace) {
    // All that is seen glows alike, so what neither absorbs nor emits cannot be told from it.
    SceneBundle bundle;
    add_shape(bundle, room(vec3(-1), vec3(1)), emitter(vec3(1)));
    Material white = coated(vec3(1), 0.3f);
    MeshBuilder builder;
    builder.ball({-0.4f, -0.4f, -0.4f}, 0.4f, 32);
    add_shape(bundle, builder.take(), white);
    Material& m = bundle.scene.materials[1];
    expect_near(look(bundle, at_ball(), 16), vec3(1), 0.01f);
    m.roughness = 0.8f;
    expect_near(look(bundle, at_ball(), 16), vec3(1), 0.01f);
    m.transmission = 1;
    m.roughness = 0;
    expect_near(look(bundle, at_ball(), 16), vec3(1), 0.002f);
    m.thin_walled = true;
    expect_near(look(bundle, at_ball(), 16), vec3(1), 0.002f);
    m.transmission = 0.4f;
    m.roughness = 0.3f;
    expect_near(look(bundle, at_ball(), 16), vec3(1), 0.01f);
}

INSTANTIATE_TEST_SUITE_P(Both, LightTransport, testing::Values(Integrator::path, Integrator::igi),
                         [](const auto& i) { return i.param == Integrator::igi ? "igi" : "path"; });

// ---- Many lights --------------------------------------------------------------------------------

FrameSpec tracked_frame(std::uint32_t passes, std::uint32_t seed = 0) {
    FrameSpec spec = frame_of(Integrator::igi, {32, 32}, in_right_room(), passes);
    // Many light paths for few pixels.
    spec.settings.interleave = 9;
    spec.settings.seed = seed;
    return spec;
}

/// Sums over all results.
std::map<std::uint32_t, double> sums_of_lights(const std::vector<TileResult>& results) {
    std::map<std::uint32_t, double> sums;
    for (const TileResult& r : results)
        for (const LightEstimate& e : r.lights) sums[e.light] += double(e.radiance);
    return sums;
}

TEST(LightTracking, ConvergesToThePathTracersPicture) {
    const SceneBundle bundle = two_rooms(0.3f);
    const FrameSpec path = frame_of(Integrator::path, {32, 32}, in_right_room(), 256);
    expect_near(mean_radiance(bundle, tracked_frame(96)), mean_radiance(bundle, path), 0.01f);
}

TEST(LightTracking, LightThroughASlitIsNotLost) {
    // All lamps are beyond it, and few paths find their way.
    const SceneBundle bundle = two_rooms(0.05f, false);
    const FrameSpec path = frame_of(Integrator::path, {32, 32}, in_right_room(), 256);
    expect_near(mean_radiance(bundle, tracked_frame(32)), mean_radiance(bundle, path), 0.15f);
}

TEST(LightTracking, AllLampsOccludedLeaveTheRoomBlack) {
    const SceneBundle bundle = two_rooms(0, false);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const FrameSpec spec = tracked_frame(2);
    const std::vector<TileResult> results = render_all(renderer, spec);
    EXPECT_EQ(mean_radiance(spec, results), vec3(0));
    for (const TileResult& r : results) {
        EXPECT_EQ(r.sanitised, 0u);
        EXPECT_TRUE(r.lights.empty());
        EXPECT_EQ(r.active_lights, 0u);
    }
}

TEST(LightTracking, ActiveLightsAreThoseOfTheRoom) {
    const SceneBundle bundle = two_rooms(0);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const std::vector<TileResult> results = render_all(renderer, tracked_frame(1));
    // Two triangles a lamp; some neighbours beyond the wall stand in.
    EXPECT_GE(results.front().active_lights, 80u);
    EXPECT_LE(results.front().active_lights, 100u);
}

TEST(LightTracking, EstimatesAddUpToThePicture) {
    const SceneBundle bundle = two_rooms(0.3f);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const FrameSpec spec = tracked_frame(4);
    const std::vector<TileResult> results = render_all(renderer, spec);
    double sum = 0;
    for (const auto& [light, radiance] : sums_of_lights(results)) sum += radiance;
    const double shown = double(mean_component(mean_radiance(spec, results))) *
                         double(spec.size.pixels()) * spec.settings.passes;
    EXPECT_NEAR(sum, shown, 1e-4 * shown);
}

TEST(LightTracking, EstimatesOfAFrameAreNearTheConvergedOnes) {
    const SceneBundle bundle = two_rooms(0.3f);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    FrameSpec spec = tracked_frame(8);
    spec.size = {64, 64};
    const auto once = sums_of_lights(render_all(renderer, spec));
    FrameSpec longer = tracked_frame(64, 1);
    longer.frame = 2;
    const auto converged = sums_of_lights(render_all(renderer, longer));
    double sum = 0, sum_once = 0;
    for (const auto& [light, radiance] : converged) sum += radiance;
    for (const auto& [light, radiance] : once) sum_once += radiance;
    // The triangles of a lamp are one light.
    double squares = 0;
    int great = 0;
    for (std::uint32_t light = 0; light < 160; light += 2) {
        const auto share = [&](const auto& lights, double all) {
            const auto of = [&](std::uint32_t i) {
                return lights.contains(i) ? lights.at(i) / all : 0.0;
            };
            return of(light) + of(light + 1);
        };
        if (share(converged, sum) < 0.02) continue;
        squares += std::pow(share(once, sum_once) / share(converged, sum) - 1, 2);
        ++great;
    }
    EXPECT_GT(great, 10);
    EXPECT_LT(std::sqrt(squares / great), 0.1);
}

TEST(LightTracking, WhatIsRecalledChangesNoiseOnly) {
    const SceneBundle bundle = two_rooms(0.3f);
    FrameSpec spec = tracked_frame(32);
    const vec3 without = mean_radiance(bundle, spec);
    // Nonsense, as a scene that has changed would give.
    spec.lights = {{0, 5}, {17, 1}, {1000, 3}};
    expect_near(mean_radiance(bundle, spec), without, 0.015f);
}

TEST(TextureLookup, StartsAtTheTopLeftAndWraps) {
    Texture t{.width = 2, .height = 2, .srgb = false, .rgba = {}};
    t.rgba = {255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255, 255, 255, 255, 255};
    EXPECT_EQ(lookup(t, {0.25f, 0.25f}), vec4(1, 0, 0, 1));
    EXPECT_EQ(lookup(t, {0.75f, 0.25f}), vec4(0, 1, 0, 1));
    EXPECT_EQ(lookup(t, {0.25f, 0.75f}), vec4(0, 0, 1, 1));
    EXPECT_EQ(lookup(t, {0.5f, 0.25f}), vec4(0.5f, 0.5f, 0, 1));
    EXPECT_EQ(lookup(t, {-0.75f, 1.25f}), vec4(1, 0, 0, 1));
    t.wrap_u = t.wrap_v = Wrap::mirror;
    EXPECT_EQ(lookup(t, {-0.25f, 0.25f}), vec4(1, 0, 0, 1));
    EXPECT_EQ(lookup(t, {1.25f, 0.25f}), vec4(0, 1, 0, 1));
    t.wrap_u = t.wrap_v = Wrap::clamp;
    EXPECT_EQ(lookup(t, {7, -3}), vec4(0, 1, 0, 1));
    EXPECT_EQ(lookup(t, {NAN, 0}), vec4(0));
    EXPECT_EQ(lookup(t, {infinity, 0}), vec4(0));
}

TEST(TextureLookup, TransformTurnsCounterClockwiseAsSeen) {
    TextureMap map;
    map.scale = {2, 3};
    map.rotation = pi / 2;
    map.offset = {10, 20};
    const vec2 uv = apply(map, {1, 1});
    EXPECT_NEAR(uv.x, 13, 1e-5f);
    EXPECT_NEAR(uv.y, 18, 1e-5f);
}

}  // namespace
}  // namespace tessera
