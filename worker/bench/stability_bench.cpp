#include "worker/bench/stability_bench.h"

#include <fmt/format.h>
#include <tbb/parallel_for.h>
#include <unistd.h>

#include <functional>
#include <nlohmann/json.hpp>
#include <numeric>

#include "worker/bench/judge.h"
#include "worker/bench/measure.h"
#include "worker/clip.h"
#include "worker/embree_tracer.h"
#include "worker/kdtree.h"
#include "worker/kdtree_tracer.h"
#include "worker/ray_offset.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

/// A ray, and what a tracer may answer.
struct Probe {
    Ray ray;
    Verdict verdict;
};

/// From inside a closed surface, no ray gets out.
constexpr Verdict must_hit{.sure = std::numeric_limits<float>::max(), .possible = 0};
constexpr Verdict must_miss{};

/// Makes the probes of one case, in an order that its seed decides.
using MakeProbe = std::function<Probe()>;

struct Case {
    std::string name;
    TestScene scene;
    std::function<MakeProbe(const TestScene&)> probes;
    std::string note = {};
    bool embree_aborts = false;  ///< its build for Debian checks rays by assertions
    std::uint64_t most_rays = ~std::uint64_t(0);
};

struct Score {
    std::uint64_t tried = 0, wrong = 0;
    std::optional<std::uint64_t> embree_wrong, embree_robust_wrong;
};

std::uint64_t count_wrong(const Tracer& tracer, std::span<const Ray> rays,
                          std::span<const Verdict> verdicts) {
    std::vector<Hit> hits(rays.size());
    std::vector<std::uint8_t> blocked(rays.size());
    tracer.closest_hits(rays, hits);
    tracer.occluded(rays, blocked);
    std::uint64_t wrong = 0;
    for (std::size_t i = 0; i < rays.size(); ++i)
        wrong += !verdicts[i].allows(hits[i]) || !verdicts[i].allows(blocked[i] != 0);
    return wrong;
}

/// The same for rays of one origin asked for together, where there are any: they go other ways
/// through our tracer.
std::uint64_t count_wrong_packets(const Tracer& tracer, std::span<const Ray> rays,
                                  std::span<const Verdict> verdicts) {
    std::uint64_t wrong = 0;
    std::vector<vec3> dirs, targets;
    std::vector<Hit> hits;
    for (std::size_t first = 0, end = 0; first < rays.size(); first = end) {
        const vec3& org = rays[first].org;
        dirs.clear();
        targets.clear();
        for (end = first;
             end < rays.size() && end - first < Targets::max_count && rays[end].org == org; ++end) {
            dirs.push_back(rays[end].dir);
            targets.push_back(org + 4.0f * rays[end].dir);
        }
        if (end - first < 2) {
            end = std::max(end, first + 1);  // a NaN equals nothing
            continue;
        }
        hits.resize(dirs.size());
        tracer.closest_from(org, dirs, hits);
        RayMask all;
        all.fill(0xffff);
        const RayMask blocked = tracer.occluded_from(org, Targets(targets), all, nullptr);
        for (std::size_t i = 0; i < dirs.size(); ++i)
            wrong += !verdicts[first + i].allows(hits[i]) ||
                     !verdicts[first + i].allows(has(blocked, i));
    }
    return wrong;
}

/// Tells on a terminal how far a case has come, as its row may take minutes.
class Progress {
public:
    Progress(const std::string& name, std::uint64_t count)
        : name_(name), count_(count), shown_(::isatty(STDERR_FILENO) != 0) {}
    ~Progress() {
        if (shown_) fmt::print(stderr, "\r{:60}\r", "");
    }

    void tell(std::uint64_t tried) {
        if (!shown_ || wall_seconds() < next_) return;
        next_ = wall_seconds() + 0.5;
        const double part = double(tried) / double(count_);
        const double left = (wall_seconds() - start_) * (1 - part) / part;
        fmt::print(stderr, "\r{:<32} {:3.0f} %, {:.0f} s left   ", name_, 100 * part, left);
    }

private:
    const std::string& name_;
    std::uint64_t count_;
    bool shown_;
    double start_ = wall_seconds(), next_ = start_ + 1;
};

