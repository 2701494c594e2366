// Generated scenes are sound, lit, seen from inside, and the same every time.

#include "common/generator.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "common/scene_io.h"
#include "tests/scene_checks.h"

namespace tessera {
namespace {

class EveryGenerator : public testing::TestWithParam<std::string> {};

TEST_P(EveryGenerator, makes_a_sound_scene) {
    const SceneBundle bundle = *generate_scene(GetParam());
    expect_sound(bundle);
    for (const BlobId& id : blobs_of(bundle.scene)) EXPECT_TRUE(bundle.blobs.contains(id));
}

TEST_P(EveryGenerator, wears_every_material_and_places_every_object) {
    const Scene scene = generate_scene(GetParam())->scene;
    std::vector<bool> worn(scene.materials.size()), placed(scene.objects.size());
    for (const Instance& instance : scene.instances) placed[instance.object] = true;
    for (const Object& object : scene.objects)
        for (const std::uint32_t material : object.materials) worn[material] = true;
    EXPECT_EQ(std::count(worn.begin(), worn.end(), false), 0);
    EXPECT_EQ(std::count(placed.begin(), placed.end(), false), 0);
}

TEST_P(EveryGenerator, makes_the_same_bits_twice) {
    const SceneBundle a = *generate_scene(GetParam());
    const SceneBundle b = *generate_scene(GetParam());
    EXPECT_EQ(a.scene, b.scene);
}

TEST_P(EveryGenerator, has_a_camera_and_light) {
    const SceneBundle bundle = *generate_scene(GetParam());
    EXPECT_FALSE(bundle.scene.cameras.empty());
    SceneBundle shining = bundle;  // a billion triangles that do not shine would take a while
    std::erase_if(shining.scene.instances, [&](const Instance& instance) {
        const auto& materials = bundle.scene.objects[instance.object].materials;
        return std::ranges::none_of(materials, [&](std::uint32_t m) {
            return bundle.scene.materials[m].emission != vec3(0);
        });
    });
    double power = 0;
    for (const WorldTriangle& t : world_triangles(shining))
        power += t.area() * mean_component(t.emission);
    for (const Light& light : bundle.scene.lights) power += mean_component(light.intensity);
    EXPECT_GT(power, 0.01);
}

TEST_P(EveryGenerator, smooth_normals_agree_with_their_triangles) {
    const SceneBundle bundle = *generate_scene(GetParam());
    for (std::uint32_t i = 0; i < bundle.scene.meshes.size(); ++i) {
        const Mesh mesh = mesh_of(bundle, i);
        if (mesh.normals.empty()) continue;
        for (const uvec3& t : mesh.triangles) {
            const vec3 a = mesh.positions[t.x];
            const vec3 facing = cross(mesh.positions[t.y] - a, mesh.positions[t.z] - a);
            const vec3 sum = mesh.normals[t.x] + mesh.normals[t.y] + mesh.normals[t.z];
            ASSERT_GT(dot(facing, sum), 0) << "mesh " << i;
        }
    }
}

std::vector<std::string> names() {
    std::vector<std::string> names;
    for (const GeneratedScene& scene : generated_scenes()) names.push_back(scene.name);
    return names;
}

INSTANTIATE_TEST_SUITE_P(Generator, EveryGenerator, testing::ValuesIn(names()),
                         [](const auto& scene) { return scene.param; });

TEST(Generator, an_unknown_name_makes_nothing) {
    EXPECT_FALSE(generate_scene("no such scene").has_value());
}

TEST(Generator, cornell_is_the_published_box) {
    const char* file = TESSERA_SHARED_DIR "/scenes/cornell/cornell.obj";
    if (!std::filesystem::exists(file)) GTEST_SKIP() << "no " << file;
    auto ours = world_triangles(*generate_scene("cornell"));
    auto theirs = world_triangles(load_obj(file).bundle);
    const auto key = [](const WorldTriangle& t) {
        std::vector<float> values;
        for (const vec3& p : t.points) values.insert(values.end(), {p.x, p.y, p.z});
        return std::pair(t.material, values);
    };
    const auto by_key = [&](const auto& a, const auto& b) { return key(a) < key(b); };
    std::sort(ours.begin(), ours.end(), by_key);
    std::sort(theirs.begin(), theirs.end(), by_key);
    ASSERT_EQ(ours.size(), theirs.size());
    for (std::size_t i = 0; i < ours.size(); ++i) {
        EXPECT_EQ(key(ours[i]), key(theirs[i]));
        EXPECT_EQ(ours[i].emission, theirs[i].emission);
    }
}

TEST(Generator, office_has_the_size_of_walds) {
    const SceneBundle bundle = *generate_scene("office");
    const auto triangles = world_triangles(bundle);
    EXPECT_GE(triangles.size(), 30000u);
    EXPECT_LE(triangles.size(), 40000u);
    EXPECT_GE(bundle.scene.instances.size(), 100u);
    EXPECT_LT(bundle.scene.meshes.size(), 40u);
}

TEST(Generator, office_stays_within_its_walls) {
    const SceneBundle bundle = *generate_scene("office");
    constexpr float reveal = 0.221f;
    for (const WorldTriangle& t : world_triangles(bundle))
        for (const vec3& p : t.points) {
            ASSERT_TRUE(p.x > -reveal && p.x < 6.001f && p.y > -0.001f && p.y < 2.801f &&
                        p.z > -0.001f && p.z < 5.001f)
                << t.instance << " at " << p.x << " " << p.y << " " << p.z;
        }
    const Camera& camera = bundle.scene.cameras.at(0);
    for (const vec3& p : {camera.eye, camera.at})
        EXPECT_TRUE(p.x > 0 && p.x < 6 && p.y > 0 && p.y < 2.8f && p.z > 0 && p.z < 5);
}

TEST(Generator, building_has_a_million_triangles_that_do_not_repeat) {
    const SceneBundle bundle = *generate_scene("building");
    std::size_t triangles = 0;
    for (std::uint32_t i = 0; i < bundle.scene.meshes.size(); ++i)
        triangles += mesh_of(bundle, i).triangles.size();
    EXPECT_GT(triangles, 900'000u);
    EXPECT_LT(triangles, 1'300'000u);
}

TEST(Generator, storeys_hold_thousands_of_lamps) {
    // Seven are two and a half million triangles and more than 20,000 lamps.
    const SceneBundle bundle = *generate_scene("building:1");
    expect_sound(bundle);
    std::size_t lamps = 0, triangles = 0;
    for (const WorldTriangle& t : world_triangles(bundle)) {
        ++triangles;
        if (t.emission != vec3(0)) ++lamps;
    }
    EXPECT_GT(7 * lamps, 20'000u);
    EXPECT_NEAR(7 * double(triangles), 2.5e6, 3e5);
    EXPECT_THROW(generate_scene("building:31"), UserError);
}

TEST(Generator, sunflowers_are_a_billion_triangles) {
    const SceneBundle bundle = *generate_scene("sunflowers");
    std::vector<std::size_t> of_object;
    for (const Object& object : bundle.scene.objects)
        of_object.push_back(mesh_of(bundle, object.mesh).triangles.size());
    std::size_t placed = 0;
    for (const Instance& instance : bundle.scene.instances) placed += of_object[instance.object];
    EXPECT_GT(placed, 800'000'000u);
    EXPECT_LT(placed, 1'300'000'000u);
    EXPECT_GE(bundle.scene.instances.size(), 28'000u);
}

std::size_t placed_triangles(const SceneBundle& bundle) {
    std::vector<std::size_t> of_object;
    for (const Object& object : bundle.scene.objects)
        of_object.push_back(mesh_of(bundle, object.mesh).triangles.size());
    std::size_t placed = 0;
    for (const Instance& instance : bundle.scene.instances) placed += of_object[instance.object];
    return placed;
}

TEST(Generator, terrain_is_ten_million_triangles_in_661_instances_that_sway) {
    const SceneBundle bundle = *generate_scene("terrain");
    EXPECT_EQ(bundle.scene.instances.size(), 661u);
    EXPECT_EQ(bundle.scene.objects.size(), 3u);
    EXPECT_GT(placed_triangles(bundle), 9'500'000u);
    EXPECT_LT(placed_triangles(bundle), 14'000'000u);
    EXPECT_EQ(bundle.motion.instances.size(), 660u);
}

TEST(Generator, kitchen_has_mirrors_six_lights_and_a_train_that_goes_round) {
    const SceneBundle bundle = *generate_scene("kitchen");
    EXPECT_EQ(bundle.scene.objects.size(), 5u);
    EXPECT_EQ(bundle.scene.lights.size(), 6u);
    EXPECT_GT(placed_triangles(bundle), 95'000u);
    EXPECT_LT(placed_triangles(bundle), 125'000u);
    EXPECT_EQ(bundle.motion.instances.at(0).name, "train");
}

TEST(Generator, office_has_mirrors_and_textures) {
    const Scene scene = generate_scene("office")->scene;
    const auto is_mirror = [](const Material& m) { return m.metallic == 1 && m.roughness == 0; };
    EXPECT_TRUE(std::any_of(scene.materials.begin(), scene.materials.end(), is_mirror));
    EXPECT_EQ(scene.textures.size(), 2u);
}

}  // namespace
}  // namespace tessera
