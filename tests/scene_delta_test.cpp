// Laws of scene versions: apply(a, diff(a, b)) == b for any a and b; a delta fits only its own
// base.

#include "common/scene_delta.h"

#include <gtest/gtest.h>

#include <random>

namespace tessera {
namespace {

class RandomScene {
public:
    explicit RandomScene(unsigned seed) : random_(seed) {}

    SceneVersion make(std::uint64_t version) {
        SceneVersion out{.version = version, .scene = {}};
        Scene& scene = out.scene;
        for (auto* table : {&scene.meshes, &scene.textures})
            for (table->resize(1 + below(4)); BlobId & id : *table) id.digest[0] = below(250);
        scene.materials.resize(1 + below(5));
        for (Material& m : scene.materials) {
            m.name = std::to_string(below(3));
            m.base_color.x = float(below(3));
            m.emission_map.texture = int(below(scene.textures.size() + 1)) - 1;
        }
        scene.objects.resize(1 + below(5));
        for (Object& o : scene.objects) {
            o.mesh = below(scene.meshes.size());
            o.materials.assign(below(3), below(scene.materials.size()));
        }
        scene.instances.resize(below(20));
        for (Instance& i : scene.instances) {
            i.object = below(scene.objects.size());
            i.world_from_object[3][0] = float(below(2));
        }
        scene.lights.resize(below(3));
        scene.cameras.resize(below(3));
        return out;
    }

private:
    std::uint32_t below(std::size_t n) { return std::uint32_t(random_() % n); }
    std::mt19937 random_;
};

TEST(SceneDelta, applying_the_difference_gives_the_other_scene) {
    RandomScene random(1);
    for (int i = 0; i < 1000; ++i) {
        const SceneVersion a = random.make(i);
        const SceneVersion b = random.make(i + 1);
        ASSERT_EQ(apply(a, diff(a, b)), b) << "round " << i;
    }
}

TEST(SceneDelta, snapshot_is_the_delta_from_the_empty_scene) {
    RandomScene random(2);
    const SceneVersion scene = random.make(17);
    EXPECT_EQ(apply(SceneVersion{}, diff(SceneVersion{}, scene)), scene);
}

TEST(SceneDelta, equal_scenes_differ_in_nothing) {
    RandomScene random(3);
    const SceneVersion a = random.make(5);
    const SceneDelta delta = diff(a, a);
    EXPECT_TRUE(delta.instances.changed.empty() && delta.materials.changed.empty());
}

TEST(SceneDelta, one_moved_instance_is_one_change) {
    RandomScene random(4);
    SceneVersion a = random.make(5);
    a.scene.instances.resize(10);
    SceneVersion b = a;
    b.version = 6;
    b.scene.instances[7].world_from_object[3][1] = 2;
    const SceneDelta delta = diff(a, b);
    ASSERT_EQ(delta.instances.changed.size(), 1u);
    EXPECT_EQ(delta.instances.changed[0].first, 7u);
}

TEST(SceneDelta, a_delta_fits_only_its_own_base) {
    RandomScene random(5);
    const SceneVersion a = random.make(1);
    const SceneDelta delta = diff(a, random.make(2));
    EXPECT_THROW(apply(random.make(3), delta), std::runtime_error);
}

TEST(SceneDelta, entries_outside_or_unset_are_refused) {
    const SceneVersion empty;
    SceneDelta outside = diff(empty, empty);
    outside.lights.changed.emplace_back(3, Light{});
    EXPECT_THROW(apply(empty, outside), std::runtime_error);
    SceneDelta unset = diff(empty, empty);
    unset.lights.size = 4000000000;
    EXPECT_THROW(apply(empty, unset), std::runtime_error);
    SceneDelta dangling = diff(empty, empty);
    dangling.instances.size = 1;
    dangling.instances.changed.emplace_back(0, Instance{.name = "i", .object = 3});
    EXPECT_THROW(apply(empty, dangling), std::runtime_error);
}

}  // namespace
}  // namespace tessera
