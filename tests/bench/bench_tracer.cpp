// Builds and single-ray traversal, ours and Embree in one run:
//   bench_tracer [--benchmark_...] [SCENE...]      (default: office)
// Ray kinds: primary (16x16 tiles, coherent), bounce (uniform over the hemisphere, closest hit) and
// occlusion (the same, with a third of the scene's diagonal as length).
#include <benchmark/benchmark.h>

#include <cstdio>
#include <memory>
#include <random>

#include "common/check.h"
#include "common/mesh.h"
#include "common/scene_io.h"
#include "worker/ray_offset.h"
#include "worker/tracer.h"

namespace tessera {
namespace {

struct BenchScene {
    std::vector<Mesh> meshes;
    std::vector<TracerInstance> instances;
    Camera camera;

    std::unique_ptr<Tracer> build(TracerKind kind) const {
        std::vector<TracerObject> objects;
        for (const Mesh& mesh : meshes) objects.push_back({mesh.positions, mesh.triangles});
        return build_tracer(kind, objects, instances, 1);
    }
};

struct RaySets {
    std::vector<Ray> primary, bounce, occlusion;
};

BenchScene load(const std::string& name) {
    const SceneBundle bundle = load_scene(name).bundle;
    BenchScene out;
    for (const Object& object : bundle.scene.objects)
        out.meshes.push_back(decode_mesh(*bundle.blobs.find(bundle.scene.meshes[object.mesh])));
    for (const Instance& instance : bundle.scene.instances)
        out.instances.push_back({instance.object, instance.world_from_object});
    if (!bundle.scene.cameras.empty()) {
        out.camera = bundle.scene.cameras[0];
    } else {
        const Box bounds = out.build(TracerKind::kdtree)->bounds();
        out.camera.eye = bounds.lo + bounds.extent() * vec3(0.3f, 0.45f, 0.55f);
        out.camera.at = bounds.centre();
        out.camera.fov_y = 90;
    }
    return out;
}

std::vector<Ray> primary_rays(const Camera& camera) {
    constexpr int width = 512, tile = 16;
    const vec3 forward = normalize(camera.at - camera.eye);
    const float half = std::tan(glm::radians(camera.fov_y) / 2);
    const vec3 right = half * normalize(cross(forward, camera.up));
    const vec3 up = cross(right, forward);
    std::vector<Ray> rays;
    for (int i = 0; i < width * width; ++i) {
        const int t = i / (tile * tile), k = i % (tile * tile);
        const int x = t % (width / tile) * tile + k % tile;
        const int y = t / (width / tile) * tile + k / tile;
        const auto ndc = [](int p) { return (float(p) + 0.5f) * 2 / width - 1; };
        rays.push_back({camera.eye, 0, forward + ndc(x) * right - ndc(y) * up, infinity});
    }
    return rays;
}

/// A ray into the hemisphere above each point that the primary rays hit.
std::vector<Ray> bounce_rays(const BenchScene& scene, const Tracer& tracer,
                             const std::vector<Ray>& primary) {
    std::mt19937 random(1);
    std::uniform_real_distribution<float> uniform(-1, 1);
    const float scale = std::max(magnitude(tracer.bounds().lo), magnitude(tracer.bounds().hi));
    std::vector<Ray> rays;
    for (const Ray& ray : primary) {
        const Hit hit = tracer.closest_hit(ray);
        if (!hit.valid()) continue;
        const TracerInstance& instance = scene.instances[hit.instance];
        const Mesh& mesh = scene.meshes[instance.object];
        const auto corner = [&](int k) {
            return vec3(instance.world_from_object *
                        vec4(mesh.positions[mesh.triangles[hit.triangle][k]], 1));
        };
        vec3 n = normalize(cross(corner(1) - corner(0), corner(2) - corner(0)));
        if (dot(n, ray.dir) > 0) n = -n;
        const float z = uniform(random), phi = pi * uniform(random);
        const float r = std::sqrt(1 - z * z);
        vec3 dir(r * std::cos(phi), r * std::sin(phi), z);
        if (dot(dir, n) < 0) dir = -dir;
        rays.push_back({offset_point(ray.org + hit.t * ray.dir, n, dir, scale), 0, dir, infinity});
    }
    return rays;
}

RaySets make_rays(const BenchScene& scene) {
    const auto tracer = scene.build(TracerKind::kdtree);
    RaySets sets;
    sets.primary = primary_rays(scene.camera);
    sets.bounce = bounce_rays(scene, *tracer, sets.primary);
    sets.occlusion = sets.bounce;
    for (Ray& ray : sets.occlusion) ray.tmax = length(tracer->bounds().extent()) / 3;
    return sets;
}

/// Rays whose answers differ: the two must trace the same picture to be compared.
std::size_t mismatches(const Tracer& a, const Tracer& b, const RaySets& sets) {
    const float slack = 1e-6f * length(a.bounds().extent());
    std::size_t count = 0;
    for (const std::vector<Ray>* rays : {&sets.primary, &sets.bounce, &sets.occlusion})
        for (const Ray& ray : *rays) {
            const Hit x = a.closest_hit(ray), y = b.closest_hit(ray);
            count +=
                x.valid() != y.valid() || (x.valid() && std::abs(x.t - y.t) > 1e-4f * x.t + slack);
        }
    return count;
}

void report_rays(benchmark::State& state, std::size_t rays) {
    state.counters["rays/s"] =
        benchmark::Counter(double(state.iterations()) * double(rays), benchmark::Counter::kIsRate);
}

void trace_closest(benchmark::State& state, const Tracer& tracer, const std::vector<Ray>& rays) {
    std::vector<Hit> hits(rays.size());
    for (auto _ : state) tracer.closest_hits(rays, hits);
    report_rays(state, rays.size());
}

void trace_occluded(benchmark::State& state, const Tracer& tracer, const std::vector<Ray>& rays) {
    std::vector<std::uint8_t> blocked(rays.size());
    for (auto _ : state) tracer.occluded(rays, blocked);
    report_rays(state, rays.size());
}

void add_benchmarks(const std::string& name) {
    const auto scene = std::make_shared<BenchScene>(load(name));
    const auto rays = std::make_shared<RaySets>(make_rays(*scene));
    std::shared_ptr<Tracer> tracers[2];
    for (const TracerKind kind : {TracerKind::kdtree, TracerKind::embree})
        tracers[int(kind)] = scene->build(kind);
    std::printf("%s: %zu mismatches in %zu rays\n", name.c_str(),
                mismatches(*tracers[0], *tracers[1], *rays),
                rays->primary.size() + rays->bounce.size() + rays->occlusion.size());
    const auto add = [&](const char* what, auto&& run) {
        for (const TracerKind kind : {TracerKind::kdtree, TracerKind::embree}) {
            const std::string label =
                name + "/" + what + (kind == TracerKind::kdtree ? "/kdtree" : "/embree");
            benchmark::RegisterBenchmark(label.c_str(), [=](benchmark::State& state) {
                run(state, kind);
            })->Unit(benchmark::kMillisecond);
        }
    };
    add("build", [=](benchmark::State& state, TracerKind kind) {
        for (auto _ : state) benchmark::DoNotOptimize(scene->build(kind));
    });
    const std::shared_ptr<Tracer> kdtree = tracers[0], embree = tracers[1];
    const auto tracer = [=](TracerKind kind) -> const Tracer& {
        return kind == TracerKind::kdtree ? *kdtree : *embree;
    };
    add("primary", [=](benchmark::State& state, TracerKind kind) {
        trace_closest(state, tracer(kind), rays->primary);
    });
    add("bounce", [=](benchmark::State& state, TracerKind kind) {
        trace_closest(state, tracer(kind), rays->bounce);
    });
    add("occlusion", [=](benchmark::State& state, TracerKind kind) {
        trace_occluded(state, tracer(kind), rays->occlusion);
    });
}

}  // namespace
}  // namespace tessera

int main(int argc, char** argv) {
    benchmark::Initialize(&argc, argv);
    try {
        std::vector<std::string> scenes(argv + 1, argv + argc);
        if (scenes.empty()) scenes = {"office"};
        for (const std::string& scene : scenes) tessera::add_benchmarks(scene);
    } catch (const tessera::UserError& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
    benchmark::RunSpecifiedBenchmarks();
}
