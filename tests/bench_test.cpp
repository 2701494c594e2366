// The benchmarks' results are well formed and right, on settings too small for their times to mean
// anything.

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "worker/bench/build_bench.h"
#include "worker/bench/embree_query.h"
#include "worker/bench/light_stability.h"
#include "worker/bench/stability_bench.h"
#include "worker/bench/trace_bench.h"
#include "worker/bench/tracer_scenes.h"
#include "worker/embree_scene.h"

namespace tessera {
namespace {

TEST(Bench, TraceAnswersAsEmbreeDoes) {
    const nlohmann::json results =
        bench_trace({"cornell"}, {.view = 64, .repetitions = 1, .vpls = 2});
    ASSERT_EQ(results.size(), 4u);
    const char* kinds[] = {"primary", "vpl_shadow", "bounce", "bounce_occlusion"};
    for (std::size_t i = 0; i < 4; ++i) {
        const nlohmann::json& r = results[i];
        EXPECT_EQ(r["scene"], "cornell");
        EXPECT_EQ(r["rays"], kinds[i]);
        EXPECT_GT(r["ray_count"], 500);
        EXPECT_EQ(r["mismatches"], 0) << r;
        for (const char* field : {"ours_mrays_per_s", "embree_mrays_per_s", "ratio",
                                  "bytes_per_triangle", "embree_bytes_per_triangle"})
            EXPECT_GT(r[field], 0) << field;
    }
}

TEST(Bench, BuildCountsWhatTheStrategiesTreesCost) {
    const nlohmann::json results = bench_build({"cornell"}, {.view = 32, .repetitions = 1});
    for (const nlohmann::json& r : results)
        for (const char* field : {"triangles", "threads", "ours_seconds", "embree_seconds"})
            EXPECT_GT(r[field], 0) << field;
    const nlohmann::json& strategies = results[0]["strategies"];
    ASSERT_EQ(strategies.size(), 4u);
    for (const nlohmann::json& s : strategies) EXPECT_EQ(s["mismatches"], 0) << s;
    // Wald 2004, table 7.5: the surface area heuristic takes the fewest steps and tests.
    EXPECT_EQ(strategies[3]["strategy"], "sah");
    for (int i = 0; i < 3; ++i) EXPECT_LT(strategies[3]["steps"], strategies[i]["steps"]);
}

TEST(Bench, NothingIsWrongOnHardCases) {
    const nlohmann::json results = bench_stability({.rays = 2000, .edge_rays = 2000});
    EXPECT_GT(results.size(), 30u);
    for (const nlohmann::json& r : results) {
        EXPECT_EQ(r["tried"], 2000);
        EXPECT_EQ(r["wrong"], 0) << r["case"];
    }
}

TEST(Bench, LightIsFiniteOnHardCases) {
    const nlohmann::json results = bench_light_stability({.passes = 1});
    EXPECT_GT(results.size(), 15u);
    for (const nlohmann::json& r : results) {
        EXPECT_EQ(r["not_finite"], 0) << r["case"];
        EXPECT_EQ(r["sanitised"], 0) << r["case"];
    }
}

/// Every layout of the same rays gets the same answers, whatever fills its packets.
TEST(Bench, EveryEmbreeCallAnswersAlike) {
    const TestScene scene = scene_of("soup", soup_mesh(500, 0.3f));
    const EmbreeScene embree(scene.objects(), scene.instances, 1, true);
    Random random(1);
    std::vector<Ray> rays;
    for (int i = 0; i < 100; ++i)
        rays.push_back(
            {uniform_point(random, {vec3(-1), vec3(1)}), 0, uniform_direction(random), infinity});
    const RayGroup groups[] = {{0, 37}, {37, 0}, {37, 63}};
    for (const bool occlusion : {false, true}) {
        EmbreeQuery single(EmbreeCall::single, {.occlusion = occlusion});
        single.load(rays, groups);
        single.run(embree.root());
        for (const EmbreeCall call : embree_calls) {
            EmbreeQuery query(call, {.occlusion = occlusion});
            query.load(rays, groups);
            query.run(embree.root());
            for (std::size_t i = 0; i < rays.size(); ++i)
                EXPECT_EQ(query.answer(i).hit, single.answer(i).hit)
                    << name_of(call, occlusion) << " ray " << i;
        }
    }
}

}  // namespace
}  // namespace tessera
