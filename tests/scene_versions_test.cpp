// The law of versions: a renderer that took over what it could from the version before gives the
// same pictures, bit for bit, as one that starts from nothing.

#include <gtest/gtest.h>

#include <cstring>
#include <glm/gtc/matrix_transform.hpp>
#include <random>

#include "common/generator.h"
#include "common/scene_edit.h"
#include "worker/bench/render_fixture.h"
#include "worker/tracer.h"

namespace tessera {
namespace {

/// A room of balls and blocks: some alone, some in many places, one that deforms, a picture on the
/// wall, holes, a sky, lamps of all kinds.
SceneBundle playroom() {
    SceneBundle bundle;
    Texture picture{.width = 4, .height = 4, .rgba = {}};
    for (int i = 0; i < 64; ++i) picture.rgba.push_back(std::uint8_t(i % 4 == 3 ? 90 : 13 * i));
    Material holes = lambert(vec3(0.7f));
    holes.name = "holes";
    holes.base_color_map.texture = std::int32_t(add_texture(bundle, picture));
    holes.alpha_mode = AlphaMode::mask;
    const auto plain = add_material(bundle, {.name = "plain", .base_color = vec3(0.6f)});
    const auto lamp =
        add_material(bundle, {.name = "lamp", .base_color = vec3(0), .emission = vec3(9)});
    const auto holed = add_material(bundle, holes);
    const auto add = [&](const char* name, Mesh mesh, std::uint32_t material) {
        return add_object(bundle, name, mesh, {material});
    };
    MeshBuilder ball, block;
    ball.ball(vec3(0), 0.3f, 12);
    block.box(vec3(-0.2f), vec3(0.2f));
    const Mesh soft = square(0.8f, 0.1f);
    const auto room_object = add("room", room(vec3(-2), vec3(2)), plain);
    const auto ball_object = add("ball", ball.take(), plain);
    const auto block_object = add("block", block.take(), plain);
    const auto lamp_object = add("lamp", square(0.5f, 1.9f, false), lamp);
    const auto soft_object = add("soft", soft, holed);
    bundle.scene.objects[soft_object].shape =
        std::int32_t(add_shape(bundle, {soft.positions, soft.normals}));
    add_instance(bundle, "room", room_object);
    for (int i = 0; i < 5; ++i)
        add_instance(bundle, "ball " + std::to_string(i), ball_object,
                     glm::translate(mat4(1), vec3(0.7f * float(i) - 1.4f, -1.6f, 0.2f)));
    add_instance(bundle, "block", block_object, glm::translate(mat4(1), vec3(0.5f, -1.2f, -1)));
    add_instance(bundle, "lamp", lamp_object);
    add_instance(bundle, "soft", soft_object, glm::translate(mat4(1), vec3(0, -0.9f, -0.5f)));
    bundle.scene.lights.push_back({.name = "bulb", .position = {1, 1, 1}, .intensity = vec3(2)});
    bundle.scene.environment.radiance = vec3(0.1f);
    bundle.scene.cameras.push_back({.name = "door", .eye = {0, 0, 1.9f}, .at = {0, -0.6f, 0}});
    return bundle;
}

/// Edits of everything that can be edited.
class RandomEdits {
public:
    explicit RandomEdits(unsigned seed) : random_(seed) {}

    EditOperation one(SceneBundle& bundle) {
        switch (below(8)) {
            case 0:
                return SetMaterial{.material = below(2) ? "plain" : "lamp",
                                   .base_color = place() * 0.2f + 0.5f};
            case 1:
                return SetLight{.light = "bulb", .position = place()};
            case 2:
                return SetMaterial{.material = "lamp", .emission = place() + 2.0f};
            case 3:
                return SetShape{"soft", bundle.blobs.insert(encode(shape()))};
            case 4:
                return CreateInstance{"more " + std::to_string(random_()), "ball", transform()};
            case 5:
                return DeleteInstance{"ball " + std::to_string(below(5))};
            default:
                return SetTransform{any(bundle.scene.instances).name, transform()};
        }
    }

private:
    unsigned below(std::size_t n) { return unsigned(random_() % n); }
    template <class T>
    const T& any(const std::vector<T>& table) {
        return table[below(table.size())];
    }
    float real() { return float(below(2000)) / 1000 - 1; }
    vec3 place() { return {real(), real(), real()}; }
    mat4 transform() {
        const mat4 turned = glm::rotate(mat4(1), 3 * real(), normalize(place() + vec3(0, 2, 0)));
        return glm::translate(mat4(1), place()) * turned;
    }
    Shape shape() {
        Mesh mesh = square(0.8f, 0.1f);
        for (vec3& p : mesh.positions) p += 0.2f * place();
        return {mesh.positions, {}};
    }

