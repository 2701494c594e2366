// Every kind of ray, ours against brute force (bit for bit) and against Embree (disagreements are
// judged in double), and no leaks between triangles.
#include "worker/tracer.h"

#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <thread>

#include "common/check.h"
#include "common/generator.h"
#include "common/scene_io.h"
#include "worker/affine.h"
#include "worker/bake.h"
#include "worker/bench/judge.h"
#include "worker/bench/tracer_scenes.h"
#include "worker/kdtree_tracer.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

/// Tests all triangles of all instances with the tracer's own arithmetic: the baked ones in the
/// world, the others in their objects' space.
Hit brute_force(const TestScene& scene, std::span<const std::uint8_t> baked, const Ray& world_ray) {
    Hit best;
    for (std::uint32_t i = 0; i < scene.instances.size(); ++i) {
        const TracerInstance& instance = scene.instances[i];
        const auto inverse = inverse_affine(instance.world_from_object);
        if (!inverse) continue;
        const TriangleRay ray(baked[i] ? world_ray : transformed(world_ray, *inverse));
        const Mesh& mesh = scene.meshes[instance.object];
        const auto corner = [&](std::uint32_t v) {
            const vec3& p = mesh.positions[v];
            return baked[i] ? baked_position(instance.world_from_object, p) : p;
        };
        for (std::uint32_t k = 0; k < mesh.triangles.size(); ++k) {
            const uvec3& v = mesh.triangles[k];
            const Triangle triangle{corner(v.x), corner(v.y), corner(v.z), k};
            TriangleHit hit;
            if (!is_degenerate(triangle) && ray.hits(triangle, hit) && hit.t < best.t)
                best = {hit.t, hit.u, hit.v, i, k};
        }
    }
    return best;
}

std::vector<std::uint8_t> usually_baked(const TestScene& scene) {
    const std::vector<TracerObject> objects = scene.objects();
    return choose_baked(objects, scene.instances, bakeable_triangles(objects, scene.instances));
}

Hit brute_force(const TestScene& scene, const Ray& ray) {
    return brute_force(scene, usually_baked(scene), ray);
}

bool agree(const Hit& a, const Hit& b) {
    return a.valid() == b.valid() && (!a.valid() || std::abs(a.t - b.t) <= 1e-5f * std::abs(a.t));
}

class TracerTest : public testing::TestWithParam<TestScene> {};

constexpr auto name_of = [](const auto& scene) { return scene.param.name; };

struct Tally {
    int rays = 0;
    int disagreements = 0;
    int wrong = 0;
    int embree_wrong = 0;
};

/// Traces `count` rays of each kind with both tracers; judges where they differ.
Tally compare_with_embree(const TestScene& scene, int count) {
    const auto ours = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 2);
    const auto embree = build_tracer(TracerKind::embree, scene.objects(), scene.instances, 2);
    RayMaker maker(scene, ours->bounds(), 11);
    Tally tally;
    for (int kind = 0; kind < RayMaker::kinds; ++kind) {
        std::vector<Ray> rays;
        for (int i = 0; i < count; ++i) rays.push_back(maker.ray(kind));
        std::vector<Hit> hits(rays.size()), embree_hits(rays.size());
        std::vector<std::uint8_t> blocked(rays.size());
        ours->closest_hits(rays, hits);
        ours->occluded(rays, blocked);
        embree->closest_hits(rays, embree_hits);
        for (int i = 0; i < count; ++i) {
            EXPECT_EQ(blocked[i] != 0, hits[i].valid());
            ++tally.rays;
            if (agree(hits[i], embree_hits[i])) continue;
            const Verdict verdict = judge(scene, rays[i]);
            ++tally.disagreements;
            if (!verdict.allows(hits[i])) {
                ++tally.wrong;
                ADD_FAILURE() << RayMaker::name(kind) << " ray " << i << ": t " << hits[i].t
                              << ", surely " << verdict.sure << ", possibly " << verdict.possible;
            }
            tally.embree_wrong += !verdict.allows(embree_hits[i]);
        }
    }
    std::cout << scene.name << ": " << tally.rays << " rays, " << tally.disagreements
              << " disagreements, wrong: ours " << tally.wrong << ", Embree " << tally.embree_wrong
              << "\n";
    return tally;
}

