// Laws of edits: they compose, the last value wins, what cannot be done is told by name and changes
// nothing, and whatever is asked for, names stay unique and the scene stays valid.

#include "common/scene_edit.h"

#include <gtest/gtest.h>

#include <map>
#include <random>
#include <set>

#include "common/scene_delta.h"

namespace tessera {
namespace {

Scene small_scene() {
    Scene scene;
    scene.meshes.resize(1);
    scene.materials = {{.name = "red"}, {.name = "lamp"}};
    scene.objects = {{.name = "chair", .materials = {0}}, {.name = "desk", .materials = {1}}};
    for (const char* name : {"a", "b", "c", "d"}) scene.instances.push_back({.name = name});
    scene.lights = {{.name = "sun", .kind = LightKind::directional}, {.name = "spot"}};
    scene.cameras = {{.name = "door"}};
    return scene;
}

/// Edits of few names, so that they meet; many are impossible.
class RandomEdits {
public:
    explicit RandomEdits(unsigned seed) : random_(seed) {}

    EditOperation one() {
        switch (below(15)) {
            case 0:
                return SetTransform{name(), transform()};
            case 1:
                return CreateInstance{name(), below(2) ? "chair" : name(), transform()};
            case 2:
                return DeleteInstance{name()};
            case 3:
                return SetMaterial{below(2) ? "red" : name(), vector(), real(), {}, vector()};
            case 4:
                return SetLight{below(2) ? "sun" : name(), vector(), vector(), {}, real(), real()};
            case 5:
                return CreateLight{{.name = name(), .intensity = vector()}};
            case 6:
                return DeleteLight{name()};
            case 7:
                return SetShape{below(2) ? "chair" : name(), blob_id({})};
            case 8:
                return CreateObject{name(), blob_id({}), {"red", below(4) ? "lamp" : name()}};
            case 9:
                return DeleteObject{below(2) ? "desk" : name()};
            case 10:
                return CreateMaterial{{.name = name(), .base_color = vector(), .ior = real()}};
            case 11:
                return DeleteMaterial{below(2) ? "red" : name()};
            case 12:
                return DeleteCamera{name()};
            case 13:
                return SetEnvironment{vector(), real()};
            default:
                return SetCamera{{.name = name(), .eye = vector(), .at = vector()}};
        }
    }
    std::vector<EditOperation> several() {
        std::vector<EditOperation> out(below(6));
        for (EditOperation& operation : out) operation = one();
        return out;
    }

private:
    unsigned below(unsigned n) { return unsigned(random_() % n); }
    float real() {
        constexpr float values[] = {0, 0.25f, 0.5f, 1, 2, -1, infinity};
        return values[below(7)];
    }
    vec3 vector() { return {real(), real(), real()}; }
    std::string name() { return std::string(below(6) ? 1 : 0, char('a' + below(6))); }
    mat4 transform() {
        mat4 m(1);
        m[3] = {real(), real(), real(), 1};
        return m;
    }