/// Probes in the order of their making, and parts of them for threads: whole runs of the rays that
/// share an origin.
struct Batch {
    static constexpr std::size_t part = 4096, parts = 16;

    std::vector<Ray> rays;
    std::vector<Verdict> verdicts;

    void add(const Probe& probe) {
        rays.push_back(probe.ray);
        verdicts.push_back(probe.verdict);
    }

    /// Sums what `count(rays, verdicts)` tells of the parts.
    template <class Count>
    std::uint64_t sum(Count&& count) const {
        std::array<std::uint64_t, parts> sums{};
        tbb::parallel_for(std::size_t(0), (rays.size() + part - 1) / part, [&](std::size_t i) {
            const std::size_t size = std::min(part, rays.size() - i * part);
            sums[i] = count(std::span(rays).subspan(i * part, size),
                            std::span(verdicts).subspan(i * part, size));
        });
        return std::accumulate(sums.begin(), sums.end(), std::uint64_t(0));
    }
};

Score run(const Case& one, std::uint64_t count) {
    const std::vector<TracerObject> objects = one.scene.objects();
    const auto ours = build_kdtree_tracer(objects, one.scene.instances, 1);
    const auto embree = build_embree_tracer(objects, one.scene.instances, 1, false);
    const auto robust = build_embree_tracer(objects, one.scene.instances, 1, true);
    const MakeProbe next = one.probes(one.scene);
    Score score;
    Progress progress(one.name, count);
    while (score.tried < count) {
        Batch batch;
        for (; batch.rays.size() < Batch::part * Batch::parts && score.tried < count; ++score.tried)
            batch.add(next());
        score.wrong += batch.sum([&](auto rays, auto verdicts) {
            return count_wrong(*ours, rays, verdicts) + count_wrong_packets(*ours, rays, verdicts);
        });
        const auto wrong_of = [&](const Tracer& tracer) {
            return batch.sum(
                [&](auto rays, auto verdicts) { return count_wrong(tracer, rays, verdicts); });
        };
        progress.tell(score.tried);
        if (one.embree_aborts) continue;
        score.embree_wrong = score.embree_wrong.value_or(0) + wrong_of(*embree);
        score.embree_robust_wrong = score.embree_robust_wrong.value_or(0) + wrong_of(*robust);
    }
    return score;
}

// Probes ------------------------------------------------------------------------------------------

Box world_bounds(const TestScene& scene) {
    const Box box = build_kdtree_tracer(scene.objects(), scene.instances, 1)->bounds();
    return box;
}

/// Rays of these kinds in turn, judged by brute force.
auto judged(std::vector<int> kinds, double precision = double_precision) {
    return [=](const TestScene& scene) -> MakeProbe {
        return [&scene, kinds, precision, maker = RayMaker(scene, world_bounds(scene), 31),
                i = std::size_t(0)]() mutable {
            const Ray ray = maker.ray(kinds[i++ % kinds.size()]);
            return Probe{ray, judge(scene, ray, precision)};
        };
    };
}

enum class Aim { edges, vertices };

/// From around the centre of a closed surface around the origin to its edges or vertices, 256 rays
/// from one point. `depth` is the reach of the origins.
auto from_inside(Aim aim, float depth = 0.25f) {
    return [=](const TestScene& scene) -> MakeProbe {
        return [&scene, aim, depth, random = Random(41), org = vec3(0), i = 0]() mutable {
            const Mesh& mesh = scene.meshes[0];
            const uvec3& v = mesh.triangles[random() % mesh.triangles.size()];
            const int k = int(random() % 3);
            const vec3 &a = mesh.positions[v[k]], &b = mesh.positions[v[(k + 1) % 3]];
            const vec3 target = aim == Aim::vertices ? a : a + uniform(random, 0, 1) * (b - a);
            if (i++ % 256 == 0) org = uniform_point(random, {vec3(-depth), vec3(depth)});
            const mat4& m = scene.instances[0].world_from_object;
            return Probe{{vec3(m * vec4(org, 1)), 0, vec3(m * vec4(target - org, 0)), infinity},
                         must_hit};
        };
    };
}

