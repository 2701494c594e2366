#include "client/pick.h"

#include <stdexcept>

namespace tessera {
namespace {

/// Distance to the triangle (Moeller and Trumbore, "Fast, Minimum Storage Ray/Triangle
/// Intersection", 1997), or infinity.
float distance_to(const Ray& ray, const vec3& a, const vec3& b, const vec3& c) {
    const vec3 e1 = b - a, e2 = c - a;
    const vec3 p = cross(ray.dir, e2);
    const float det = dot(e1, p);
    const vec3 s = (ray.org - a) / det;
    const float u = dot(s, p);
    const vec3 q = cross(s, e1);
    const float v = dot(ray.dir, q), t = dot(e2, q);
    return u >= 0 && v >= 0 && u + v <= 1 && t > ray.tmin ? t : infinity;
}

bool meets(const Box& box, const Ray& ray) {
    const vec3 t0 = (box.lo - ray.org) / ray.dir, t1 = (box.hi - ray.org) / ray.dir;
    const float enter = max_component(min(t0, t1));
    const vec3 leave = max(t0, t1);
    return !box.empty() && std::min({leave.x, leave.y, leave.z}) >= std::max(enter, ray.tmin);
}

/// The same points at the same `t`, in the object's space.
Ray object_ray(const Ray& ray, const mat4& world_from_object) {
    const mat4 object_from_world = inverse(world_from_object);
    return {.org = vec3(object_from_world * vec4(ray.org, 1)),
            .tmin = ray.tmin,
            .dir = vec3(object_from_world * vec4(ray.dir, 0)),
            .tmax = ray.tmax};
}

/// Empty when it is missing or broken: the workers say so.
Mesh mesh_of(const BlobStore& blobs, const BlobId& id) {
    const auto bytes = blobs.find(id);
    try {
        return bytes ? decode_mesh(*bytes) : Mesh{};
    } catch (const std::runtime_error&) {
        return {};
    }
}

}  // namespace

Picker::Picker(const Scene& scene, const BlobStore& blobs) : meshes_(scene.meshes) {
    for (const BlobId& id : scene.meshes) {
        Shape shape{.mesh = mesh_of(blobs, id), .bounds = {}};
        for (const vec3& p : shape.mesh.positions) shape.bounds.add(p);
        shapes_.push_back(std::move(shape));
    }
}

std::optional<Picked> Picker::pick(const Scene& scene, const Ray& ray) const {
    Picked nearest;
    for (std::uint32_t i = 0; i < scene.instances.size(); ++i) {
        const Object& object = scene.objects[scene.instances[i].object];
        if (object.mesh >= shapes_.size()) continue;
        const Shape& shape = shapes_[object.mesh];
        const Ray local = object_ray(ray, scene.instances[i].world_from_object);
        if (!meets(shape.bounds, local)) continue;
        const Mesh& mesh = shape.mesh;
        for (std::size_t k = 0; k < mesh.triangles.size(); ++k) {
            const uvec3& v = mesh.triangles[k];
            const float t =
                distance_to(local, mesh.positions[v.x], mesh.positions[v.y], mesh.positions[v.z]);
            if (!(t < nearest.t)) continue;
            const std::size_t slot = mesh.slots.empty() ? 0 : mesh.slots[k];
            nearest = {.instance = i,
                       .material = slot < object.materials.size() ? object.materials[slot] : 0,
                       .p = ray.org + t * ray.dir,
                       .t = t};
        }
    }
    return nearest.t < infinity ? std::optional(nearest) : std::nullopt;
}

Box Picker::bounds(const Scene& scene, const Instance& instance) const {
    const std::uint32_t mesh = scene.objects[instance.object].mesh;
    return mesh < shapes_.size() ? transformed(shapes_[mesh].bounds, instance.world_from_object)
                                 : Box{};
}

}  // namespace tessera
