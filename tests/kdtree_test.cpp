#include "worker/kdtree.h"

#include <gtest/gtest.h>
#include <tbb/task_arena.h>

#include <cstring>
#include <set>

#include "worker/bench/tracer_scenes.h"
#include "worker/clip.h"

namespace tessera {
namespace {

using glm::dvec3;

std::vector<Triangle> triangles_of(const Mesh& mesh) {
    std::vector<Triangle> out;
    for (const uvec3& v : mesh.triangles) {
        const Triangle t{mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z],
                         std::uint32_t(out.size())};
        if (!is_degenerate(t)) out.push_back(t);
    }
    return out;
}

KdTree build(const std::vector<Triangle>& triangles, int threads = 1,
             KdStrategy strategy = KdStrategy::sah) {
    return tbb::task_arena(threads).execute([&] {
        return build_kdtree(
            std::uint32_t(triangles.size()),
            [&](std::uint32_t i, const Box& cell) { return clipped_bounds(triangles[i], cell); },
            {.traversal = 1, .intersection = 1, .strategy = strategy});
    });
}

dvec3 random_point_on(const Triangle& t, Random& random) {
    double u = uniform(random, 0, 1), v = uniform(random, 0, 1);
    if (u + v > 1) {
        u = 1 - u;
        v = 1 - v;
    }
    return (1 - u - v) * dvec3(t.a) + u * dvec3(t.b) + v * dvec3(t.c);
}

/// Calls `f(node, box, depth)` for the node and all below.
template <class F>
void visit(const KdTree& tree, const KdNode& node, const Box& box, int depth, F&& f) {
    f(node, box, depth);
    if (node.is_leaf()) return;
    Box below = box, above = box;
    below.hi[node.axis()] = above.lo[node.axis()] = node.position();
    visit(tree, tree.nodes[node.lower_child()], below, depth + 1, f);
    visit(tree, tree.nodes[node.lower_child() + 1], above, depth + 1, f);
}
template <class F>
void visit(const KdTree& tree, F&& f) {
    visit(tree, tree.nodes[0], tree.bounds, 0, f);
}

/// Whether a leaf whose cell holds `p` lists `item`; on a split plane either side will do.
bool is_listed(const KdTree& tree, const KdNode& node, const dvec3& p, std::uint32_t item) {
    if (node.is_leaf()) return std::ranges::count(tree.items_of(node), item) == 1;
    const double distance = p[node.axis()] - node.position();
    const double rounding = 1e-12 * (std::abs(p[node.axis()]) + std::abs(node.position()));
    const KdNode* children = &tree.nodes[node.lower_child()];
    return (distance <= rounding && is_listed(tree, children[0], p, item)) ||
           (distance >= -rounding && is_listed(tree, children[1], p, item));
}

class KdTreeTest : public testing::TestWithParam<TestScene> {
protected:
    std::vector<Triangle> triangles_ =
        GetParam().meshes.empty() ? std::vector<Triangle>{} : triangles_of(GetParam().meshes[0]);
};

TEST_P(KdTreeTest, SplitsLieInTheirCells) {
    const KdTree tree = build(triangles_);
    int deepest = 0;
    visit(tree, [&](const KdNode& node, const Box& box, int depth) {
        deepest = std::max(deepest, depth);
        if (node.is_leaf()) {
            EXPECT_LE(node.first_item() + node.item_count(), tree.items.size());
            return;
        }
        EXPECT_GE(node.position(), box.lo[node.axis()]);
        EXPECT_LE(node.position(), box.hi[node.axis()]);
        EXPECT_EQ(node.lower_child() % 2, 0u);
    });
    EXPECT_LE(deepest, kdtree_max_depth);
}

TEST_P(KdTreeTest, EveryPointOfATriangleLiesInALeafThatListsIt) {
    const KdTree tree = build(triangles_);
    Random random(1);
    for (std::uint32_t i = 0; i < triangles_.size(); ++i)
        for (int k = 0; k < 50; ++k) {
            const dvec3 p = random_point_on(triangles_[i], random);
            ASSERT_TRUE(is_listed(tree, tree.nodes[0], p, i)) << "triangle " << i;
        }
}

TEST_P(KdTreeTest, EveryStrategyListsEveryPointOfATriangle) {
    for (const KdStrategy strategy :
         {KdStrategy::round_robin, KdStrategy::middle, KdStrategy::plane_shifter}) {
        const KdTree tree = build(triangles_, 1, strategy);
        Random random(2);
        for (std::uint32_t i = 0; i < triangles_.size(); ++i)
            for (int k = 0; k < 5; ++k)
                ASSERT_TRUE(
                    is_listed(tree, tree.nodes[0], random_point_on(triangles_[i], random), i))
                    << "strategy " << int(strategy) << " triangle " << i;
    }
}

TEST_P(KdTreeTest, LeavesListOnlyTrianglesThatReachThem) {
    const KdTree tree = build(triangles_);
    visit(tree, [&](const KdNode& node, const Box& box, int) {
        if (!node.is_leaf()) return;
        for (const std::uint32_t item : tree.items_of(node))
            EXPECT_FALSE(clipped_bounds(triangles_[item], box).empty());
    });
}

TEST_P(KdTreeTest, EqualListsAreStoredOnce) {
    const KdTree tree = build(triangles_);
    std::set<std::vector<std::uint32_t>> lists;
    std::set<std::uint32_t> runs;
    visit(tree, [&](const KdNode& node, const Box&, int) {
        if (!node.is_leaf() || node.item_count() == 0) return;
        const auto items = tree.items_of(node);
        lists.insert({items.begin(), items.end()});
        runs.insert(node.first_item());
    });
    EXPECT_EQ(lists.size(), runs.size());
}

INSTANTIATE_TEST_SUITE_P(Small, KdTreeTest, testing::ValuesIn(small_scenes()),
                         [](const auto& scene) { return scene.param.name; });

TEST(KdTree, IsTheSameForAnyNumberOfThreads) {
    // Large enough to be built by many tasks.
    const std::vector<Triangle> triangles = triangles_of(soup_mesh(40000, 0.02f));
    const KdTree one = build(triangles, 1);
    for (const int threads : {2, 4}) {
        const KdTree many = build(triangles, threads);
        ASSERT_EQ(one.nodes.size(), many.nodes.size());
        EXPECT_EQ(
            std::memcmp(one.nodes.data(), many.nodes.data(), one.nodes.size() * sizeof(KdNode)), 0);
        EXPECT_EQ(one.items, many.items);
        EXPECT_EQ(one.bounds, many.bounds);
    }
}

TEST(KdTree, SeparatesFlatTrianglesIntoFlatCells) {
    Mesh mesh;
    add_box(mesh, {vec3(0), vec3(1)});
    const KdTree tree = build(triangles_of(mesh));
    int flat = 0;
    visit(tree, [&](const KdNode& node, const Box& box, int) {
        const vec3 e = box.extent();
        flat += node.is_leaf() && node.item_count() > 0 && e.x * e.y * e.z == 0;
    });
    EXPECT_GT(flat, 0);
}

TEST(KdTree, GivesUpOnTrianglesThatCoincide) {
    const std::vector<Triangle> triangles(1000, {vec3(0), vec3(1, 2, 3), vec3(0, 1, 0), 0});
    const KdTree tree = build(triangles);
    EXPECT_LT(tree.nodes.size(), 1000u);
}

TEST(Clip, BoundsHoldThePartInTheCellAndNothingOutside) {
    Random random(3);
    const Box room{vec3(-1), vec3(1)};
    for (int i = 0; i < 3000; ++i) {
        const Triangle triangle{uniform_point(random, room), uniform_point(random, room),
                                uniform_point(random, room), 0};
        Box cell;
        cell.add(uniform_point(random, room));
        cell.add(uniform_point(random, room));
        const Box part = clipped_bounds(triangle, cell);
        if (!part.empty()) {
            EXPECT_TRUE(all(greaterThanEqual(part.lo, cell.lo)));
            EXPECT_TRUE(all(lessThanEqual(part.hi, cell.hi)));
        }
        for (int k = 0; k < 50; ++k) {
            const dvec3 p = random_point_on(triangle, random);
            if (all(greaterThan(p, dvec3(cell.lo))) && all(lessThan(p, dvec3(cell.hi)))) {
                EXPECT_TRUE(all(greaterThanEqual(p, dvec3(part.lo) - 1e-15)));
                EXPECT_TRUE(all(lessThanEqual(p, dvec3(part.hi) + 1e-15)));
            }
        }
    }
}

TEST(Clip, TrianglesInAnAxisPlaneStayFlat) {
    Random random(4);
    const float x = 0.1f;
    for (int i = 0; i < 1000; ++i) {
        Triangle triangle;
        for (vec3* p : {&triangle.a, &triangle.b, &triangle.c}) {
            *p = uniform_point(random, {vec3(-1), vec3(1)});
            p->x = x;
        }
        const Box part = clipped_bounds(triangle, {vec3(-0.3f), vec3(0.4f)});
        if (part.empty()) continue;
        EXPECT_EQ(part.lo.x, x);
        EXPECT_EQ(part.hi.x, x);
    }
}

}  // namespace
}  // namespace tessera
