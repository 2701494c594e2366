// The ray tracer as the rest of the renderer sees it. Two implementations: our wide trees
// (worker/wide_scene.h) and Embree (worker/embree_tracer.h), the independent second opinion.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <vector>

#include "common/math.h"
#include "common/tile.h"
#include "worker/targets.h"

namespace tessera {

inline constexpr std::uint32_t no_instance = 0xffffffff;

/// The closest hit of a ray. `t` counts in lengths of the ray's own `dir`; (u, v) are the
/// barycentric weights of the triangle's second and third vertex.
struct Hit {
    float t = infinity;
    float u = 0;
    float v = 0;
    std::uint32_t instance = no_instance;
    std::uint32_t triangle = 0;  ///< index into the mesh's triangles

    bool valid() const { return instance != no_instance; }
    bool operator==(const Hit&) const = default;
};

/// Object-space geometry of one object: borrowed from meshes that outlive the tracer.
struct TracerObject {
    std::span<const vec3> positions;
    std::span<const uvec3> triangles;
    bool deforms = false;  ///< changes often: built fast, and only when a ray asks
};

struct TracerInstance {
    std::uint32_t object = 0;
    mat4 world_from_object{1};
    bool moves = false;  ///< often: costs less to build anew, and rays more
};

/// Where rays from one origin were lately blocked. Speeds `Tracer::occluded_from` up and never
/// changes its answers. Keep one for each origin and thread, and one tracer to it.
struct OccluderCache {
    struct Block {
        std::uint32_t instance = no_instance;
        std::uint32_t first = 0;  ///< what the tracer knows the place by
    };
    std::array<Block, 2> blocks;  ///< the latest first
};

/// Built geometry; immutable, so any number of threads may trace at once. Triangles that are
/// degenerate or not finite are never hit; singular instances neither.
class Tracer {
public:
    virtual ~Tracer() = default;

    /// Finds for each ray the closest hit with tmin < t < tmax. Of equally close ones the lowest
    /// (instance, triangle) wins, so that the answer does not depend on the order of traversal.
    virtual void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const = 0;

    /// Sets `blocked[i]` to 1 when anything lies in tmin < t < tmax of ray i, else to 0.
    virtual void occluded(std::span<const Ray> rays, std::span<std::uint8_t> blocked) const = 0;

    /// The same for rays that share their origin: returns those of the `wanted` rays for which
    /// `occluded` answers 1 to {origin, 0, targets.point(i) - origin, 1}, the open segment to the
    /// target. `cache` may be null.
    virtual RayMask occluded_from(const vec3& origin, const Targets& targets, const RayMask& wanted,
                                  OccluderCache* cache) const;

    /// Finds what `closest_hits` finds for the rays {origin, 0, dirs[i], infinity}. Fastest for
    /// dirs in the order that `occluded_from` likes.
    virtual void closest_from(const vec3& origin, std::span<const vec3> dirs,
                              std::span<Hit> hits) const;

    /// World-space bounds of all that can be hit.
    virtual Box bounds() const = 0;

    /// Memory held for tracing, copies of the geometry included.
    virtual std::size_t memory_bytes() const = 0;

    Hit closest_hit(const Ray& ray) const {
        Hit hit;
        closest_hits({&ray, 1}, {&hit, 1});
        return hit;
    }
    bool occluded(const Ray& ray) const {
        std::uint8_t blocked = 0;
        occluded(std::span(&ray, 1), std::span(&blocked, 1));
        return blocked != 0;
    }
};

/// Builds a tracer over `objects` and `instances` with up to `threads` threads. What they have in
/// common with `before`, built from the same spans, may be taken over; it makes no difference to
/// any answer. The meshes of both must be there; `before` may go afterwards.
std::unique_ptr<Tracer> build_tracer(TracerKind kind, std::vector<TracerObject> objects,
                                     std::vector<TracerInstance> instances, int threads,
                                     const Tracer* before = nullptr);

}  // namespace tessera