void expect_brute_force(const TestScene& scene, const KdTreeTracerConfig& config, int rays) {
    const std::vector<TracerObject> objects = scene.objects();
    const auto tracer = build_kdtree_tracer(objects, scene.instances, 1, config);
    // One untransformed instance is traced in the world however it is called.
    const bool single =
        scene.instances.size() == 1 && scene.instances[0].world_from_object == mat4(1);
    const std::vector<std::uint8_t> baked =
        config.baked_triangles && !single
            ? choose_baked(objects, scene.instances, *config.baked_triangles)
            : usually_baked(scene);
    RayMaker maker(scene, tracer->bounds(), 7);
    for (int kind = 0; kind < RayMaker::kinds; ++kind)
        for (int i = 0; i < rays; ++i) {
            const Ray ray = maker.ray(kind);
            const Hit expected = brute_force(scene, baked, ray);
            const Hit hit = tracer->closest_hit(ray);
            ASSERT_EQ(hit, expected)
                << RayMaker::name(kind) << " ray " << i << ": t " << hit.t << " instance "
                << hit.instance << " triangle " << hit.triangle << ", expected " << expected.t
                << " instance " << expected.instance << " triangle " << expected.triangle;
            ASSERT_EQ(tracer->occluded(ray), expected.valid());
        }
}

TEST_P(TracerTest, EqualsBruteForceBitForBit) {
    expect_brute_force(GetParam(), {}, 1500);
    expect_brute_force(GetParam(), {.builder = TreeBuilder::kdtree}, 300);
    if (GetParam().instances.size() == 1) return;
    // Nothing is baked; the object with the fewest triangles is.
    expect_brute_force(GetParam(), {.baked_triangles = 0}, 500);
    expect_brute_force(GetParam(), {.baked_triangles = 1000}, 500);
}

TEST(Tracer, BakesWhatStaysAndFits) {
    TestScene scene = instanced_scene();
    for (std::size_t i = 0; i < scene.instances.size(); i += 3) scene.instances[i].moves = true;
    std::vector<TracerObject> objects = scene.objects();
    objects[1].deforms = true;
    for (const std::size_t most : {0, 1000, 1 << 20}) {
        const std::vector<std::uint8_t> baked = choose_baked(objects, scene.instances, most);
        std::size_t triangles = 0;
        for (std::size_t i = 0; i < baked.size(); ++i) {
            const TracerInstance& instance = scene.instances[i];
            if (baked[i]) triangles += objects[instance.object].triangles.size();
            EXPECT_FALSE(baked[i] && (instance.moves || objects[instance.object].deforms ||
                                      !inverse_affine(instance.world_from_object)));
        }
        EXPECT_LE(triangles, most);
        EXPECT_EQ(triangles > 0, most == 1 << 20);
    }
    expect_brute_force(scene, {}, 200);
}

/// What deforms is built by whoever first looks at it, and answers as ever.
TEST(Tracer, DeformingObjectsAreBuiltWhenRaysAsk) {
    const TestScene scene = instanced_scene();
    std::vector<TracerObject> objects = scene.objects();
    objects[0].deforms = true;
    const auto eager = build_kdtree_tracer(scene.objects(), scene.instances, 1,
                                           {.baked_triangles = 1000});  // of the others
    const auto late = build_kdtree_tracer(objects, scene.instances, 2, {.baked_triangles = 1000});
    EXPECT_EQ(late->bounds(), eager->bounds());
    const std::size_t before = late->memory_bytes();
    EXPECT_LT(before, eager->memory_bytes());
    std::vector<Ray> rays;
    RayMaker maker(scene, eager->bounds(), 17);
    for (int i = 0; i < 2000; ++i) rays.push_back(maker.ray(i % RayMaker::kinds));
    std::vector<Hit> expected(rays.size());
    eager->closest_hits(rays, expected);
    std::vector<std::vector<Hit>> hits(3, std::vector<Hit>(rays.size()));
    {
        std::vector<std::jthread> threads;
        for (auto& of_thread : hits)
            threads.emplace_back([&] { late->closest_hits(rays, of_thread); });
    }
    for (const auto& of_thread : hits) EXPECT_EQ(of_thread, expected);
    EXPECT_GT(late->memory_bytes(), before);
}