/// In the plane of a triangle, as far as float can say: across it from beside it.
MakeProbe in_triangle_planes(const TestScene& scene) {
    return [&scene, random = Random(51)]() mutable {
        const Mesh& mesh = scene.meshes[0];
        const uvec3& v = mesh.triangles[random() % mesh.triangles.size()];
        const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y], &c = mesh.positions[v.z];
        const auto point = [&](float lo, float hi) {
            const float u = uniform(random, lo, hi);
            return a + u * (b - a) + uniform(random, lo, hi) * (c - a);
        };
        const vec3 org = point(-2, 3);
        const Ray ray{org, 0, point(0, 0.5f) - org, infinity};
        return Probe{ray, judge(scene, ray, double_precision)};
    };
}

/// At points inside slivers.
MakeProbe at_triangles(const TestScene& scene) {
    return [&scene, random = Random(61)]() mutable {
        const Mesh& mesh = scene.meshes[0];
        const uvec3& v = mesh.triangles[random() % mesh.triangles.size()];
        const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y], &c = mesh.positions[v.z];
        const float u = uniform(random, 0, 1);
        const vec3 target = a + u * (b - a) + uniform(random, 0, 1 - u) * (c - a);
        const vec3 org = uniform_point(random, {vec3(-2), vec3(2)});
        const Ray ray{org, 0, target - org, infinity};
        return Probe{ray, judge(scene, ray, double_precision)};
    };
}

MakeProbe broken_rays(const TestScene&) {
    return [random = Random(71)]() mutable {
        const float nan = std::numeric_limits<float>::quiet_NaN();
        Ray ray{uniform_point(random, {vec3(-2), vec3(2)}), 0, uniform_direction(random), infinity};
        const float bad = random() & 1 ? nan : infinity;
        switch (random() % 5) {
            case 0:
                ray.org[int(random() % 3)] = bad;
                break;
            case 1:
                ray.dir[int(random() % 3)] = bad;
                break;
            case 2:
                ray.dir = vec3(0);
                break;
            case 3:
                ray.tmax = nan;
                break;
            default:
                ray.tmin = 3;
                ray.tmax = 2;
        }
        return Probe{ray, must_miss};
    };
}

enum class Fault { acne, leak };

/// Shadow rays that leave a sphere on a plane at every angle, half of them grazing, from where a
/// ray of the camera's, often grazing too, has hit. The surface a ray leaves cannot shadow it, so
/// the judge leaves its triangle out. Light that gets past what lies nearer than the offset is no
/// fault: the offset is the bound.
auto leaving_surfaces(Fault fault) {
    return [fault](const TestScene& scene) -> MakeProbe {
        return [&scene, fault, random = Random(81),
                tracer = std::shared_ptr(
                    build_kdtree_tracer(scene.objects(), scene.instances, 1))]() mutable {
            const Mesh& mesh = scene.meshes[0];
            while (true) {
                // Look at a point from nearly beside.
                const vec3 eye = uniform_point(random, {vec3(-6, 0.02f, -6), vec3(6, 2, 6)});
                const vec3 at = uniform_point(random, {vec3(-1.5f, 0, -1.5f), vec3(1.5f, 2, 1.5f)});
                const Ray view{eye, 0, at - eye, infinity};
                const Hit hit = tracer->closest_hit(view);
                if (!hit.valid()) continue;
                const uvec3& v = mesh.triangles[hit.triangle];
                const vec3 &a = mesh.positions[v.x], &b = mesh.positions[v.y],
                           &c = mesh.positions[v.z];
                vec3 ng = normalize(cross(b - a, c - a));
                if (dot(ng, view.dir) > 0) ng = -ng;

                // Leave towards a light above the surface.
                const vec3 p = view.org + hit.t * view.dir;
                const float lift = random() & 1 ? std::exp2(-uniform(random, 1, 12)) : 1;
                vec3 towards = Frame(ng).world_from_local(uniform_direction(random));
                towards += (lift * std::abs(dot(towards, ng)) - dot(towards, ng)) * ng;
                const float scale = std::max({magnitude(a), magnitude(b), magnitude(c)});
                const vec3 org = offset_point(p, ng, ng, scale);
                const Ray shadow{org, 0, 8.0f * towards, 1};
                if (!(dot(towards, ng) > 0)) continue;

                const float offset = dot(org - p, ng);
                Ray exact{p, 0, shadow.dir, 1};
                if (fault == Fault::leak)
                    exact.tmin = 4 * offset / (8 * std::abs(dot(towards, ng)));
                const Verdict verdict = judge(scene, exact, float_precision, hit.triangle);
                // The offset moves the ray sideways, so t is not compared: only hit or miss.
                if (fault == Fault::acne)
                    return Probe{shadow, {infinity, verdict.possible < infinity ? 0 : infinity}};
                return Probe{shadow, {verdict.sure < infinity ? must_hit.sure : infinity, 0}};
            }
        };
    };
}