    std::mt19937 random_;
};

template <class T>
bool names_unique(const std::vector<T>& table) {
    std::set<std::string> names;
    return std::all_of(table.begin(), table.end(), [&](const T& entry) {
        return !entry.name.empty() && names.insert(entry.name).second;
    });
}

bool names_unique(const Scene& s) {
    return names_unique(s.objects) && names_unique(s.instances) && names_unique(s.materials) &&
           names_unique(s.lights) && names_unique(s.cameras);
}

TEST(SceneEdit, edits_compose) {
    RandomEdits random(1);
    for (int round = 0; round < 1000; ++round) {
        const auto first = random.several(), second = random.several();
        auto both = first;
        both.insert(both.end(), second.begin(), second.end());
        const EditedScene whole = apply_edits(small_scene(), both);
        const EditedScene half = apply_edits(small_scene(), first);
        const EditedScene rest = apply_edits(half.scene, second);
        ASSERT_EQ(rest.scene, whole.scene);
        ASSERT_EQ(half.complaints.size() + rest.complaints.size(), whole.complaints.size());
    }
}

TEST(SceneEdit, whatever_is_asked_for_the_scene_stays_valid_and_its_names_unique) {
    RandomEdits random(2);
    Scene scene = small_scene();
    for (int round = 0; round < 5000; ++round) {
        const EditedScene edited = apply_edits(scene, {random.one()});
        ASSERT_NO_THROW(validate(edited.scene));
        ASSERT_TRUE(names_unique(edited.scene));
        ASSERT_TRUE(edited.complaints.empty() || edited.scene == scene);
        scene = edited.scene;
    }
}

TEST(SceneEdit, the_last_value_wins) {
    const SetMaterial red{.material = "red", .base_color = vec3(1, 0, 0)};
    const SetMaterial blue{.material = "red", .base_color = vec3(0, 0, 1), .roughness = 0.5f};
    EXPECT_EQ(apply_edits(small_scene(), {red, blue}).scene,
              apply_edits(small_scene(), {blue}).scene);
}

TEST(SceneEdit, what_is_not_set_stays) {
    const Scene before = small_scene();
    EXPECT_EQ(apply_edits(before, {SetMaterial{.material = "red"}, SetLight{.light = "sun"}}).scene,
              before);
}

TEST(SceneEdit, what_has_moved_once_is_marked_and_no_other) {
    const Scene before = small_scene();
    EXPECT_EQ(apply_edits(before, {SetTransform{.instance = "b"}}).scene, before);
    SetTransform away{.instance = "b"};
    away.world_from_object[3].x = 1;
    const Scene after = apply_edits(before, {away, SetTransform{.instance = "b"}}).scene;
    for (const Instance& instance : after.instances)
        EXPECT_EQ(instance.moves, instance.name == "b");
}

TEST(SceneEdit, each_object_has_a_shape_of_its_own) {
    const std::vector<std::byte> one(1), two(2), three(3);
    Scene scene = small_scene();
    scene.shapes = {blob_id({})};
    for (Object& object : scene.objects) object.shape = 0;
    const auto shape_of = [&](std::size_t object) {
        return scene.shapes[std::size_t(scene.objects[object].shape)];
    };
    scene = apply_edits(scene, {SetShape{"chair", blob_id(one)}}).scene;
    EXPECT_EQ(shape_of(0), blob_id(one));
    EXPECT_EQ(shape_of(1), blob_id({}));
    scene = apply_edits(scene, {SetShape{"desk", blob_id(two)}, SetShape{"chair", blob_id(three)}})
                .scene;
    EXPECT_EQ(shape_of(0), blob_id(three));
    EXPECT_EQ(shape_of(1), blob_id(two));
    EXPECT_EQ(scene.shapes.size(), 2u);
}

TEST(SceneEdit, unknown_and_taken_names_are_told) {
    const std::vector<EditOperation> impossible = {
        SetTransform{.instance = "nobody"},
        CreateInstance{.instance = "new", .object = "nobody"},
        CreateInstance{.instance = "a", .object = "chair"},
        DeleteInstance{.instance = "nobody"},
        SetMaterial{.material = "nobody"},
        SetLight{.light = "nobody"},
        CreateLight{.light = {.name = "sun"}},
        DeleteLight{.light = "nobody"},
        DeleteObject{.object = "chair"},
        DeleteMaterial{.material = "red"},
        CreateObject{.object = "chair", .mesh = {}, .materials = {"red"}},
        CreateObject{.object = "stool", .mesh = {}, .materials = {"nobody"}},
        CreateObject{.object = "stool", .mesh = {}, .materials = {}},
        CreateMaterial{.material = {.name = "lamp"}},
        CreateMaterial{.material = {.name = "picture", .base_color_map = {.texture = 0}}},
        DeleteCamera{.camera = "nobody"},
        SetEnvironment{.radiance = vec3(-1)}};
    const EditedScene edited = apply_edits(small_scene(), impossible);
    EXPECT_EQ(edited.scene, small_scene());
    ASSERT_EQ(edited.complaints.size(), impossible.size());
    EXPECT_EQ(edited.complaints[0], "there is no instance 'nobody'");
    EXPECT_EQ(edited.complaints[2], "the instance 'a' exists already");
    EXPECT_EQ(edited.complaints[6], "the light 'sun' exists already");
    EXPECT_EQ(edited.complaints[8], "the object 'chair' is in use");
}

/// By name: what each instance looks like.
std::map<std::string, std::vector<std::string>> looks(const Scene& scene) {
    std::map<std::string, std::vector<std::string>> out;
    for (const Instance& instance : scene.instances) {
        const Object& object = scene.objects[instance.object];
        out[instance.name] = {object.name};
        for (const std::uint32_t m : object.materials)
            out[instance.name].push_back(scene.materials[m].name);
    }
    return out;
}

TEST(SceneEdit, what_is_made_and_taken_away_leaves_all_others_as_they_look) {
    const std::vector<std::byte> mesh(1);
    Scene scene = apply_edits(small_scene(), {CreateMaterial{{.name = "blue"}},
                                              CreateObject{"stool", blob_id(mesh), {"blue"}},
                                              CreateInstance{"e", "stool"}})
                      .scene;
    auto expected = looks(small_scene());
    expected["e"] = {"stool", "blue"};
    EXPECT_EQ(looks(scene), expected);
    EXPECT_EQ(scene.meshes.size(), 2u);
    // The last object and material take the places of those that go.
    const EditedScene less = apply_edits(scene, {DeleteObject{"desk"}, DeleteMaterial{"lamp"}});
    EXPECT_TRUE(less.complaints.empty());
    EXPECT_EQ(looks(less.scene), expected);
    EXPECT_EQ(less.scene.objects.size(), 2u);
    EXPECT_EQ(less.scene.meshes, scene.meshes);
    const EditedScene least = apply_edits(less.scene, {DeleteInstance{"e"}, DeleteObject{"stool"}});
    EXPECT_EQ(least.scene.meshes, small_scene().meshes);
    EXPECT_EQ(less.scene.materials.size(), 2u);
}

TEST(SceneEdit, deleting_an_instance_changes_one_entry_at_most) {
    for (const char* name : {"a", "b", "c", "d"}) {
        const SceneVersion before{.version = 1, .scene = small_scene()};
        const SceneVersion after{.version = 2,
                                 .scene = apply_edits(before.scene, {DeleteInstance{name}}).scene};
        EXPECT_EQ(after.scene.instances.size(), 3u);
        EXPECT_LE(diff(before, after).instances.changed.size(), 1u);
    }
}

TEST(SceneEdit, names_become_unique_and_unique_ones_stay) {
    Scene scene = small_scene();
    make_names_unique(scene);
    EXPECT_EQ(scene, small_scene());
    for (Instance& instance : scene.instances) instance.name = "book";
    scene.instances.push_back({.name = "book (2)"});
    scene.instances.push_back({});
    make_names_unique(scene);
    EXPECT_TRUE(names_unique(scene));
    EXPECT_EQ(scene.instances[0].name, "book");
    EXPECT_EQ(scene.instances[5].name, "instance 5");
}

}  // namespace
}  // namespace tessera
