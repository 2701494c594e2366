// Laws of the builders and of the wide trees that their trees become.
#include "worker/wide_tree.h"

#include <gtest/gtest.h>
#include <tbb/task_arena.h>

#include <cstring>

#include "worker/bench/tracer_scenes.h"
#include "worker/bvh.h"
#include "worker/clip.h"
#include "worker/kdtree.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

constexpr int width = 8;
constexpr BvhConfig config{.block_size = width, .leaf_size = width};

BoxRef ref_of(const Box& box, std::uint32_t item) { return {box.lo, item, box.hi, 0}; }
Box box_of(const BoxRef& ref) { return {ref.lo, ref.hi}; }

RawVector<BoxRef> refs_of(const Mesh& mesh) {
    RawVector<BoxRef> refs;
    for (const uvec3& v : mesh.triangles) {
        Box box;
        for (int k = 0; k < 3; ++k) box.add(mesh.positions[v[k]]);
        if (is_finite(box.lo) && is_finite(box.hi))
            refs.push_back(ref_of(box, std::uint32_t(refs.size())));
    }
    return refs;
}

bool contains(const Box& outer, const Box& inner) {
    return all(lessThanEqual(outer.lo, inner.lo)) && all(greaterThanEqual(outer.hi, inner.hi));
}

/// A wide tree with its leaves' items, a list for each leaf.
struct Collapsed {
    WideTree<width> tree;
    std::vector<std::vector<std::uint32_t>> leaves;
};

Collapsed collapsed(const BoxTree& tree, std::uint32_t block_size = width) {
    Collapsed out;
    out.tree = collapse<width>(tree, {.block_size = block_size}, [&](auto items) {
        out.leaves.emplace_back(items.begin(), items.end());
        return WideLink::leaf(std::uint32_t(out.leaves.size()) - 1, 1);
    });
    return out;
}

/// Calls `f(box, leaf)` for each leaf below the node; checks that boxes lie in their parents'.
/// Returns the depth.
template <class F>
int visit_leaves(const Collapsed& wide, std::uint32_t node, const Box& parent, F&& f) {
    int depth = 0;
    const WideNode<width>& n = wide.tree.nodes[node];
    for (int lane = 0; lane < width; ++lane) {
        Box box;
        for (int k = 0; k < 3; ++k)
            box.lo[k] = n.bounds[k][0][lane], box.hi[k] = n.bounds[k][1][lane];
        if (box.empty()) continue;
        EXPECT_TRUE(contains(parent, box));
        const WideLink link = n.children[lane];
        if (link.is_leaf())
            f(box, wide.leaves[link.first()]);
        else
            depth = std::max(depth, 1 + visit_leaves(wide, link.first(), box, f));
    }
    return depth;
}

/// Every item lies in one leaf, and every box fits what is in it.
void expect_sound(const RawVector<BoxRef>& refs) {
    const BoxTree tree = build_bvh(refs, config);
    const Collapsed wide = collapsed(tree);
    std::vector<int> seen(refs.size());
    std::size_t largest = 0;
    const int depth = visit_leaves(wide, 0, wide.tree.bounds, [&](const Box& box, auto& items) {
        Box contents;
        for (const std::uint32_t item : items) {
            ++seen[item];
            contents.add(box_of(refs[item]));
        }
        EXPECT_EQ(box, contents);
        largest = std::max(largest, items.size());
    });
    EXPECT_EQ(std::ranges::count(seen, 1), std::ptrdiff_t(refs.size()));
    EXPECT_LE(largest, std::size_t(width) * WideLink::max_count);
    EXPECT_LT(depth * width, wide_stack_size<width>);
    Box all;
    for (const BoxRef& ref : refs) all.add(box_of(ref));
    EXPECT_EQ(wide.tree.bounds, all);
}