// Scenes ------------------------------------------------------------------------------------------

TestScene moved(TestScene scene, float factor, const vec3& offset) {
    for (Mesh& mesh : scene.meshes)
        for (vec3& p : mesh.positions) p = factor * p + offset;
    return scene;
}

TestScene one_instance(const mat4& world_from_object) {
    return {"instance", {sphere_mesh(10, 13, 1)}, {{0, world_from_object}}};
}

/// Two cones of `valence` triangles each, base to base.
Mesh fans(int valence) {
    Mesh mesh;
    mesh.positions = {vec3(0, 0, 1), vec3(0, 0, -1)};
    for (int i = 0; i < valence; ++i) {
        const float phi = 2 * pi * float(i) / float(valence);
        mesh.positions.emplace_back(std::cos(phi), std::sin(phi), 0);
    }
    for (int i = 0; i < valence; ++i) {
        const auto a = std::uint32_t(2 + i), b = std::uint32_t(2 + (i + 1) % valence);
        mesh.triangles.emplace_back(0, a, b);
        mesh.triangles.emplace_back(1, b, a);
    }
    return mesh;
}

/// Triangles inside triangles, all in one plane.
Mesh nested_mesh() {
    Mesh mesh;
    for (int i = 0; i < 60; ++i) {
        const float s = std::pow(0.8f, float(i));
        add_triangle(mesh, vec3(-s, 0.5f, -s), vec3(s, 0.5f, -s), vec3(0, 0.5f, s));
    }
    return mesh;
}

/// A small dense object on the ground of a huge ring of steps.
Mesh stadium_mesh(bool with_stadium) {
    Mesh mesh = sphere_mesh(12, 17, 0.01f);
    for (int i = 0; i < 24 && with_stadium; ++i) {
        const float phi = 2 * pi * float(i) / 24;
        const vec3 at(100 * std::cos(phi), 100 * std::sin(phi), 0);
        add_box(mesh, {at - vec3(12, 12, 1), at + vec3(12, 12, 20)});
    }
    return mesh;
}

Mesh sphere_on_plane() {
    Mesh mesh = sphere_mesh(16, 21, 1, vec3(0, 1, 0));
    const auto first = std::uint32_t(mesh.positions.size());
    for (const vec3& p : {vec3(-20, 0, -20), vec3(20, 0, -20), vec3(20, 0, 20), vec3(-20, 0, 20)})
        mesh.positions.push_back(p);
    mesh.triangles.push_back(first + uvec3(0, 2, 1));
    mesh.triangles.push_back(first + uvec3(0, 3, 2));
    return mesh;
}

