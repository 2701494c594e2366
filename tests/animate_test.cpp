// Motion: laws and closed forms of interpolation, hierarchies, morph targets and skins; and that
// the motion of real files leads to edits that can be done.

#include "common/animate.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <glm/gtc/matrix_transform.hpp>

#include "common/scene_builder.h"
#include "common/scene_io.h"
#include "tests/scene_checks.h"

namespace tessera {
namespace {

constexpr auto cubic = Interpolation::cubic_spline;

Track track_of(Interpolation interpolation, std::uint32_t components, std::vector<float> times,
               std::vector<float> values) {
    return {interpolation, components, std::move(times), std::move(values)};
}

/// A key every second; tangents where there are any.
Track random_track(Interpolation interpolation, std::uint32_t seed) {
    Track track{.interpolation = interpolation, .times = {}, .values = {}};
    for (int key = 0; key < 5; ++key) {
        track.times.push_back(float(key * key) + 0.5f);
        for (int i = 0; i < (interpolation == cubic ? 9 : 3); ++i)
            track.values.push_back(std::sin(float(seed * 100 + unsigned(key * 9 + i))));
    }
    return track;
}

TEST(Animate, EveryInterpolationPassesItsKeysAndStaysAtItsEnds) {
    for (const Interpolation interpolation : {Interpolation::step, Interpolation::linear, cubic}) {
        const Track track = random_track(interpolation, 3);
        for (std::size_t key = 0; key < track.times.size(); ++key) {
            const std::size_t value = interpolation == cubic ? 9 * key + 3 : 3 * key;
            const std::vector<float> at = sample(track, double(track.times[key]));
            for (std::size_t c = 0; c < 3; ++c) EXPECT_EQ(at[c], track.values[value + c]);
        }
        EXPECT_EQ(sample(track, -7), sample(track, double(track.times.front())));
        EXPECT_EQ(sample(track, 1e9), sample(track, double(track.times.back())));
    }
}

TEST(Animate, StepHoldsAndLinearHalves) {
    EXPECT_EQ(sample(track_of(Interpolation::step, 1, {1, 3}, {5, 9}), 2.99)[0], 5);
    EXPECT_EQ(sample(track_of(Interpolation::linear, 1, {1, 3}, {5, 9}), 2)[0], 7);
}

TEST(Animate, ASplineIsTheCubicOfItsTangents) {
    const auto p = [](float t) { return 2 + 3 * t - 4 * t * t + 0.5f * t * t * t; };
    const auto slope = [](float t) { return 3 - 8 * t + 1.5f * t * t; };
    Track track{.interpolation = cubic, .components = 1, .times = {}, .values = {}};
    for (const float t : {0.0f, 0.7f, 2.0f, 2.5f}) {
        track.times.push_back(t);
        for (const float v : {slope(t), p(t), slope(t)}) track.values.push_back(v);
    }
    for (float t = 0; t < 2.5f; t += 0.06f) EXPECT_NEAR(sample(track, double(t))[0], p(t), 1e-5f);
}

TEST(Animate, RotationHalfwayIsHalfTheAngle) {
    const glm::quat from = glm::angleAxis(0.2f, vec3(0, 1, 0));
    const glm::quat to = glm::angleAxis(1.6f, vec3(0, 1, 0));
    // Turned by -to as by to: the short way is taken.
    for (const float sign : {1.0f, -1.0f}) {
        const Track track = track_of(
            Interpolation::linear, 4, {0, 2},
            {from.x, from.y, from.z, from.w, sign * to.x, sign * to.y, sign * to.z, sign * to.w});
        const glm::quat half = sample_rotation(track, 1);
        EXPECT_NEAR(std::abs(glm::dot(half, glm::angleAxis(0.9f, vec3(0, 1, 0)))), 1, 1e-6f);
    }
}

/// A turning arm that carries a sliding hand.
Motion arm() {
    Motion motion;
    const glm::quat quarter = glm::angleAxis(pi / 2, vec3(0, 0, 1));
    motion.tracks = {track_of(Interpolation::linear, 4, {0, 1},
                              {0, 0, 0, 1, quarter.x, quarter.y, quarter.z, quarter.w}),
                     track_of(Interpolation::linear, 3, {0, 1}, {1, 0, 0, 3, 0, 0})};
    motion.nodes = {{.weights = {}, .rotation_track = 0},
                    {.parent = 0, .weights = {}, .translation_track = 1}};
    return motion;
}

TEST(Animate, ChildrenFollowTheirParents) {
    const auto hand = [](double t) { return vec3(node_transforms(arm(), t)[1][3]); };
    EXPECT_NEAR(length(hand(0) - vec3(1, 0, 0)), 0, 1e-6f);
    EXPECT_NEAR(length(hand(0.5) - vec3(2, 2, 0) / std::sqrt(2.0f)), 0, 1e-5f);
    EXPECT_NEAR(length(hand(1) - vec3(0, 3, 0)), 0, 1e-5f);
    EXPECT_EQ(arm().duration(), 1);
}

SoftMesh triangle() {
    SoftMesh mesh;
    mesh.rest = {{vec3(0), vec3(1, 0, 0), vec3(0, 1, 0)}, std::vector<vec3>(3, vec3(0, 0, 1))};
    mesh.targets = {{{vec3(0, 0, 1), vec3(0), vec3(0)}, {}}, {{vec3(1), vec3(1), vec3(1)}, {}}};
    mesh.joints.assign(3, {0, 1, 0, 0});
    mesh.joint_weights.assign(3, vec4(0.25f, 0.75f, 0, 0));
    return mesh;
}

void expect_near(const std::vector<vec3>& a, const std::vector<vec3>& b) {
    ASSERT_EQ(a.size(), b.size());
    for (std::size_t i = 0; i < a.size(); ++i) EXPECT_NEAR(length(a[i] - b[i]), 0, 1e-5f);
}

TEST(Animate, MorphTargetsAddUp) {
    Motion motion = arm();
    motion.soft_meshes = {triangle()};
    motion.nodes[0].weights = {0.5f, 2};
    const Shape shape = deformed_shape(motion, {.object = "x"}, 0, {});
    const std::vector<vec3> rest = triangle().rest.positions;
    expect_near(shape.positions,
                {rest[0] + vec3(2, 2, 2.5f), rest[1] + vec3(2), rest[2] + vec3(2)});
    motion.nodes[0].weights = {0, 0};
    EXPECT_EQ(deformed_shape(motion, {.object = "x"}, 0, {}), triangle().rest);
}

TEST(Animate, SkinsFollowTheirJoints) {
    Motion motion = arm();
    motion.soft_meshes = {triangle()};
    // At rest, a joint undoes what its node does.
    const std::vector<glm::dmat4> rest = node_transforms(motion, 0);
    motion.skins = {{{0, 1}, {inverse(rest[0]), inverse(rest[1])}}};
    const Motion::Deformed object{.object = "x", .skin = 0};
    expect_near(deformed_shape(motion, object, 0, rest).positions, triangle().rest.positions);
    // Joints that move alike carry the mesh as if it were rigid.
    const mat4 moved = glm::translate(glm::rotate(mat4(1), 0.7f, vec3(1, 0, 0)), vec3(1, 2, 3));
    const std::vector<glm::dmat4> both = {glm::dmat4(moved), glm::dmat4(moved) * rest[1]};
    const Shape shape = deformed_shape(motion, object, 0, both);
    std::vector<vec3> positions, normals;
    for (const vec3& p : triangle().rest.positions) positions.push_back(vec3(moved * vec4(p, 1)));
    for (const vec3& n : triangle().rest.normals) normals.push_back(mat3(moved) * n);
    expect_near(shape.positions, positions);
    expect_near(shape.normals, normals);
}

TEST(Animate, WhatIsNotThereIsLeftOut) {
    SceneBundle bundle;
    Mesh corner;
    corner.positions = {vec3(0), vec3(1, 0, 0), vec3(0, 1, 0)};
    corner.triangles = {{0, 1, 2}};
    const auto object = add_object(bundle, "hand", corner, {});
    add_instance(bundle, "hand", object);
    bundle.motion = arm();
    bundle.motion.instances = {{"hand", 1}, {"lost", 1}};
    bundle.motion.lights = {{"lost", 1}};
    bundle.motion.cameras = {{"lost", 1}};
    const MotionEdits edits = edits_at(bundle.scene, bundle.motion, 1);
    EXPECT_EQ(edits.operations.size(), 1u);
    const Instance hand = bundle_at(bundle, 1).scene.instances[0];
    EXPECT_NEAR(length(vec3(hand.world_from_object[3]) - vec3(0, 3, 0)), 0, 1e-5f);
    EXPECT_TRUE(hand.moves);
}

class RealFile : public testing::TestWithParam<std::string> {};

TEST_P(RealFile, MovesByEditsThatCanBeDone) {
    const std::filesystem::path folder(TESSERA_SHARED_DIR "/scenes/gltf");
    if (!std::filesystem::exists(folder)) GTEST_SKIP() << "no " << folder;
    const LoadedScene loaded = load_gltf(folder / GetParam() / "glTF" / (GetParam() + ".gltf"));
    const SceneBundle& bundle = loaded.bundle;
    ASSERT_FALSE(bundle.motion.empty());
    Scene now = bundle.scene;
    for (int i = 0; i <= 4; ++i) {
        const double seconds = bundle.motion.duration() * i / 4;
        const MotionEdits edits = edits_at(bundle.scene, bundle.motion, seconds);
        EXPECT_FALSE(edits.operations.empty());
        const EditedScene edited = apply_edits(bundle.scene, edits.operations);
        EXPECT_TRUE(edited.complaints.empty()) << edited.complaints.front();
        EXPECT_NO_THROW(validate(edited.scene));
        EXPECT_TRUE(i == 0 || i == 4 || edited.scene != now) << seconds;
        now = edited.scene;
        for (const Object& object : now.objects) {
            if (object.shape < 0) continue;
            const auto blob = edits.blobs.find(now.shapes[std::size_t(object.shape)]);
            ASSERT_NE(blob, nullptr);
            const Mesh rest = mesh_of(bundle, object.mesh);
            const Mesh mesh = reshaped(rest, decode_shape(*blob));
            for (const vec3& p : mesh.positions) EXPECT_TRUE(is_finite(p));
        }
    }
}

INSTANTIATE_TEST_SUITE_P(Animate, RealFile,
                         testing::Values("AnimatedCube", "AnimatedMorphCube", "InterpolationTest",
                                         "RecursiveSkeletons", "SimpleMorph", "SimpleSkin"),
                         [](const auto& file) { return file.param; });

}  // namespace
}  // namespace tessera