/// Points seen from one: a patch of a surface, as a tile sees it, or anywhere.
std::vector<vec3> targets_around(RayMaker& maker, Random& random, float extent) {
    std::vector<vec3> targets;
    const Ray view = maker.ray(int(random() % RayMaker::kinds));
    const vec3 centre = view.org + uniform(random, 0, 1) * extent * normalize(view.dir);
    const float size = extent * std::exp2(uniform(random, -12, 0));
    const vec3 x = size * uniform_direction(random), y = size * uniform_direction(random);
    const int count = 1 + int(random() % Targets::max_count);
    for (int i = 0; i < count; ++i) {
        const int tile = i / 16, row = tile / 4 * 4 + i % 16 / 4, column = tile % 4 * 4 + i % 4;
        vec3 p = centre + float(row) / 16 * x + float(column) / 16 * y;
        if (random() % 100 == 0) p = maker.ray(int(random() % RayMaker::kinds)).org;
        targets.push_back(p);
    }
    return targets;
}

/// Shifts what lies on a surface a little to the side the origin is on, or not at all.
void move_onto_surfaces(const Tracer& tracer, const vec3& origin, float extent,
                        std::vector<vec3>& targets) {
    for (std::size_t i = 0; i < targets.size(); ++i) {
        const Hit hit = tracer.closest_hit({origin, 0, targets[i] - origin, infinity});
        const float back = i % 3 == 0 ? 0 : 0x1p-18f * extent;
        if (!hit.valid()) continue;
        const vec3 d = targets[i] - origin;
        targets[i] = origin + hit.t * d - back * normalize(d);
    }
}

/// Our tracer on one instruction set; null where this machine does not have it.
std::unique_ptr<Tracer> build_forced(const TestScene& scene, const char* isa,
                                     const KdTreeTracerConfig& config = {}) {
    ::setenv("TESSERA_SIMD", isa, 1);
    std::unique_ptr<Tracer> tracer;
    try {
        tracer = build_kdtree_tracer(scene.objects(), scene.instances, 2, config);
    } catch (const UserError&) {
    }
    ::unsetenv("TESSERA_SIMD");
    return tracer;
}

constexpr const char* isas[] = {"scalar", "sse4", "avx2", "avx512"};

TEST_P(TracerTest, EveryInstructionSetAnswersTheSame) {
    const TestScene& scene = GetParam();
    const auto reference = build_forced(scene, "scalar");
    for (const char* const isa : isas) {
        const auto tracer = build_forced(scene, isa);
        if (!tracer) continue;
        RayMaker maker(scene, reference->bounds(), 13);
        for (int i = 0; i < 2000; ++i) {
            const Ray ray = maker.ray(i % RayMaker::kinds);
            const Hit expected = reference->closest_hit(ray);
            ASSERT_EQ(tracer->closest_hit(ray), expected) << isa << " ray " << i;
            ASSERT_EQ(tracer->occluded(ray), expected.valid()) << isa << " ray " << i;
        }
    }
}

TEST(Tracer, RefusesInstructionSetsThatItDoesNotKnow) {
    const TestScene scene = scene_of("room", room_mesh());
    EXPECT_EQ(build_forced(scene, "mmx"), nullptr);
    EXPECT_NE(build_forced(scene, "scalar"), nullptr);
}

/// Each answer must be that of the single ray.
void expect_packets_equal_rays(const TestScene& scene, const char* isa, int rounds,
                               const KdTreeTracerConfig& config = {}) {
    const auto tracer = build_forced(scene, isa, config);
    if (!tracer) return;
    RayMaker maker(scene, tracer->bounds(), 5);
    Random random(6);
    const float extent = std::max(length(tracer->bounds().extent()), 1.0f);
    OccluderCache cache;
    for (int round = 0; round < rounds; ++round) {
        // Origins on a surface's edge now and then.
        const Ray start = maker.ray(round % RayMaker::kinds);
        const vec3 origin = round % 4 == 3 ? start.org + start.dir : start.org;
        std::vector<vec3> targets = targets_around(maker, random, extent);
        if (round % 2) move_onto_surfaces(*tracer, origin, extent, targets);
        RayMask wanted{};
        for (std::size_t i = 0; i < targets.size(); ++i)
            if (round % 3 || random() % 2) set(wanted, i);
        const RayMask blocked = tracer->occluded_from(origin, Targets(targets), wanted,
                                                      round % 8 < 4 ? &cache : nullptr);
        std::vector<std::uint8_t> expected(targets.size());
        std::vector<Ray> rays;
        for (const vec3& target : targets) rays.push_back({origin, 0, target - origin, 1});
        tracer->occluded(rays, expected);
        for (std::size_t i = 0; i < targets.size(); ++i)
            ASSERT_EQ(has(blocked, i), has(wanted, i) && expected[i])
                << "round " << round << " target " << i;

        std::vector<vec3> dirs;
        for (Ray& ray : rays) dirs.push_back(ray.dir), ray.tmax = infinity;
        std::vector<Hit> hits(rays.size()), expected_hits(rays.size());
        tracer->closest_from(origin, dirs, hits);
        tracer->closest_hits(rays, expected_hits);
        for (std::size_t i = 0; i < hits.size(); ++i)
            ASSERT_EQ(hits[i], expected_hits[i]) << "round " << round << " direction " << i;
    }
}

