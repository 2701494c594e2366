#include "worker/tracer.h"

#include "common/check.h"
#include "worker/embree_tracer.h"
#include "worker/kdtree_tracer.h"

namespace tessera {

RayMask Tracer::occluded_from(const vec3& origin, const Targets& targets, const RayMask& wanted,
                              OccluderCache*) const {
    RayMask blocked{};
    for (std::size_t i = 0; i < Targets::max_count; ++i)
        if (has(wanted, i) && has(targets.finite, i) &&
            occluded({origin, 0, targets.point(i) - origin, 1}))
            set(blocked, i);
    return blocked;
}

void Tracer::closest_from(const vec3& origin, std::span<const vec3> dirs,
                          std::span<Hit> hits) const {
    std::vector<Ray> rays;
    rays.reserve(dirs.size());
    for (const vec3& dir : dirs) rays.push_back({origin, 0, dir, infinity});
    closest_hits(rays, hits);
}

std::unique_ptr<Tracer> build_tracer(TracerKind kind, std::vector<TracerObject> objects,
                                     std::vector<TracerInstance> instances, int threads,
                                     const Tracer* before) {
    CHECK(threads > 0);
    for (const TracerInstance& instance : instances) CHECK(instance.object < objects.size());
    switch (kind) {
        case TracerKind::kdtree:
            return build_kdtree_tracer(objects, instances, threads, {}, before);
        case TracerKind::embree:
            return build_embree_tracer(objects, instances, threads);
    }
    CHECK(!"a tracer kind");
    return nullptr;
}

}  // namespace tessera
