// What a viewer does without a server: camera gestures, picking, edits from JSON, JPEG.

#include <gtest/gtest.h>

#include <fstream>
#include <nlohmann/json.hpp>
#include <random>

#include "client/camera_control.h"
#include "client/edit_json.h"
#include "client/gizmo.h"
#include "client/pick.h"
#include "client/recording.h"
#include "common/check.h"
#include "common/jpeg.h"
#include "common/picture_quality.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

class Gestures {
public:
    float in(float low, float high) {
        return std::uniform_real_distribution<float>(low, high)(random_);
    }
    vec2 drag() { return {in(-1, 1), in(-1, 1)}; }

    Camera moved(const Camera& c) {
        switch (random_() % 5) {
            case 0:
                return orbited(c, drag());
            case 1:
                return turned(c, drag());
            case 2:
                return panned(c, drag());
            case 3:
                return approached(c, in(0.8f, 1.25f));
            default:
                return flown(c, {in(-1, 1), in(-1, 1), in(-1, 1)});
        }
    }

private:
    std::mt19937 random_{1};
};

TEST(CameraControl, no_gesture_makes_a_camera_that_sees_nothing) {
    Gestures gestures;
    Camera camera{.name = {}, .eye = {0, 1, 5}, .at = {0, 1, 0}};
    for (int i = 0; i < 10000; ++i) {
        camera = gestures.moved(camera);
        const vec3 view = camera.at - camera.eye;
        ASSERT_GT(length(cross(view, camera.up)), 1e-3f * length(view)) << "gesture " << i;
    }
}

TEST(CameraControl, orbits_keep_the_distance_and_turns_the_eye) {
    Gestures gestures;
    const Camera camera{.name = {}, .eye = {3, 2, 5}, .at = {0, 1, 0}};
    for (int i = 0; i < 100; ++i) {
        const Camera orbit = orbited(camera, gestures.drag());
        EXPECT_EQ(orbit.at, camera.at);
        EXPECT_NEAR(length(orbit.eye - orbit.at), length(camera.eye - camera.at), 1e-4f);
        EXPECT_EQ(turned(camera, gestures.drag()).eye, camera.eye);
    }
}

TEST(CameraControl, panning_keeps_the_point_under_the_pointer) {
    const Camera camera{.name = {}, .eye = {0, 0, 4}, .at = {0, 0, 0}, .fov_y = 90};
    // Half the picture's height is 4 m at the point looked at.
    EXPECT_NEAR(panned(camera, {0, 0.5f}).at.y, -4, 1e-5f);
    const Ray up = eye_ray(camera, {0, 1});
    EXPECT_NEAR(up.dir.y, -up.dir.z, 1e-6f);
}

TEST(CameraControl, a_point_lies_on_the_ray_through_its_projection) {
    Gestures gestures;
    Camera camera{.name = {}, .eye = {0, 1, 5}, .at = {0, 1, 0}};
    for (int i = 0; i < 100; ++i) {
        camera = gestures.moved(camera);
        const Ray ray = eye_ray(camera, gestures.drag());
        const auto point = projected(camera, ray.org + 3.0f * ray.dir);
        ASSERT_TRUE(point);
        EXPECT_NEAR(dot(eye_ray(camera, *point).dir, ray.dir), 1, 1e-5f);
        EXPECT_FALSE(projected(camera, ray.org - ray.dir));
    }
}

Mesh triangle() {
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1, 0, 0}, {0, 1, 0}};
    mesh.triangles = {{0, 1, 2}};
    return mesh;
}

