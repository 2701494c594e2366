#include "common/scene_bounds.h"

#include "common/check.h"

namespace tessera {
namespace {

Box mesh_bounds(const BlobStore& blobs, const BlobId& id) {
    const auto blob = blobs.find(id);
    CHECK(blob != nullptr);
    Box box;
    for (const vec3& p : decode_mesh(*blob).positions) box.add(p);
    return box;
}

}  // namespace

Box scene_bounds(const SceneBundle& bundle) {
    std::vector<Box> meshes;
    for (const BlobId& id : bundle.scene.meshes) meshes.push_back(mesh_bounds(bundle.blobs, id));
    Box bounds;
    for (const Instance& instance : bundle.scene.instances) {
        const Box& mesh = meshes[bundle.scene.objects[instance.object].mesh];
        bounds.add(transformed(mesh, instance.world_from_object));
    }
    return bounds;
}

Camera framing_camera(const Box& bounds) {
    Camera camera{.name = "framing"};
    if (bounds.empty()) return camera;
    const float radius = std::max(0.5f * glm::length(bounds.extent()), 1e-6f);
    const float distance = radius / std::sin(glm::radians(0.5f * camera.fov_y));
    camera.at = bounds.centre();
    camera.eye = camera.at + distance * glm::normalize(vec3(0.3f, 0.25f, 1));
    return camera;
}

bool has_light(const Scene& scene) {
    const auto shines = [](const vec3& v) { return max_component(v) > 0; };
    if (shines(scene.environment.radiance)) return true;
    for (const Light& light : scene.lights)
        if (shines(light.intensity)) return true;
    for (const Instance& instance : scene.instances)
        for (const std::uint32_t material : scene.objects[instance.object].materials)
            if (shines(scene.materials[material].emission)) return true;
    return false;
}

}  // namespace tessera
