// The scene decoded for rendering: meshes, textures and transforms in memory, and what a hit means.
#pragma once

#include <array>
#include <map>
#include <memory>
#include <vector>

#include "common/scene.h"
#include "worker/bsdf.h"
#include "worker/shaders.h"
#include "worker/sky.h"
#include "worker/tracer.h"

namespace tessera {

/// A point of a surface as seen from one side: both normals face the viewer. World space.
struct SurfacePoint {
    vec3 p{0};
    vec3 org{0};       ///< p moved off the surface to the viewer's side: where rays leave
    vec3 ng{0};        ///< geometric normal, unit
    vec3 n{0};         ///< shading normal, unit
    vec3 wo{0};        ///< towards the viewer, unit
    vec3 emission{0};  ///< radiance towards the viewer
    Bsdf bsdf;

    /// Where a ray in direction `dir` leaves: beside the surface, or behind it.
    vec3 leave(const vec3& dir) const { return dot(dir, ng) > 0 ? org : 2.0f * p - org; }
};

/// A triangle in world space; `ng` is the unit normal of its front (counter-clockwise in its mesh,
/// also where an instance mirrors it).
struct WorldTriangle {
    vec3 p0{0}, p1{0}, p2{0};
    vec3 ng{0};

    float area() const;
    /// The point at barycentric weights `b` (second and third vertex).
    vec3 point(const vec2& b) const { return (1 - b.x - b.y) * p0 + b.x * p1 + b.y * p2; }
    /// Added to a point of the triangle it moves it off the front, subtracted off the back, so far
    /// that rays from there do not hit the triangle again.
    vec3 off_front() const;
};

/// Triangles that rays met lately: neighbours meet the same. Never changes an answer. Keep one for
/// each thread, and one Surfaces to it.
struct TriangleCache {
    struct Entry {
        std::uint32_t instance = no_instance;
        std::uint32_t triangle = 0;
        WorldTriangle shape;
        vec3 off_front{0};
    };
    std::array<Entry, 64> entries;
};

/// Meshes, textures and materials of a scene, decoded. Immutable: any number of threads may ask.
class Surfaces {
public:
    /// Shares with `before`, of an earlier version of the scene or null, what they have in common.
    /// Throws std::runtime_error naming a blob that is missing or broken, or an index out of range.
    Surfaces(const Scene& scene, const BlobStore& blobs, const Surfaces* before = nullptr,
             std::shared_ptr<const ShaderTable> shaders = built_in_shaders());

    /// What build_tracer() wants; the spans borrow from this.
    std::vector<TracerObject> tracer_objects() const;
    std::vector<TracerInstance> tracer_instances() const;

    /// World-space bounds, at most a little too large.
    const Box& bounds() const { return bounds_; }

    /// The point that a valid `hit` of `ray` found.
    SurfacePoint at(const Ray& ray, const Hit& hit) const;
    /// The same for many rays, in `s`. `pixel`: width of what the pixel sees at the hit, across
    /// the ray, within which shaders average; 0: a point.
    void find(const Ray& ray, const Hit& hit, TriangleCache& cache, SurfacePoint& s,
              float pixel = 0) const;

    std::uint32_t instance_count() const { return std::uint32_t(scene_.instances.size()); }
    std::uint32_t object_of(std::uint32_t instance) const {
        return scene_.instances[instance].object;
    }
    std::uint32_t triangle_count(std::uint32_t instance) const;
    const Material& material(std::uint32_t instance, std::uint32_t triangle) const;
    WorldTriangle triangle(std::uint32_t instance, std::uint32_t triangle) const;
    /// Radiance of the emitting side at barycentric weights `b` (second and third vertex).
    vec3 emission(std::uint32_t instance, std::uint32_t triangle, const vec2& b) const;
    /// Mean radiance over the whole emission texture; an upper bound's stand-in for choosing.
    vec3 mean_emission(const Material& material) const;

    /// The scene's environment, with its picture.
    const std::shared_ptr<const Sky>& sky() const { return sky_; }
    /// Whether any triangle of the instance may emit.
    bool emits(std::uint32_t instance) const;
    /// How much of the surface is there at barycentric weights `b`: 0 or 1 unless it blends.
    float coverage(std::uint32_t instance, std::uint32_t triangle, const vec2& b) const;
    /// Values of textures that were not finite, or negative, and count as zero.
    std::uint64_t sanitised_texels() const;
    /// A sentence for each shader and parameter that materials ask for and this worker lacks.
    const std::vector<std::string>& shader_complaints() const { return shader_complaints_; }
    /// Whether the material, one of scene()'s, can reflect or refract ideally.
    bool may_be_ideal(const Material& material) const;
    /// The same for lobes that are not broad.
    bool has_rest(const Material& material) const;

    const Scene& scene() const { return scene_; }

private:
    struct Geometry {
        Mesh mesh;
        Box bounds;
    };
    struct Picture {
        Texture texture;
        vec3 mean{0};
        std::uint64_t sanitised = 0;
    };
    template <class T>
    using Decoded = std::map<BlobId, std::shared_ptr<const T>>;

    void decode_meshes(const BlobStore& blobs, const Surfaces* before);
    void decode_textures(const BlobStore& blobs, const Surfaces* before);
    void place_objects(const BlobStore& blobs, const Surfaces* before);
    std::shared_ptr<const Sky> make_sky(const Surfaces* before) const;
    const Mesh& mesh_of(std::uint32_t instance) const;
    const TriangleCache::Entry& cached(const Hit& hit, TriangleCache& cache) const;
    void find(const Ray& ray, const Hit& hit, const WorldTriangle& t, const vec3& off_front,
              float pixel, SurfacePoint& s) const;
    const BoundShader& shader_of(const Material& material) const;
    Bsdf shaded(const Material& material, const Hit& hit, const WorldTriangle& t, const vec2& uv,
                float pixel, bool front, SurfacePoint& s) const;
    vec2 texcoord(const Mesh& mesh, const uvec3& corners, const vec2& b) const;
    vec4 color(const TextureMap& map, const vec2& uv) const;
    float coverage(const Material& material, const vec2& uv) const;
    SurfaceLook look(const Material& material, const vec2& uv) const;
    vec3 bumped(const Material& material, const WorldTriangle& t, const Mesh& mesh,
                const uvec3& corners, const vec2& uv, const vec3& n) const;

    Scene scene_;
    Decoded<Geometry> meshes_;
    std::vector<std::shared_ptr<const Picture>> textures_;   ///< by index
    std::vector<std::shared_ptr<const Geometry>> geometry_;  ///< by object, in shape
    std::vector<const Mesh*> rest_;  ///< by mesh, as it lies when no shape bends it
    std::shared_ptr<const ShaderTable> shader_table_;
    std::vector<BoundShader> shaders_;  ///< by material; empty when none asks for one
    std::vector<std::string> shader_complaints_;
    std::shared_ptr<const Sky> sky_;
    std::vector<mat3> normal_from_object_;  ///< per instance: inverse transpose
    Box bounds_;
};

}  // namespace tessera