TEST(Pick, the_nearest_instance_is_found_where_it_is_by_now) {
    SceneBundle bundle;
    bundle.scene.materials = {{.name = "a"}, {.name = "b"}};
    bundle.scene.objects = {{.name = {}, .mesh = add_mesh(bundle, triangle()), .materials = {1}}};
    bundle.scene.instances = {{.name = "far"}, {.name = "near"}};
    const Picker picker(bundle.scene, bundle.blobs);
    Gestures random;
    for (int i = 0; i < 1000; ++i) {
        const float z = random.in(-3, 3), x = random.in(-1, 1);
        bundle.scene.instances[1].world_from_object[3] = {x, 0, z, 1};
        const Ray ray{.org = {0.2f, 0.3f, 5}, .dir = {0, 0, -1}};
        const auto picked = picker.pick(bundle.scene, ray);
        const bool near_hit = 0.2f - x > 0 && 0.2f - x < 0.7f;
        ASSERT_TRUE(picked);
        EXPECT_EQ(picked->instance, near_hit && z > 0 ? 1u : 0u);
        EXPECT_EQ(picked->material, 1u);
        EXPECT_NEAR(picked->p.z, near_hit && z > 0 ? z : 0, 1e-4f);
    }
    EXPECT_FALSE(picker.pick(bundle.scene, {.org = {5, 5, 5}, .dir = {0, 0, -1}}));
}

Scene small_scene() {
    Scene scene;
    scene.meshes.resize(1);
    scene.objects = {{.name = "chair", .materials = {}}};
    scene.instances = {{.name = "a"}};
    scene.materials = {{.name = "oak"}};
    scene.lights = {{.name = "sun"}};
    scene.cameras = {{.name = "door", .fov_y = 30}};
    return scene;
}

TEST(Gizmo, an_arrow_is_held_where_it_is_seen_and_followed) {
    Gestures gestures;
    Camera camera{.name = {}, .eye = {2, 1.5f, 3}, .at = {0, 0.5f, 0}, .fov_y = 50};
    int held = 0;
    for (int round = 0; round < 300; ++round) {
        camera = gestures.moved(camera);
        const vec3 origin = camera.at + vec3(gestures.in(-1, 1), 0, gestures.in(-1, 1));
        const Gizmo gizmo = gizmo_at(camera, origin);
        for (int arrow = 0; arrow < 3; ++arrow) {
            const float part = gestures.in(0.35f, 1);
            const vec3 p = origin + part * gizmo.length * Gizmo::axis(arrow);
            const auto point = projected(camera, p), base = projected(camera, origin);
            // Arrows towards the eye are short in the picture, and others lie over them.
            if (!point || !base || length(*point - *base) < 0.15f) continue;
            const Ray ray = eye_ray(camera, *point);
            EXPECT_NEAR(distance_along(gizmo, arrow, ray).value_or(-1), part * gizmo.length,
                        0.01f * gizmo.length);
            held += arrow_at(camera, gizmo, *point) == arrow;
            EXPECT_FALSE(arrow_at(camera, gizmo, *point + vec2(1, 1)));
        }
    }
    EXPECT_GT(held, 300);
}

std::vector<TimedEdit> edits_of(const std::string& json) {
    const TempDir dir;
    const std::string file = dir.file("edits.json");
    std::ofstream(file) << json;
    return load_timed_edits(file, small_scene());
}

TEST(EditJson, a_file_tells_what_to_do_and_when) {
    const auto edits = edits_of(R"([
        {"edits": [{"move": "a", "to": [1, 2, 3]},
                   {"set": "material", "name": "oak", "to": {"roughness": 0.5}}]},
        {"time": 2.5, "edits": [{"set": "camera", "name": "door", "to": {"eye": [1, 1, 1]}},
                                {"create": "b", "object": "chair", "to": [0, 0, 1]},
                                {"create light": "spot", "to": {"kind": "spot"}},
                                {"delete": "a"}, {"delete light": "sun"}]}])");
    ASSERT_EQ(edits.size(), 2u);
    EXPECT_EQ(edits[1].seconds, 2.5);
    Scene scene = small_scene();
    for (const TimedEdit& edit : edits) scene = apply_edits(scene, edit.operations).scene;
    ASSERT_EQ(scene.instances.size(), 1u);
    EXPECT_EQ(scene.instances[0].name, "b");
    EXPECT_EQ(scene.materials[0].roughness, 0.5f);
    EXPECT_EQ(scene.lights.at(0).kind, LightKind::spot);
    EXPECT_EQ(scene.cameras[0].fov_y, 30);
    EXPECT_EQ(scene.cameras[0].eye, vec3(1));
}