Mesh coincident_mesh() {
    Mesh mesh;
    for (int i = 0; i < 300; ++i)
        add_triangle(mesh, vec3(-1, -0.5f, 0.3f), vec3(1, -0.7f, -0.2f), vec3(0.1f, 1, 0));
    return mesh;
}

Mesh single_triangle() {
    Mesh mesh;
    add_triangle(mesh, vec3(0), vec3(1, 0, 0), vec3(0, 1, 0));
    return mesh;
}

/// Levels below the root of the kd-tree over the mesh's triangles.
int kdtree_depth(const Mesh& mesh) {
    const auto triangle = [&](std::uint32_t i) {
        const uvec3& v = mesh.triangles[i];
        return Triangle{mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z], i};
    };
    const KdTree tree = build_kdtree(
        std::uint32_t(mesh.triangles.size()),
        [&](std::uint32_t i, const Box& cell) { return clipped_bounds(triangle(i), cell); }, {});
    // Children come after their parents.
    std::vector<int> depth(tree.nodes.size());
    for (std::size_t i = 0; i < tree.nodes.size(); ++i) {
        if (i == 1 || tree.nodes[i].is_leaf()) continue;
        const std::uint32_t child = tree.nodes[i].lower_child();
        depth[child] = depth[child + 1] = depth[i] + 1;
    }
    return *std::ranges::max_element(depth);
}