TEST_P(TracerTest, PacketsAnswerAsSingleRays) {
    for (const char* const isa : isas) {
        SCOPED_TRACE(isa);
        expect_packets_equal_rays(GetParam(), isa, 250);
        if (GetParam().instances.size() == 1) continue;
        for (const std::size_t most : {0, 1000})
            expect_packets_equal_rays(GetParam(), isa, 250, {.baked_triangles = most});
    }
}

TEST(Tracer, PacketsAnswerAsSingleRaysInGeneratedScenes) {
    for (const GeneratedScene& generated : generated_scenes()) {
        const SceneBundle bundle = *generate_scene(generated.name);
        SCOPED_TRACE(generated.name);
        expect_packets_equal_rays(test_scene(generated.name, bundle), isas[3], 60);
    }
}

TEST_P(TracerTest, AgreesWithEmbree) { compare_with_embree(GetParam(), 14000); }

INSTANTIATE_TEST_SUITE_P(Small, TracerTest, testing::ValuesIn(small_scenes()), name_of);

/// A few rays by brute force, many against Embree.
void compare(const TestScene& scene, int count) {
    const auto tracer = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 2);
    RayMaker maker(scene, tracer->bounds(), 3);
    for (int i = 0; i < 30; ++i) {
        const Ray ray = maker.ray(i % RayMaker::kinds);
        EXPECT_EQ(tracer->closest_hit(ray), brute_force(scene, ray)) << scene.name << " ray " << i;
    }
    compare_with_embree(scene, count);
}

TEST(Tracer, AgreesOnGeneratedScenes) {
    for (const char* name : {"cornell", "office"})  // few enough triangles for brute force
        compare(test_scene(name, *generate_scene(name)), 5000);
}

TEST(Tracer, AgreesOnSharedScenes) {
    namespace fs = std::filesystem;
    const fs::path scenes = fs::path(TESSERA_SHARED_DIR) / "scenes";
    if (!fs::exists(scenes)) GTEST_SKIP() << scenes << " is not there";
    compare(test_scene("conference", load_ply(scenes / "conference/conference.ply").bundle), 4000);
    int loaded = 0;
    for (const auto& entry : fs::recursive_directory_iterator(scenes / "torture")) {
        const std::string extension = entry.path().extension();
        if (extension != ".obj" && extension != ".ply" && extension != ".gltf" &&
            extension != ".glb")
            continue;
        try {
            compare(test_scene(entry.path().filename(), load_scene(entry.path()).bundle), 1500);
            ++loaded;
        } catch (const UserError& refused) {
            std::cout << refused.what() << "\n";
        }
    }
    EXPECT_GT(loaded, 5);
}

/// Rays from inside a closed surface to its edges and vertices: one that gets out has slipped
/// between two triangles.
void expect_watertight(const TestScene& scene, std::uint32_t seed, int count) {
    const auto tracer = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 2);
    const Mesh& mesh = scene.meshes[0];
    Random random(seed);
    std::vector<Ray> rays;
    for (int i = 0; i < count; ++i) {
        const uvec3& v = mesh.triangles[random() % mesh.triangles.size()];
        const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y];
        const vec3 target = i % 4 == 0 ? a : a + uniform(random, 0, 1) * (b - a);
        const vec3 org = 0.5f * uniform_point(random, {vec3(-0.5f), vec3(0.5f)});
        const mat4& m = scene.instances[0].world_from_object;
        rays.push_back({vec3(m * vec4(org, 1)), 0, vec3(m * vec4(target - org, 0)), infinity});
    }
    std::vector<std::uint8_t> blocked(rays.size());
    tracer->occluded(rays, blocked);
    EXPECT_EQ(std::ranges::count(blocked, 0), 0) << scene.name;
}