TEST(EditJson, mistakes_are_told_with_file_and_entry) {
    for (const auto& [edit, complaint] :
         {std::pair(R"({"move": "nobody", "to": [0, 0, 0]})", "no instance 'nobody'"),
          {R"({"move": "a", "to": [0, 0]})", "2 numbers, must have 3"},
          {R"({"set": "material", "name": "oak", "to": {"rough": 1}})", "`rough`"},
          {R"({"set": "material", "name": "oak", "to": {"roughness": 2}})", "roughness must be"},
          {R"({"create object": "b", "mesh": "12", "materials": ["oak"]})", "64 hexadecimal"},
          {R"({"create object": "b", "like": "nobody"})", "no object 'nobody'"},
          {R"({"create material": "b", "to": {"ior": 0.5}})", "index of refraction"},
          {R"({"paint": "a"})", "no edit"}}) {
        try {
            edits_of(std::string(R"([{"edits": []}, {"edits": [)") + edit + "]}]");
            FAIL() << edit;
        } catch (const UserError& error) {
            EXPECT_NE(std::string(error.what()).find(complaint), std::string::npos) << error.what();
            EXPECT_NE(std::string(error.what()).find("edits.json: entry 2"), std::string::npos)
                << error.what();
        }
    }
}

/// Some change of a scene, of each kind.
std::vector<EditOperation> some_edits(std::mt19937& random, const Scene& scene) {
    const auto number = [&] { return std::uniform_real_distribution<float>(0, 1)(random); };
    const auto chance = [&] { return random() % 3 == 0; };
    std::vector<EditOperation> out;
    mat4 place(1);
    place[3] = vec4(number(), number(), number(), 1);
    for (const Instance& i : scene.instances)
        if (chance()) out.push_back(SetTransform{i.name, place});
    if (chance()) out.push_back(CreateInstance{std::to_string(random()), "chair", place});
    if (chance() && !scene.instances.empty())
        out.push_back(DeleteInstance{scene.instances.front().name});
    if (chance()) out.push_back(SetMaterial{.material = "oak", .roughness = number()});
    for (const Light& l : scene.lights)
        if (chance()) out.push_back(SetLight{.light = l.name, .intensity = vec3(number())});
    if (chance())
        out.push_back(CreateLight{
            {.name = std::to_string(random()), .kind = LightKind::spot, .position = vec3(1)}});
    if (chance()) out.push_back(SetCamera{{.name = "door", .eye = {1, 1, number()}}});
    return out;
}

/// Tables without order: an edit may put an entry elsewhere.
Scene sorted(Scene scene) {
    const auto by_name = [](auto& table) {
        std::ranges::sort(table, {}, [](const auto& e) { return e.name; });
    };
    by_name(scene.instances);
    by_name(scene.lights);
    by_name(scene.cameras);
    return scene;
}

TEST(Recording, what_is_written_makes_the_same_scenes_again) {
    std::mt19937 random(3);
    Scene scene = small_scene();
    Recorder recorder(scene);
    for (int i = 0; i < 200; ++i) {
        scene = apply_edits(scene, some_edits(random, scene)).scene;
        recorder.see(0.1 * i, scene);
        recorder.see(0.1 * i, Camera{.name = {}, .eye = vec3(float(i / 2), 1, 1)});
    }
    const TempDir dir;
    recorder.save(dir.file("session.json"));
    const auto steps = load_timed_edits(dir.file("session.json"), small_scene());
    Scene again = small_scene();
    int views = 0;
    for (const TimedEdit& step : steps) {
        const EditedScene edited = apply_edits(again, step.operations);
        EXPECT_TRUE(edited.complaints.empty());
        again = edited.scene;
        views += step.view.has_value();
    }
    EXPECT_EQ(sorted(again), sorted(scene));
    EXPECT_EQ(views, 100);
    EXPECT_LE(steps.size(), 200u);
}

