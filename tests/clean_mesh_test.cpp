// Cleaning keeps exactly the triangles that can be hit; polygons keep their area.

#include "common/clean_mesh.h"

#include <gtest/gtest.h>

#include <random>

#include "common/polygon.h"

namespace tessera {
namespace {

TEST(CleanMesh, keeps_good_triangles_and_counts_the_rest) {
    Mesh mesh;
    mesh.positions = {{9, 9, 9}, {0, 0, 0}, {1, 0, 0}, {0, 1, 0}, {2, 0, 0}, {infinity, 0, 0}};
    mesh.texcoords = std::vector<vec2>(6, vec2(0.5f));
    mesh.texcoords[2].x = std::nanf("");
    mesh.normals = std::vector<vec3>(6, vec3(0, 1, 0));
    mesh.normals[3] = vec3(0);
    mesh.triangles = {{1, 2, 4}, {1, 1, 2}, {1, 2, 3}, {1, 2, 5}};
    mesh.slots = {0, 1, 2, 3};
    const MeshCleaning cleaning = clean_mesh(mesh);
    EXPECT_EQ(cleaning.degenerate, 2u);
    EXPECT_EQ(cleaning.not_finite, 1u);
    EXPECT_EQ(cleaning.bad_attributes, 2u);
    EXPECT_EQ(mesh.positions, (std::vector<vec3>{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}));
    EXPECT_EQ(mesh.triangles, (std::vector<uvec3>{{0, 1, 2}}));
    EXPECT_EQ(mesh.slots, (std::vector<std::uint16_t>{2}));
    EXPECT_EQ(mesh.normals[2], vec3(0, 0, 1));
    EXPECT_EQ(mesh.texcoords[1], vec2(0));
    EXPECT_EQ(describe(cleaning).size(), 3u);
}

TEST(CleanMesh, cleaning_twice_changes_nothing) {
    std::mt19937 random(1);
    for (int round = 0; round < 200; ++round) {
        Mesh mesh;
        for (int i = 0; i < 12; ++i)
            mesh.positions.push_back({random() % 3, random() % 3, random() % 2});
        for (int i = 0; i < 20; ++i)
            mesh.triangles.push_back({random() % 12, random() % 12, random() % 12});
        const std::size_t before = mesh.triangles.size();
        const MeshCleaning first = clean_mesh(mesh);
        EXPECT_EQ(mesh.triangles.size() + first.degenerate, before);
        const Mesh once = mesh;
        EXPECT_EQ(clean_mesh(mesh).degenerate, 0u);
        EXPECT_EQ(mesh, once);
    }
}

TEST(CleanMesh, triangles_too_small_for_float_areas_stay) {
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {1e-30f, 0, 0}, {0, 1e-30f, 0}};
    mesh.triangles = {{0, 1, 2}};
    EXPECT_EQ(clean_mesh(mesh).degenerate, 0u);
}

/// Twice the area against +z.
float signed_area(const std::vector<vec3>& p, const std::vector<uvec3>& triangles) {
    float sum = 0;
    for (const uvec3& t : triangles) sum += cross(p[t.y] - p[t.x], p[t.z] - p[t.x]).z;
    return sum;
}

TEST(Polygon, star_shaped_polygons_keep_area_and_facing) {
    std::mt19937 random(2);
    for (int round = 0; round < 300; ++round) {
        const int n = 3 + int(random() % 12);
        std::vector<vec3> corners;
        for (int i = 0; i < n; ++i) {
            const float angle = 2 * pi * float(i) / float(n);
            const float radius = 0.2f + float(random() % 100) / 100;
            corners.push_back({radius * std::cos(angle), radius * std::sin(angle), 0});
        }
        const std::vector<uvec3> triangles = triangulate(corners);
        ASSERT_EQ(triangles.size(), std::size_t(n - 2));
        float area = 0;
        for (int i = 0; i < n; ++i) area += cross(corners[i], corners[(i + 1) % n]).z;
        EXPECT_NEAR(signed_area(corners, triangles), area, 1e-5f);
        for (const uvec3& t : triangles) EXPECT_GT(signed_area(corners, {t}), -1e-6f);
    }
}

TEST(Polygon, what_is_no_polygon_has_no_triangles) {
    EXPECT_TRUE(triangulate({}).empty());
    EXPECT_TRUE(triangulate(std::vector<vec3>(2)).empty());
}

TEST(Polygon, impossible_corners_still_end) {
    std::vector<vec3> corners(100, vec3(std::nanf("")));
    EXPECT_EQ(triangulate(corners).size(), 98u);
    for (std::size_t i = 0; i < corners.size(); ++i) corners[i] = {float(i % 3), float(i % 7), 0};
    EXPECT_EQ(triangulate(corners).size(), 98u);
}

}  // namespace
}  // namespace tessera
