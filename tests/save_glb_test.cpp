// load_gltf(save_glb(scene)) is the scene again; saving that gives the same bytes of geometry.

#include <gtest/gtest.h>

#include "common/animate.h"
#include "common/generator.h"
#include "common/scene_builder.h"
#include "common/scene_io.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

/// One corner as a file keeps it.
struct CornerValues {
    vec3 position{0}, normal{0};
    vec2 texcoord{0};

    bool operator==(const CornerValues&) const = default;
};

bool is_textured(const Material& m) {
    return m.base_color_map.texture >= 0 || m.metallic_roughness_map.texture >= 0 ||
           m.emission_map.texture >= 0 || m.normal_map.texture >= 0;
}

/// The corners of an object's triangles by material: what glTF keeps of a mesh, which is neither
/// how vertices are shared, nor the order of slots, nor texture coordinates that nobody can see.
std::vector<std::vector<CornerValues>> by_material(const SceneBundle& bundle,
                                                   const Object& object) {
    const Mesh mesh = mesh_of(bundle, object.mesh);
    std::vector<std::vector<CornerValues>> corners(bundle.scene.materials.size());
    for (std::size_t i = 0; i < mesh.triangles.size(); ++i) {
        const std::uint32_t m = object.materials.at(mesh.slots.empty() ? 0 : mesh.slots[i]);
        const bool textured = !mesh.texcoords.empty() && is_textured(bundle.scene.materials[m]);
        for (int k = 0; k < 3; ++k) {
            const std::uint32_t v = mesh.triangles[i][k];
            corners.at(m).push_back({mesh.positions[v],
                                     mesh.normals.empty() ? vec3(0) : mesh.normals[v],
                                     textured ? mesh.texcoords[v] : vec2(0)});
        }
    }
    return corners;
}

SceneBundle round_trip(const SceneBundle& bundle) {
    const TempDir dir;
    save_glb(bundle, dir.file("a.glb"));
    LoadedScene loaded = load_gltf(dir.file("a.glb"));
    EXPECT_TRUE(loaded.notes.empty()) << loaded.notes.at(0);
    return std::move(loaded.bundle);
}

void expect_near(const vec3& a, const vec3& b) {
    EXPECT_LT(length(a - b), 1e-5f * (1 + length(b))) << a.x << " " << a.y << " " << a.z;
}

void expect_same(const SceneBundle& a, const SceneBundle& b) {
    ASSERT_EQ(a.scene.materials.size(), b.scene.materials.size());
    for (std::size_t i = 0; i < a.scene.materials.size(); ++i)
        EXPECT_EQ(a.scene.materials[i], b.scene.materials[i]) << a.scene.materials[i].name;
    EXPECT_EQ(a.scene.textures, b.scene.textures);
    EXPECT_EQ(a.scene.instances, b.scene.instances);
    ASSERT_EQ(a.scene.objects.size(), b.scene.objects.size());
    for (std::size_t i = 0; i < a.scene.objects.size(); ++i) {
        EXPECT_EQ(a.scene.objects[i].name, b.scene.objects[i].name);
        EXPECT_EQ(by_material(a, a.scene.objects[i]), by_material(b, b.scene.objects[i]));
    }
    ASSERT_EQ(a.scene.cameras.size(), b.scene.cameras.size());
    for (std::size_t i = 0; i < a.scene.cameras.size(); ++i) {
        const Camera &ca = a.scene.cameras[i], &cb = b.scene.cameras[i];
        EXPECT_EQ(ca.name, cb.name);
        EXPECT_EQ(ca.eye, cb.eye);
        expect_near(ca.at, cb.at);
        EXPECT_NEAR(ca.fov_y, cb.fov_y, 1e-4f);
        // The node keeps the part of `up` that is across the view.
        const vec3 across = normalize(cross(ca.at - ca.eye, ca.up));
        expect_near(across, normalize(cross(cb.at - cb.eye, cb.up)));
    }
    ASSERT_EQ(a.scene.lights.size(), b.scene.lights.size());
    for (std::size_t i = 0; i < a.scene.lights.size(); ++i) {
        const Light &la = a.scene.lights[i], &lb = b.scene.lights[i];
        EXPECT_EQ(la.name, lb.name);
        EXPECT_EQ(la.kind, lb.kind);
        EXPECT_EQ(la.position, lb.position);
        EXPECT_EQ(la.intensity, lb.intensity);
        if (la.kind != LightKind::point) expect_near(la.direction, lb.direction);
        if (la.kind == LightKind::spot) {
            EXPECT_EQ(la.inner_angle, lb.inner_angle);
            EXPECT_EQ(la.outer_angle, lb.outer_angle);
        }
    }
}

TEST(SaveGlb, generated_scenes_come_back) {
    for (const GeneratedScene& scene : generated_scenes()) {
        SCOPED_TRACE(scene.name);
        SceneBundle bundle = *generate_scene(scene.name);
        bundle.motion = {};
        for (Instance& instance : bundle.scene.instances) instance.moves = false;
        const SceneBundle back = round_trip(bundle);
        expect_sound(back);
        expect_same(bundle, back);
        expect_same(back, round_trip(back));
    }
}