std::vector<Case> edge_cases() {
    Mesh box;
    add_box(box, {vec3(-1), vec3(1)});
    const TestScene sphere = scene_of("sphere", sphere_mesh(40, 53, 1));
    const mat4 turned = scale(rotate(mat4(1), 0.9f, vec3(1, 2, 3)), vec3(2, -1, 0.7f));
    const TestScene fan = scene_of("fans", fans(10'000));
    const char* const slow = "no more rays: each meets thousands of triangles";
    constexpr std::uint64_t most_of_fans = 1'000'000;
    return {
        {"shared edges of a sphere", sphere, from_inside(Aim::edges)},
        {"shared vertices of a sphere", sphere, from_inside(Aim::vertices)},
        {"shared edges, coarse sphere", scene_of("coarse", sphere_mesh(5, 7, 1)),
         from_inside(Aim::edges)},
        {"shared edges of a box", scene_of("box", box), from_inside(Aim::edges)},
        {"shared edges of an instance",
         {"turned", sphere.meshes, {{0, turned}}},
         from_inside(Aim::edges)},
        {"vertices of valence 10,000", fan, from_inside(Aim::vertices), slow, false, most_of_fans},
        {"edges of valence 10,000", fan, from_inside(Aim::edges), slow, false, most_of_fans},
    };
}

std::vector<Case> other_cases() {
    constexpr int random = 0, axis_parallel = 1, in_plane = 2, edge = 3, segment = 4;
    const std::vector<int> all{random, axis_parallel, in_plane, edge, segment};
    const mat4 one(1);
    mat4 shear(1);
    shear[1][0] = 0.8f;
    shear[2][1] = -0.5f;
    TestScene singular = one_instance(one);
    for (const vec3& flat : {vec3(1, 0, 1), vec3(0), vec3(1, 1, 0)})
        singular.instances.push_back({0, translate(one, vec3(0.5f)) * scale(one, flat)});
    const TestScene room = scene_of("room", room_mesh());
    const TestScene soup = scene_of("soup", soup_mesh(300, 0.3f));
    return {
        {"axis-parallel, +0 and -0", room, judged({axis_parallel})},
        {"rays in split planes", room, judged({in_plane})},
        {"rays in triangle planes", soup, in_triangle_planes},
        {"flat cells", room, judged({random, segment})},
        {"slivers, aspect 1e4", scene_of("slivers", sliver_mesh(1e-4f)), at_triangles},
        {"slivers, aspect 1e6", scene_of("slivers", sliver_mesh(1e-6f)), at_triangles},
        {"coincident triangles", scene_of("coplanar", coplanar_mesh()), judged({random, edge})},
        {"nested coplanar triangles", scene_of("nested", nested_mesh()), judged({random, edge})},
        {"room 1e6 from the origin", moved(room, 1, vec3(1e6f, -2e6f, 3e6f)), judged(all)},
        {"soup 1e6 from the origin", moved(soup, 100, vec3(1e6f)), judged(all)},
        {"scene 1e-4 wide", moved(soup, 0.5e-4f, vec3(0)), judged(all)},
        {"scene 1e6 wide", moved(soup, 0.5e6f, vec3(0)), judged(all)},
        {"edges, sphere 1e-4 wide", scene_of("small", sphere_mesh(40, 53, 0.5e-4f)),
         from_inside(Aim::edges, 1e-5f)},
        {"edges, sphere 1e6 wide", scene_of("large", sphere_mesh(40, 53, 0.5e6f)),
         from_inside(Aim::edges, 1e5f)},
        {"teapot in a stadium", scene_of("stadium", stadium_mesh(true)), judged({random, edge})},
        {"edges of that teapot", scene_of("stadium", stadium_mesh(false)),
         from_inside(Aim::edges, 0.002f)},
        {"mirrored instance", one_instance(scale(one, vec3(-1, 1, 1))),
         judged(all, float_precision)},
        {"sheared instance", one_instance(shear), judged(all, float_precision)},
        {"instance scaled 1e-3", one_instance(scale(one, vec3(1e-3f))),
         judged(all, float_precision)},
        {"instance scaled 1e3", one_instance(scale(one, vec3(1e3f))), judged(all, float_precision)},
        {"singular instances", singular, judged(all, float_precision)},
        {"shadow acne, sphere on a plane", scene_of("grazing", sphere_on_plane()),
         leaving_surfaces(Fault::acne)},
        {"light leaks, sphere on a plane", scene_of("grazing", sphere_on_plane()),
         leaving_surfaces(Fault::leak),
         "blockers nearer than 4 offsets (32 ulps of the triangle) are not counted"},
        {"broken triangles", scene_of("broken", broken_mesh()), judged({random, edge})},
        {"broken rays", room, broken_rays, "not given to Embree, which aborts", true},
        {"empty object", scene_of("empty", {}), judged(all)},
        {"one triangle", scene_of("single", single_triangle()), judged(all)},
        {"all triangles coincide", scene_of("coincident", coincident_mesh()), judged(all)},
        {"trees deeper than 50", scene_of("shrinking", shrinking_mesh()), judged({random, edge}),
         fmt::format("{} levels", kdtree_depth(shrinking_mesh()))},
    };
}

nlohmann::json run_and_print(const Case& one, std::uint64_t rays) {
    const Score score = run(one, std::min(rays, one.most_rays));
    const auto text = [](const std::optional<std::uint64_t>& count) {
        return count ? std::to_string(*count) : "-";
    };
    const auto json = [](const std::optional<std::uint64_t>& count) {
        return count ? nlohmann::json(*count) : nlohmann::json();
    };
    fmt::print("{:<32} {:>11} {:>9} {:>9} {:>9}  {}\n", one.name, score.tried, score.wrong,
               text(score.embree_wrong), text(score.embree_robust_wrong), one.note);
    std::fflush(stdout);
    return {{"case", one.name},
            {"tried", score.tried},
            {"wrong", score.wrong},
            {"embree_wrong", json(score.embree_wrong)},
            {"embree_robust_wrong", json(score.embree_robust_wrong)},
            {"note", one.note}};
}

}  // namespace

nlohmann::json bench_stability(const StabilityBenchConfig& config) {
    fmt::print("{:<32} {:>11} {:>9} {:>9} {:>9}\n", "case", "tried", "wrong", "Embree", "ROBUST");
    nlohmann::json results = nlohmann::json::array();
    for (const Case& one : edge_cases()) results.push_back(run_and_print(one, config.edge_rays));
    for (const Case& one : other_cases()) results.push_back(run_and_print(one, config.rays));
    return results;
}

}  // namespace tessera
