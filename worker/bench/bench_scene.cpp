#include "worker/bench/bench_scene.h"

#include "common/scene_bounds.h"
#include "common/scene_io.h"

namespace tessera {

std::size_t BenchScene::triangles() const {
    std::size_t count = 0;
    for (const Mesh& mesh : geometry.meshes) count += mesh.triangles.size();
    return count;
}

std::unique_ptr<Tracer> BenchScene::build_ours(int threads, TreeBuilder builder) const {
    return build_kdtree_tracer(geometry.objects(), geometry.instances, threads,
                               {.builder = builder});
}

std::unique_ptr<EmbreeScene> BenchScene::build_embree(int threads) const {
    return std::make_unique<EmbreeScene>(geometry.objects(), geometry.instances, threads, false);
}

vec3 view_dir(const Camera& camera, int side, int x, int y) {
    const vec3 forward = normalize(camera.at - camera.eye);
    const float half = std::tan(glm::radians(camera.fov_y) / 2);
    const vec3 right = half * normalize(cross(forward, camera.up));
    const vec3 up = cross(right, forward);
    const auto ndc = [&](int i) { return (float(i) + 0.5f) * 2 / float(side) - 1; };
    return forward + ndc(x) * right - ndc(y) * up;
}

BenchScene load_bench_scene(const std::string& file_or_name) {
    const SceneBundle bundle = load_scene(file_or_name).bundle;
    BenchScene out{test_scene(std::filesystem::path(file_or_name).stem().string(), bundle), {}};
    if (!bundle.scene.cameras.empty()) {
        out.camera = bundle.scene.cameras[0];
        return out;
    }
    const Box bounds = scene_bounds(bundle);
    out.camera.eye = bounds.lo + bounds.extent() * vec3(0.3f, 0.45f, 0.55f);
    out.camera.at = bounds.centre();
    out.camera.fov_y = 90;
    return out;
}

}  // namespace tessera