TEST(Bvh, HoldsEveryItemOnceInBoxesThatFit) {
    for (const TestScene& scene : small_scenes()) {
        SCOPED_TRACE(scene.name);
        for (const Mesh& mesh : scene.meshes) expect_sound(refs_of(mesh));
    }
    expect_sound(refs_of(soup_mesh(50'000, 0.02f)));
}

TEST(Bvh, StandsHardBoxes) {
    constexpr float huge = std::numeric_limits<float>::max();
    constexpr float tiny = std::numeric_limits<float>::denorm_min();
    Random random(1);
    const auto many = [](std::uint32_t count, auto&& box) {
        RawVector<BoxRef> refs;
        for (std::uint32_t i = 0; i < count; ++i) refs.push_back(ref_of(box(i), i));
        return refs;
    };
    const auto random_box = [&](float size) {
        Box box;
        box.add(uniform_point(random, {vec3(-size), vec3(size)}));
        box.add(uniform_point(random, {vec3(-size), vec3(size)}));
        return box;
    };
    // All coincide; all have one centre; all lie on a line.
    expect_sound(many(200'000, [](auto) { return Box{vec3(1), vec3(2)}; }));
    expect_sound(many(1000, [](auto i) { return Box{vec3(-float(i)), vec3(float(i))}; }));
    expect_sound(many(1000, [](auto i) {
        return Box{vec3(float(i), 0, 0), vec3(float(i), 0, 0)};
    }));
    // As large and as small as floats go, and all sizes between.
    expect_sound(many(1000, [](auto) { return Box{vec3(-huge), vec3(huge)}; }));
    expect_sound(many(1000, [&](auto) { return random_box(huge / 2); }));
    expect_sound(many(1000, [&](auto i) {
        return Box{vec3(float(i) * tiny), vec3(float(i) * tiny)};
    }));
    expect_sound(many(5000, [](auto i) {
        const vec3 p(std::ldexp(1.0f, int(i % 250) - 125));
        return Box{p, p * 1.5f};
    }));
    // None, and one.
    expect_sound({});
    expect_sound(many(1, [](auto) { return Box{vec3(0), vec3(1)}; }));
}

TEST(Bvh, IsTheSameForAnyNumberOfThreads) {
    // Large enough for tasks and for chunks.
    const RawVector<BoxRef> refs = refs_of(soup_mesh(100'000, 0.02f));
    const auto build = [&](int threads) {
        return tbb::task_arena(threads).execute([&] { return collapsed(build_bvh(refs, config)); });
    };
    const Collapsed one = build(1);
    for (const int threads : {2, 7}) {
        const Collapsed many = build(threads);
        ASSERT_EQ(one.tree.nodes.size(), many.tree.nodes.size());
        EXPECT_EQ(std::memcmp(one.tree.nodes.data(), many.tree.nodes.data(),
                              one.tree.nodes.size() * sizeof(WideNode<width>)),
                  0);
        EXPECT_EQ(one.leaves, many.leaves);
    }
}

TEST(Bvh, FillsLeavesAndLanes) {
    const Collapsed wide = collapsed(build_bvh(refs_of(sphere_mesh(100, 103, 1)), config));
    std::size_t items = 0;
    for (const auto& leaf : wide.leaves) items += leaf.size();
    EXPECT_GT(double(items), 0.75 * width * double(wide.leaves.size()));
    const double lanes = double(wide.tree.nodes.size() - 1 + wide.leaves.size());
    EXPECT_GT(lanes, 0.75 * width * double(wide.tree.nodes.size()));
}

/// Parts of triangles lie in many leaves; each point of a triangle must lie in one of them.
TEST(KdTreeBoxes, HoldEveryPointOfEveryTriangle) {
    const Mesh mesh = soup_mesh(1000, 0.2f);
    std::vector<Triangle> triangles;
    for (const uvec3& v : mesh.triangles)
        triangles.push_back({mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z],
                             std::uint32_t(triangles.size())});
    const ClippedBounds clipped = [&](std::uint32_t i, const Box& cell) {
        return clipped_bounds(triangles[i], cell);
    };
    const KdTree kd =
        build_kdtree(std::uint32_t(triangles.size()), clipped, {.intersection = 0.25f});
    const Collapsed wide = collapsed(boxes_of(kd, clipped, width));
    std::vector<std::vector<Box>> boxes(triangles.size());
    visit_leaves(wide, 0, wide.tree.bounds, [&](const Box& box, auto& items) {
        for (std::size_t i = 0; i < items.size(); ++i) {
            boxes[items[i]].push_back(box);
            EXPECT_TRUE(i == 0 || items[i - 1] < items[i]);  // once a leaf
        }
    });
    Random random(2);
    for (std::size_t i = 0; i < triangles.size(); ++i)
        for (int k = 0; k < 20; ++k) {
            const float u = uniform(random, 0, 1), v = uniform(random, 0, 1 - u);
            const Triangle& t = triangles[i];
            const vec3 p = (1 - u - v) * t.a + u * t.b + v * t.c;
            EXPECT_TRUE(std::ranges::any_of(boxes[i], [&](const Box& box) {
                return contains({box.lo - 1e-6f, box.hi + 1e-6f}, {p, p});
            }));
        }
}

}  // namespace
}  // namespace tessera
