#include "worker/bench/strategy_bench.h"

#include <fmt/format.h>
#include <tbb/task_arena.h>

#include <nlohmann/json.hpp>
#include <set>

#include "worker/bench/measure.h"
#include "worker/clip.h"
#include "worker/kdtree.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

/// Per-ray counts of table 7.5.
struct Counts {
    std::uint64_t steps = 0;  ///< inner nodes
    std::uint64_t empty_leaves = 0;
    std::uint64_t full_leaves = 0;
    std::uint64_t tests = 0;
    std::uint64_t tests_with_mailbox = 0;  ///< triangles, each counted once a ray
};

struct StrategyTree {
    std::span<const Triangle> triangles;
    KdTree tree;
};

std::vector<Triangle> world_triangles(const TestScene& scene) {
    const Mesh mesh = flattened(scene).meshes[0];
    std::vector<Triangle> triangles;
    for (const uvec3& v : mesh.triangles) {
        const Triangle t{mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z],
                         std::uint32_t(triangles.size())};
        if (!is_degenerate(t)) triangles.push_back(t);
    }
    return triangles;
}

KdTree build_tree(const std::vector<Triangle>& triangles, KdStrategy strategy) {
    return tbb::task_arena(1).execute([&] {
        return build_kdtree(
            std::uint32_t(triangles.size()),
            [&](std::uint32_t i, const Box& cell) { return clipped_bounds(triangles[i], cell); },
            {.traversal = 1, .intersection = 1, .strategy = strategy});
    });
}

bool clip_to(const Box& box, const Ray& ray, float& t_near, float& t_far) {
    for (int k = 0; k < 3; ++k) {
        const bool negative = std::signbit(ray.dir[k]);
        const float entry = ((negative ? box.hi[k] : box.lo[k]) - ray.org[k]) / ray.dir[k];
        const float exit = ((negative ? box.lo[k] : box.hi[k]) - ray.org[k]) / ray.dir[k];
        t_near = entry > t_near ? entry : t_near;
        t_far = exit < t_far ? exit : t_far;
    }
    return t_near <= t_far;
}

/// The traversal that the thesis counts (7.2.2), a ray at a time and with its errors corrected.
/// Returns the closest t.
template <bool counted>
float trace(const StrategyTree& in, const Ray& ray, Counts& counts) {
    struct Entry {
        const KdNode* node;
        float t_near, t_far;
    };
    Entry stack[kdtree_max_depth];
    int top = 0;
    const TriangleRay triangle_ray(ray);
    std::set<std::uint32_t> mailbox;
    float t_hit = ray.tmax;
    float t_near = 0, t_far = infinity;
    if (!clip_to(in.tree.bounds, ray, t_near, t_far)) return t_hit;
    const KdNode* node = in.tree.nodes.data();
    while (true) {
        while (!node->is_leaf()) {
            if constexpr (counted) ++counts.steps;
            const int axis = node->axis();
            const float d = (node->position() - ray.org[axis]) / ray.dir[axis];
            const KdNode* const children = in.tree.nodes.data() + node->lower_child();
            const bool negative = std::signbit(ray.dir[axis]);
            if (d > t_far) {
                node = children + negative;
            } else if (d < t_near) {
                node = children + !negative;
            } else {
                stack[top++] = {children + !negative, d > t_near ? d : t_near, t_far};
                node = children + negative;
                t_far = d < t_far ? d : t_far;
            }
        }
        if constexpr (counted)
            ++(node->item_count() > 0 ? counts.full_leaves : counts.empty_leaves);
        for (const std::uint32_t item : in.tree.items_of(*node)) {
            if constexpr (counted) {
                ++counts.tests;
                counts.tests_with_mailbox += mailbox.insert(item).second;
            }
            TriangleHit hit;
            if (triangle_ray.hits(in.triangles[item], hit)) t_hit = std::min(t_hit, hit.t);
        }
        // Done when the hit lies before whatever is left.
        if (top == 0 || stack[top - 1].t_near > t_hit) return t_hit;
        --top;
        node = stack[top].node;
        t_near = stack[top].t_near;
        t_far = stack[top].t_far;
    }
}

