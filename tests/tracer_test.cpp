// Every kind of ray, ours against brute force (bit for bit) and against Embree (disagreements are
// judged in double), and no leaks between triangles.
#include "worker/tracer.h"

#include <gtest/gtest.h>

#include "common/generator.h"
#include "tests/tracer_scenes.h"
#include "worker/affine.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

/// Tests all triangles of all instances with the tracer's own arithmetic.
Hit brute_force(const TestScene& scene, const Ray& world_ray) {
    Hit best;
    for (std::uint32_t i = 0; i < scene.instances.size(); ++i) {
        const TracerInstance& instance = scene.instances[i];
        const auto inverse = inverse_affine(instance.world_from_object);
        if (!inverse) continue;
        const bool direct = scene.instances.size() == 1 && instance.world_from_object == mat4(1);
        const TriangleRay ray(direct ? world_ray : transformed(world_ray, *inverse));
        const Mesh& mesh = scene.meshes[instance.object];
        for (std::uint32_t k = 0; k < mesh.triangles.size(); ++k) {
            const uvec3& v = mesh.triangles[k];
            const Triangle triangle{mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z],
                                    k};
            TriangleHit hit;
            if (!is_degenerate(triangle) && ray.hits(triangle, hit) && hit.t < best.t)
                best = {hit.t, hit.u, hit.v, i, k};
        }
    }
    return best;
}

/// What an exact tracer may answer: the closest t of triangles that the ray surely hits, and the
/// closest of those that it hits or grazes within rounding.
struct Verdict {
    double sure = infinity;
    double possible = infinity;
};

/// Möller and Trumbore, "Fast, Minimum Storage Ray/Triangle Intersection" (1997), in double.
Verdict judge(const TestScene& scene, const Ray& ray) {
    using glm::dmat4;
    using glm::dvec3;
    using glm::dvec4;
    Verdict verdict;
    const dvec3 org(ray.org), dir(ray.dir);
    for (const TracerInstance& instance : scene.instances) {
        if (!inverse_affine(instance.world_from_object)) continue;
        const dmat4 m(instance.world_from_object);
        const Mesh& mesh = scene.meshes[instance.object];
        for (const uvec3& v : mesh.triangles) {
            const dvec3 a(m * dvec4(mesh.positions[v.x], 1)), b(m * dvec4(mesh.positions[v.y], 1)),
                c(m * dvec4(mesh.positions[v.z], 1));
            const dvec3 p = cross(dir, c - a);
            const double det = dot(p, b - a);
            const dvec3 s = org - a, q = cross(s, b - a);
            const double u = dot(s, p) / det, w = dot(dir, q) / det, t = dot(c - a, q) / det;
            // Float rounds a ray and a transformed origin by 2^-24 of their coordinates.
            const double reach = length(s) + length(b - a) + length(c - a) + length(org);
            const double height =
                std::abs(det) / (length(dir) * std::max(length(b - a), length(c - a)));
            const double slack = 1e-6 * reach / height;
            const double inside = std::min({u, w, 1 - u - w});
            const double t_slack = 1e-6 * reach / length(dir) + slack * std::abs(t);
            if (inside > slack && t > ray.tmin + t_slack && t < ray.tmax - t_slack)
                verdict.sure = std::min(verdict.sure, t + t_slack);
            if (!(inside < -slack || t < ray.tmin - t_slack || t > ray.tmax + t_slack))
                verdict.possible =
                    std::min(verdict.possible, std::isfinite(t - t_slack) ? t - t_slack : 0);
        }
    }
    return verdict;
}

bool allowed(const Verdict& verdict, const Hit& hit) {
    const double t = hit.valid() ? double(hit.t) : double(infinity);
    return t <= verdict.sure && (t >= verdict.possible || !hit.valid());
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
            if (!allowed(verdict, hits[i])) {
                ++tally.wrong;
                ADD_FAILURE() << RayMaker::name(kind) << " ray " << i << ": t " << hits[i].t
                              << ", surely " << verdict.sure << ", possibly " << verdict.possible;
            }
            tally.embree_wrong += !allowed(verdict, embree_hits[i]);
        }
    }
    std::cout << scene.name << ": " << tally.rays << " rays, " << tally.disagreements
              << " disagreements, wrong: ours " << tally.wrong << ", Embree " << tally.embree_wrong
              << "\n";
    return tally;
}

TEST_P(TracerTest, EqualsBruteForceBitForBit) {
    const TestScene& scene = GetParam();
    const auto tracer = build_tracer(TracerKind::kdtree, scene.objects(), scene.instances, 1);
    RayMaker maker(scene, tracer->bounds(), 7);
    for (int kind = 0; kind < RayMaker::kinds; ++kind)
        for (int i = 0; i < 3000; ++i) {
            const Ray ray = maker.ray(kind);
            const Hit expected = brute_force(scene, ray);
            const Hit hit = tracer->closest_hit(ray);
            ASSERT_EQ(hit, expected)
                << RayMaker::name(kind) << " ray " << i << ": t " << hit.t << " instance "
                << hit.instance << " triangle " << hit.triangle << ", expected " << expected.t
                << " instance " << expected.instance << " triangle " << expected.triangle;
            ASSERT_EQ(tracer->occluded(ray), expected.valid());
        }
}

TEST_P(TracerTest, AgreesWithEmbree) { compare_with_embree(GetParam(), 17000); }

INSTANTIATE_TEST_SUITE_P(Small, TracerTest, testing::ValuesIn(small_scenes()), name_of);

}  // namespace
}  // namespace tessera