    std::mt19937 random_;
};

std::vector<TileResult> picture(Renderer& renderer, const FrameSpec& spec) {
    std::vector<TileResult> results = render_all(renderer, spec);
    renderer.end_frame(spec.frame);
    return results;
}

void expect_same_bits(const std::vector<TileResult>& a, const std::vector<TileResult>& b) {
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) {
        ASSERT_EQ(a[i].data.size(), b[i].data.size());
        ASSERT_EQ(std::memcmp(a[i].data.data(), b[i].data.data(), a[i].data.size() * 4), 0);
        EXPECT_EQ(a[i].rays, b[i].rays);
    }
}

class VersionsOf : public testing::TestWithParam<std::tuple<Integrator, TracerKind>> {};

TEST_P(VersionsOf, AScenePictureDoesNotTellItsHistory) {
    for (const unsigned seed : {1u, 2u, 3u}) {
        SceneBundle bundle = playroom();
        RandomEdits edits(seed);
        FrameSpec spec = frame_of(std::get<0>(GetParam()), {32, 24}, bundle.scene.cameras[0], 2);
        spec.settings.tracer = std::get<1>(GetParam());
        auto renderer = std::make_unique<Renderer>(bundle.scene, bundle.blobs, RendererConfig{});
        for (int version = 0; version < 12; ++version) {
            std::vector<EditOperation> operations;
            for (int i = 0; i <= version % 3; ++i) operations.push_back(edits.one(bundle));
            bundle.scene = apply_edits(std::move(bundle.scene), operations).scene;
            renderer = std::make_unique<Renderer>(bundle.scene, bundle.blobs, RendererConfig{},
                                                  renderer.get());
            // Versions that nobody looks at are followed, too.
            if (version % 4 == 2) continue;
            Renderer fresh(bundle.scene, bundle.blobs, {});
            expect_same_bits(picture(*renderer, spec), picture(fresh, spec));
        }
    }
}

INSTANTIATE_TEST_SUITE_P(Each, VersionsOf,
                         testing::Combine(testing::Values(Integrator::path, Integrator::igi),
                                          testing::Values(TracerKind::kdtree, TracerKind::embree)));

TEST(Versions, TheLastOneIsNotNeeded) {
    SceneBundle bundle = playroom();
    FrameSpec spec = frame_of(Integrator::igi, {32, 24}, bundle.scene.cameras[0], 1);
    spec.settings.tracer = TracerKind::kdtree;
    auto first = std::make_unique<Renderer>(bundle.scene, bundle.blobs, RendererConfig{});
    first->prepare(TracerKind::kdtree);
    bundle.scene = apply_edits(bundle.scene, {SetTransform{"ball 1", mat4(1)}}).scene;
    Renderer second(bundle.scene, bundle.blobs, {}, first.get());
    const auto before = picture(second, spec);
    first.reset();
    expect_same_bits(before, picture(second, spec));
}

TEST(Versions, AShapeMustFitItsMesh) {
    SceneBundle bundle = playroom();
    const BlobId wrong = bundle.blobs.insert(encode(Shape{{vec3(0)}, {}}));
    bundle.scene = apply_edits(bundle.scene, {SetShape{"soft", wrong}}).scene;
    EXPECT_THROW(Renderer(bundle.scene, bundle.blobs, {}), std::runtime_error);
}

/// A shape equal to the mesh is the mesh, as far as rays can tell.
TEST(Versions, AShapeStandsForTheVertices) {
    SceneBundle bundle = playroom();
    SceneBundle whole = bundle;
    const Mesh mesh = square(0.8f, 0.4f);
    const BlobId raised = bundle.blobs.insert(encode(Shape{mesh.positions, mesh.normals}));
    bundle.scene = apply_edits(bundle.scene, {SetShape{"soft", raised}}).scene;
    Object& soft = *std::ranges::find(whole.scene.objects, "soft", &Object::name);
    soft.mesh = add_mesh(whole, mesh);
    soft.shape = -1;
    const FrameSpec spec = frame_of(Integrator::path, {32, 24}, bundle.scene.cameras[0], 16);
    const vec3 a = mean_radiance(bundle, spec), b = mean_radiance(whole, spec);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(a[c], b[c], 0.02f * b[c]);
}

}  // namespace
}  // namespace tessera