TEST(Tracer, ClosedSurfacesDoNotLeak) {
    expect_watertight(scene_of("sphere", sphere_mesh(40, 53, 1)), 21, 500000);
    expect_watertight(scene_of("coarse", sphere_mesh(5, 7, 1)), 22, 250000);
    Mesh box;
    add_box(box, {vec3(-1), vec3(1)});
    expect_watertight(scene_of("box", box), 23, 250000);
    const mat4 turned = scale(rotate(mat4(1), 0.9f, vec3(1, 2, 3)), vec3(2, -1, 0.7f));
    expect_watertight({"turned", {sphere_mesh(40, 53, 1)}, {{0, turned}}}, 24, 250000);
}

TEST(Tracer, NanRaysAndEmptySegmentsHitNothing) {
    const TestScene scene = scene_of("room", room_mesh());
    const auto tracer = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 1);
    const float nan = std::numeric_limits<float>::quiet_NaN();
    const vec3 centre = tracer->bounds().centre();
    for (const Ray& ray :
         {Ray{vec3(nan), 0, vec3(1, 0, 0), infinity}, Ray{centre, 0, vec3(nan, 0, 1), infinity},
          Ray{centre, 0, vec3(0), infinity}, Ray{centre, 5, vec3(1, 0, 0), 4},
          Ray{centre, 0, vec3(1, 0, 0), nan}}) {
        EXPECT_FALSE(tracer->closest_hit(ray).valid());
        EXPECT_FALSE(tracer->occluded(ray));
    }
}

/// The interval is open: a hit at tmin or tmax exactly is none.
TEST(Tracer, HitsLieStrictlyInsideTheSegment) {
    Mesh mesh;
    add_triangle(mesh, vec3(-1, -1, 2), vec3(1, -1, 2), vec3(0, 1, 2));
    for (const TracerKind kind : {TracerKind::kdtree, TracerKind::embree}) {
        const auto tracer =
            build_tracer(kind, {{mesh.positions, mesh.triangles}}, {{0, mat4(1)}}, 1);
        const auto hits = [&](float tmin, float tmax) {
            return tracer->closest_hit({vec3(0), tmin, vec3(0, 0, 1), tmax}).valid();
        };
        EXPECT_TRUE(hits(0, 2.0001f));
        EXPECT_FALSE(hits(0, 2));
        EXPECT_TRUE(hits(1.9999f, 3));
        EXPECT_FALSE(hits(2, 3));
    }
}

TEST(Tracer, OfEqualHitsTheLowestInstanceAndTriangleWins) {
    Mesh mesh;
    for (int i = 0; i < 5; ++i) add_triangle(mesh, vec3(-1, -1, 2), vec3(1, -1, 2), vec3(0, 1, 2));
    const std::vector<TracerInstance> instances(3, TracerInstance{0, mat4(1)});
    const auto tracer =
        build_tracer(TracerKind::kdtree, {{mesh.positions, mesh.triangles}}, instances, 1);
    const Hit hit = tracer->closest_hit({vec3(0), 0, vec3(0, 0, 1), infinity});
    EXPECT_EQ(hit.instance, 0u);
    EXPECT_EQ(hit.triangle, 0u);
    EXPECT_EQ(hit.t, 2);
    // Weights of the second and third vertex lead back to the point.
    const vec3 p = (1 - hit.u - hit.v) * mesh.positions[0] + hit.u * mesh.positions[1] +
                   hit.v * mesh.positions[2];
    EXPECT_LT(length(p - vec3(0, 0, 2)), 1e-6f);
}

/// As many instances as a forest has trees.
TEST(Tracer, TracesThousandsOfInstances) {
    TestScene scene{"forest", {sphere_mesh(6, 7, 0.5f)}, {}};
    Random random(8);
    for (int i = 0; i < 28000; ++i)
        scene.instances.push_back(
            {0, translate(mat4(1), uniform_point(random, {vec3(0), vec3(170, 1, 170)}))});
    const auto tracer = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 2);
    RayMaker maker(scene, tracer->bounds(), 4);
    compare_with_embree(scene, 1000);
    for (int i = 0; i < 10; ++i) {
        const Ray ray = maker.ray(i % RayMaker::kinds);
        EXPECT_EQ(tracer->closest_hit(ray), brute_force(scene, ray));
    }
}

}  // namespace
}  // namespace tessera