TEST(SaveGlb, everything_a_scene_holds_comes_back) {
    SceneBundle bundle;
    Texture texture{.width = 2,
                    .height = 1,
                    .wrap_u = Wrap::mirror,
                    .wrap_v = Wrap::clamp,
                    .rgba = {1, 2, 3, 255, 200, 100, 50, 0}};
    const auto colours = std::int32_t(add_texture(bundle, texture));
    texture.srgb = false;
    const auto data = std::int32_t(add_texture(bundle, texture));
    const auto plain = add_material(bundle, {.name = "plain", .roughness = 0.3f});
    const auto lamp = add_material(
        bundle, {.name = "lamp",
                 .base_color = {0.1f, 0.2f, 0.3f},
                 .base_color_map = {.texture = colours, .offset = {0.1f, 0.2f}, .rotation = 0.7f},
                 .metallic = 0.6f,
                 .metallic_roughness_map = {.texture = data, .scale = {2, 3}},
                 .specular = 0.7f,
                 .ior = 1.3f,
                 .transmission = 0.4f,
                 .transmission_map = {.texture = data},
                 .thin_walled = true,
                 .emission = {17.3f, 0.01f, 4},
                 .emission_map = {.texture = colours},
                 .two_sided_emission = true,
                 .normal_map = {.texture = data},
                 .normal_scale = 0.6f,
                 .alpha_mode = AlphaMode::mask,
                 .alpha = 0.8f,
                 .alpha_cutoff = 0.3f});
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0.3f}, {0, 1, 0}};
    mesh.normals = {{0, 0, 1}, {0, 0.6f, 0.8f}, {0, 0, 1}, {0.6f, 0, 0.8f}};
    mesh.texcoords = {{0, 0}, {1, 0}, {1, 1}, {0, 1.5f}};
    mesh.triangles = {{0, 1, 2}, {0, 2, 3}};
    mesh.slots = {1, 0};
    const auto object = add_object(bundle, "square", mesh, {lamp, plain});
    mesh.texcoords.clear();
    mesh.normals.clear();
    mesh.slots.clear();
    const auto flat = add_object(bundle, "flat", mesh, {plain});
    add_instance(bundle, "first", object);
    add_instance(
        bundle, "mirrored and sheared", flat,
        mat4(vec4(-1, 0.5f, 0, 0), vec4(0, 2, 0, 0), vec4(0.25f, 0, 1, 0), vec4(3, 4, 5, 1)));
    for (const LightKind kind : {LightKind::point, LightKind::spot, LightKind::directional})
        bundle.scene.lights.push_back({.name = "light",
                                       .kind = kind,
                                       .position = {1, 2, 3},
                                       .direction = normalize(vec3(1, -2, 0.5f)),
                                       .intensity = {100, 20.5f, 0.3f},
                                       .inner_angle = 0.2f,
                                       .outer_angle = 0.4f});
    bundle.scene.lights[2].direction = {0, -1, 0};
    bundle.scene.cameras = {
        {.name = "a", .eye = {1, 2, 3}, .at = {-4, 0, 2}, .up = {0, 1, 0}, .fov_y = 33},
        {.name = "b", .eye = {0, 9, 0}, .at = {0, 0, 0}, .up = {0, 0, -1}, .fov_y = 70}};
    const SceneBundle back = round_trip(bundle);
    expect_same(bundle, back);
    for (const std::int32_t i : {colours, data})
        EXPECT_EQ(texture_of(back, i), texture_of(bundle, i));
}

TEST(SaveGlb, an_empty_scene_is_a_file_too) { EXPECT_EQ(round_trip({}).scene, Scene{}); }

TEST(SaveGlb, a_folder_that_is_not_there_is_the_users_fault) {
    const TempDir dir;
    const std::string message =
        user_error([&] { save_glb({}, dir.file("no") / "such" / "a.glb"); });
    EXPECT_NE(message.find("a.glb: cannot write"), std::string::npos);
}

TEST(SaveGlb, what_moves_goes_on_moving) {
    const TempDir dir;
    const SceneBundle robots = *generate_scene("robots");
    save_glb(robots, dir.file("robots.glb"));
    const LoadedScene loaded = load_gltf(dir.file("robots.glb"));
    EXPECT_EQ(loaded.bundle.scene.instances.size(), robots.scene.instances.size());
    for (const double seconds : {0.0, 0.7, 11.0, 24.0}) {
        const MotionEdits before = edits_at(robots.scene, robots.motion, seconds);
        const Scene moved = bundle_at(loaded.bundle, seconds).scene;
        for (const EditOperation& operation : before.operations) {
            const auto& wanted = std::get<SetTransform>(operation);
            const auto got = std::ranges::find(moved.instances, wanted.instance, &Instance::name);
            ASSERT_NE(got, moved.instances.end()) << wanted.instance;
            for (int column = 0; column < 4; ++column)
                EXPECT_LT(length(got->world_from_object[column] - wanted.world_from_object[column]),
                          1e-4f);
        }
    }
}

}  // namespace
}  // namespace tessera