std::vector<Ray> view_rays(const Camera& camera, int side) {
    std::vector<Ray> rays;
    for (int y = 0; y < side; ++y)
        for (int x = 0; x < side; ++x)
            rays.push_back({camera.eye, 0, view_dir(camera, side, x, y), infinity});
    return rays;
}

nlohmann::json measure_strategy(const BenchScene& scene, const std::vector<Triangle>& triangles,
                                KdStrategy strategy, int view) {
    constexpr const char* names[] = {"sah", "round_robin", "middle", "plane_shifter"};
    StrategyTree in{triangles, {}};
    double start = thread_seconds();
    in.tree = build_tree(triangles, strategy);
    const double build_seconds = thread_seconds() - start;

    const std::vector<Ray> rays = view_rays(scene.camera, view);
    const auto ours =
        build_tracer(TracerKind::kdtree, scene.geometry.objects(), scene.geometry.instances, 1);
    Counts counts, unused;
    std::uint64_t mismatches = 0;
    for (const Ray& ray : rays) {
        const float t = trace<true>(in, ray, counts), expected = ours->closest_hit(ray).t;
        mismatches += !(t == expected || std::abs(t - expected) <= 1e-4f * expected);
    }
    start = thread_seconds();
    for (const Ray& ray : rays) trace<false>(in, ray, unused);
    const double seconds = thread_seconds() - start;
    const auto per_ray = [&](std::uint64_t count) { return double(count) / double(rays.size()); };
    return {{"strategy", names[int(strategy)]},
            {"build_seconds", build_seconds},
            {"nodes", in.tree.nodes.size()},
            {"items", in.tree.items.size()},
            {"steps", per_ray(counts.steps)},
            {"empty_leaves", per_ray(counts.empty_leaves)},
            {"full_leaves", per_ray(counts.full_leaves)},
            {"triangle_tests", per_ray(counts.tests)},
            {"triangle_tests_with_mailbox", per_ray(counts.tests_with_mailbox)},
            {"mrays_per_s", 1e-6 * double(rays.size()) / seconds},
            {"mismatches", mismatches}};
}

void print_strategy(const std::string& scene, const nlohmann::json& s) {
    const auto number = [&](const char* field) { return s[field].get<double>(); };
    fmt::print(
        "{:<20} {:<14} {:>7.2f} {:>6.2f} ({:.2f} + {:.2f}) {:>7.2f} / {:<6.2f} {:>6.2f} "
        "{:>8.2f} {:>9} {:>6}\n",
        scene, s["strategy"].get<std::string>(), number("steps"),
        number("empty_leaves") + number("full_leaves"), number("empty_leaves"),
        number("full_leaves"), number("triangle_tests"), number("triangle_tests_with_mailbox"),
        number("mrays_per_s"), number("build_seconds"), s["nodes"].get<std::size_t>(),
        s["mismatches"].get<std::uint64_t>());
    std::fflush(stdout);
}

/// Triangles of all instances: what a single tree would hold.
std::size_t placed_triangles(const TestScene& scene) {
    std::size_t count = 0;
    for (const TracerInstance& i : scene.instances)
        count += scene.meshes[i.object].triangles.size();
    return count;
}

}  // namespace

nlohmann::json bench_strategies(const BenchScene& scene, int view) {
    constexpr std::size_t largest_single_tree = 4'000'000;  // triangles; memory
    if (placed_triangles(scene.geometry) > largest_single_tree) return nullptr;
    const std::vector<Triangle> triangles = world_triangles(scene.geometry);
    nlohmann::json out = nlohmann::json::array();
    for (const KdStrategy strategy : {KdStrategy::round_robin, KdStrategy::middle,
                                      KdStrategy::plane_shifter, KdStrategy::sah}) {
        out.push_back(measure_strategy(scene, triangles, strategy, view));
        print_strategy(scene.geometry.name, out.back());
    }
    return out;
}

void print_strategy_heading() {
    fmt::print(
        "\nBuilding strategies (Wald 2004, tables 7.4 and 7.5), all instances in one binary "
        "tree, primary rays one by one.\n"
        "{:<20} {:<14} {:>7} {:>22} {:>16} {:>6} {:>8} {:>9} {:>6}\n",
        "scene", "strategy", "steps", "leaves (empty + full)", "tests / mailbox", "Mray/s",
        "build s", "nodes", "differ");
}

}  // namespace tessera
