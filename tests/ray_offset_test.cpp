#include "worker/ray_offset.h"

#include <gtest/gtest.h>

#include "worker/bench/tracer_scenes.h"

namespace tessera {
namespace {

struct Placement {
    float width;
    float distance;  ///< of the centre from the origin, along each axis
};

class RayOffsetTest : public testing::TestWithParam<Placement> {};

/// Rays that leave a convex surface outwards meet nothing, and rays that enter it soon meet its far
/// side, whatever its size and place.
TEST_P(RayOffsetTest, RaysNeitherHitNorCrossTheSurfaceTheyLeave) {
    const auto [width, distance] = GetParam();
    Mesh mesh;
    const vec3 centre(distance, -distance, distance);
    add_box(mesh, {centre - 0.5f * width, centre + 0.5f * width});
    const auto tracer =
        build_tracer(TracerKind::kdtree, {{mesh.positions, mesh.triangles}}, {{0, mat4(1)}}, 1);
    const float scale = max_component(max(abs(tracer->bounds().lo), abs(tracer->bounds().hi)));
    Random random(9);
    for (int i = 0; i < 20000; ++i) {
        const uvec3& v = mesh.triangles[random() % mesh.triangles.size()];
        const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y], &c = mesh.positions[v.z];
        const float u = uniform(random, 0.05f, 0.45f), w = uniform(random, 0.05f, 0.45f);
        const vec3 p = (1 - u - w) * a + u * b + w * c;
        vec3 ng = normalize(cross(b - a, c - a));
        if (dot(ng, p - centre) < 0) ng = -ng;
        vec3 dir = uniform_direction(random);
        if (std::abs(dot(dir, ng)) < 1e-3f) continue;
        const vec3 org = offset_point(p, ng, dir, scale);
        EXPECT_LE(length(org - p), 2e-5f * (scale + width));
        const Hit hit = tracer->closest_hit({org, 0, dir, infinity});
        if (dot(dir, ng) > 0)
            EXPECT_FALSE(hit.valid());
        else
            EXPECT_TRUE(hit.valid());
    }
}

INSTANTIATE_TEST_SUITE_P(Scales, RayOffsetTest,
                         testing::Values(Placement{1e-4f, 0}, Placement{1, 0}, Placement{1e3f, 0},
                                         Placement{1e6f, 0}, Placement{1e-4f, 1e-3f},
                                         Placement{1, 100}, Placement{1e3f, 1e6f},
                                         Placement{1e6f, 1e6f}),
                         [](const auto& scale) { return "Scale" + std::to_string(scale.index); });

TEST(OffsetPoint, GoesToTheSideAsked) {
    const vec3 ng(0, 0, 1);
    EXPECT_GT(offset_point(vec3(1), ng, vec3(1, 0, 0.1f)).z, 1);
    EXPECT_LT(offset_point(vec3(1), ng, vec3(1, 0, -0.1f)).z, 1);
    EXPECT_GT(offset_point(vec3(0), ng, ng, 1).z, 0);
}

}  // namespace
}  // namespace tessera