TEST(Recording, what_is_made_and_taken_away_is_written_too) {
    const std::vector<std::vector<EditOperation>> sessions = {
        {CreateMaterial{{.name = "blue", .base_color = vec3(0, 0, 1), .ior = 1.25f}},
         CreateObject{"stool", small_scene().meshes[0], {"blue"}}, CreateInstance{"b", "stool"}},
        {SetMaterial{
             .material = "blue", .shader = "wood", .shader_parameters = {{"ring", vec3(1)}}},
         SetEnvironment{.radiance = vec3(1, 2, 3)}},
        {DeleteInstance{"b"}, DeleteObject{"stool"}, DeleteMaterial{"blue"}, DeleteCamera{"door"}}};
    Scene scene = small_scene();
    Recorder recorder(scene);
    std::vector<Scene> seen;
    for (const auto& operations : sessions) {
        const EditedScene edited = apply_edits(scene, operations);
        EXPECT_TRUE(edited.complaints.empty());
        scene = edited.scene;
        seen.push_back(scene);
        recorder.see(double(seen.size()), scene);
    }
    const TempDir dir;
    recorder.save(dir.file("session.json"));
    const auto steps = load_timed_edits(dir.file("session.json"), small_scene());
    ASSERT_EQ(steps.size(), seen.size());
    scene = small_scene();
    for (std::size_t i = 0; i < seen.size(); ++i) {
        scene = apply_edits(scene, steps[i].operations).scene;
        EXPECT_EQ(scene, seen[i]);
    }
}

/// Seconds that a picture of this quality takes over a link; 200 kB at the best quality.
double seconds_of(int quality, double bytes_per_second) {
    return 2e5 * std::exp2((quality - best_jpeg_quality) / 20.0) / bytes_per_second;
}

TEST(PictureQuality, settles_where_the_link_allows_and_stays) {
    for (const double round_trip : {0.0, 0.02, 0.2})
        for (const double mbit : {0.5, 2.0, 8.0, 30.0, 100.0, 1000.0}) {
            const double budget = 0.04 + 0.25 * round_trip;
            int quality = best_jpeg_quality, least = best_jpeg_quality, most = 0;
            for (int picture = 0; picture < 60; ++picture) {
                quality = next_jpeg_quality(quality, seconds_of(quality, mbit * 125e3), round_trip);
                if (picture < 30) continue;
                least = std::min(least, quality);
                most = std::max(most, quality);
            }
            EXPECT_LE(most - least, 3) << mbit;
            const bool fits = seconds_of(most, mbit * 125e3) <= budget;
            EXPECT_TRUE(fits || least == worst_jpeg_quality) << mbit << " Mbit/s";
            if (seconds_of(best_jpeg_quality, mbit * 125e3) < 0.5 * budget) {
                EXPECT_EQ(least, best_jpeg_quality) << mbit << " Mbit/s";
            }
        }
}

TEST(PictureQuality, is_never_better_for_what_takes_longer) {
    for (int now = worst_jpeg_quality; now <= best_jpeg_quality; ++now)
        for (double seconds = 1e-3; seconds < 1e3; seconds *= 1.1) {
            const int next = next_jpeg_quality(now, seconds, 0.01);
            EXPECT_LE(next_jpeg_quality(now, 1.1 * seconds, 0.01), next);
            EXPECT_GE(next, worst_jpeg_quality);
            EXPECT_LE(next, best_jpeg_quality);
        }
}

TEST(Jpeg, comes_back_nearly_the_same_and_only_in_its_own_size) {
    const ImageSize size{67, 45};
    std::vector<std::uint8_t> rgb;
    for (int y = 0; y < size.height; ++y)
        for (int x = 0; x < size.width; ++x)
            rgb.insert(rgb.end(), {std::uint8_t(3 * x), std::uint8_t(5 * y), 90});
    Bytes file = encode_jpeg(rgb, size, 90);
    EXPECT_LT(file.size(), rgb.size() / 2);
    const auto back = decode_jpeg(file, size);
    ASSERT_EQ(back.size(), rgb.size());
    for (std::size_t i = 0; i < rgb.size(); ++i) EXPECT_NEAR(back[i], rgb[i], 12);
    EXPECT_THROW(decode_jpeg(file, {66, 45}), std::runtime_error);
    file.resize(10);
    EXPECT_THROW(decode_jpeg(file, size), std::runtime_error);
}

}  // namespace
}  // namespace tessera
