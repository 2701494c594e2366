// Wald, Woop, Benthin, Johnson, Ernst, "Embree: A Kernel Framework for Efficient CPU Ray Tracing"
// (2014).
#include "worker/embree_tracer.h"

#include "common/check.h"
#include "worker/embree_scene.h"

namespace tessera {
namespace {

RTCRay embree_ray(const Ray& ray) {
    // Embree accepts the ends of the segment.
    const float tnear = std::nextafter(ray.tmin, infinity);
    const float tfar = std::isinf(ray.tmax) ? ray.tmax : std::nextafter(ray.tmax, -infinity);
    return {ray.org.x, ray.org.y, ray.org.z, tnear, ray.dir.x, ray.dir.y,
            ray.dir.z, 0,         tfar,      ~0u,   0,         0};
}

class EmbreeTracer final : public Tracer {
public:
    EmbreeTracer(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
                 int threads, bool robust)
        : scene_(objects, instances, threads, robust) {}

    void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const override {
        CHECK_EQ(rays.size(), hits.size());
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        for (std::size_t i = 0; i < rays.size(); ++i) {
            RTCRayHit query{embree_ray(rays[i]), {}};
            query.hit.geomID = query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
            rtcIntersect1(scene_.root(), &context, &query);
            hits[i] = hit_of(query);
        }
    }

    void occluded(std::span<const Ray> rays, std::span<std::uint8_t> blocked) const override {
        CHECK_EQ(rays.size(), blocked.size());
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        context.flags = RTC_INTERSECT_CONTEXT_FLAG_INCOHERENT;
        for (std::size_t i = 0; i < rays.size(); ++i) {
            RTCRay query = embree_ray(rays[i]);
            rtcOccluded1(scene_.root(), &context, &query);
            blocked[i] = query.tfar < 0;  // Embree marks an occluded ray with -infinity
        }
    }

    Box bounds() const override {
        RTCBounds b;
        rtcGetSceneBounds(scene_.root(), &b);
        return {{b.lower_x, b.lower_y, b.lower_z}, {b.upper_x, b.upper_y, b.upper_z}};
    }

    std::size_t memory_bytes() const override { return scene_.memory_bytes(); }

private:
    Hit hit_of(const RTCRayHit& query) const {
        if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID) return {};
        return {query.ray.tfar, query.hit.u, query.hit.v,
                scene_.is_single() ? 0 : query.hit.instID[0], query.hit.primID};
    }

    EmbreeScene scene_;
};

}  // namespace

std::unique_ptr<Tracer> build_embree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            bool robust) {
    return std::make_unique<EmbreeTracer>(objects, instances, threads, robust);
}

}  // namespace tessera
