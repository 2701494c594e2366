// A scene as the benchmarks need it: geometry and a view from inside.
#pragma once

#include "worker/bench/tracer_scenes.h"
#include "worker/embree_scene.h"
#include "worker/kdtree_tracer.h"

namespace tessera {

struct BenchScene {
    TestScene geometry;
    Camera camera;

    /// Triangles in memory: those of instanced objects once.
    std::size_t triangles() const;
    std::unique_ptr<Tracer> build_ours(int threads, TreeBuilder builder = TreeBuilder::bvh) const;
    std::unique_ptr<EmbreeScene> build_embree(int threads) const;
};

/// Towards pixel (x, y) of a view of `side` x `side` pixels; not unit.
vec3 view_dir(const Camera& camera, int side, int x, int y);

/// Loads a file or generates the scene of that name. A scene without a camera is seen from a point
/// inside its bounds.
BenchScene load_bench_scene(const std::string& file_or_name);

}  // namespace tessera
