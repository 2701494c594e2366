// Wald, Woop, Benthin, Johnson, Ernst, "Embree: A Kernel Framework for Efficient CPU Ray Tracing"
// (2014). One Embree scene for each object, and one of instances above; a single untransformed
// instance is traced without the upper one.
#include "worker/embree_tracer.h"

#include <embree3/rtcore.h>
#include <fmt/format.h>

#include "common/check.h"
#include "worker/affine.h"

namespace tessera {
namespace {

struct Release {
    void operator()(RTCDevice device) const { rtcReleaseDevice(device); }
    void operator()(RTCScene scene) const { rtcReleaseScene(scene); }
    void operator()(RTCGeometry geometry) const { rtcReleaseGeometry(geometry); }
};
using Device = std::unique_ptr<std::remove_pointer_t<RTCDevice>, Release>;
using EmbreeScene = std::unique_ptr<std::remove_pointer_t<RTCScene>, Release>;
using Geometry = std::unique_ptr<std::remove_pointer_t<RTCGeometry>, Release>;

EmbreeScene new_scene(RTCDevice device) {
    EmbreeScene scene(rtcNewScene(device));
    rtcSetSceneFlags(scene.get(), RTC_SCENE_FLAG_ROBUST);
    rtcSetSceneBuildQuality(scene.get(), RTC_BUILD_QUALITY_HIGH);
    return scene;
}

template <class T>
void copy_to_buffer(RTCGeometry geometry, RTCBufferType type, RTCFormat format,
                    std::span<const T> values) {
    // Embree pads its own buffers for vector loads; ours may end at the last byte of a page.
    void* buffer =
        rtcSetNewGeometryBuffer(geometry, type, 0, format, sizeof(T), std::max(values.size(), 1ul));
    std::copy(values.begin(), values.end(), static_cast<T*>(buffer));
}

EmbreeScene object_scene(RTCDevice device, const TracerObject& object) {
    EmbreeScene scene = new_scene(device);
    if (!object.triangles.empty()) {
        const Geometry mesh(rtcNewGeometry(device, RTC_GEOMETRY_TYPE_TRIANGLE));
        copy_to_buffer(mesh.get(), RTC_BUFFER_TYPE_VERTEX, RTC_FORMAT_FLOAT3, object.positions);
        copy_to_buffer(mesh.get(), RTC_BUFFER_TYPE_INDEX, RTC_FORMAT_UINT3, object.triangles);
        rtcCommitGeometry(mesh.get());
        rtcAttachGeometryByID(scene.get(), mesh.get(), 0);
    }
    rtcCommitScene(scene.get());
    return scene;
}

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
                 int threads)
        : device_(rtcNewDevice(fmt::format("threads={}", threads).c_str())) {
        CHECK(device_ != nullptr);
        for (const TracerObject& object : objects)
            objects_.push_back(object_scene(device_.get(), object));
        if (instances.size() == 1 && instances[0].world_from_object == mat4(1))
            single_ = objects_[instances[0].object].get();
        else
            build_top(instances);
        CHECK_EQ(rtcGetDeviceError(device_.get()), RTC_ERROR_NONE);
    }

    void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const override {
        CHECK_EQ(rays.size(), hits.size());
        RTCIntersectContext context;
        rtcInitIntersectContext(&context);
        for (std::size_t i = 0; i < rays.size(); ++i) {
            RTCRayHit query{embree_ray(rays[i]), {}};
            query.hit.geomID = query.hit.instID[0] = RTC_INVALID_GEOMETRY_ID;
            rtcIntersect1(root(), &context, &query);
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
            rtcOccluded1(root(), &context, &query);
            blocked[i] = query.tfar < 0;  // Embree marks an occluded ray with -infinity
        }
    }

    Box bounds() const override {
        RTCBounds b;
        rtcGetSceneBounds(root(), &b);
        return {{b.lower_x, b.lower_y, b.lower_z}, {b.upper_x, b.upper_y, b.upper_z}};
    }

private:
    void build_top(std::span<const TracerInstance> instances) {
        top_ = new_scene(device_.get());
        for (std::uint32_t i = 0; i < instances.size(); ++i) {
            if (!inverse_affine(instances[i].world_from_object)) continue;
            const Geometry instance(rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_INSTANCE));
            rtcSetGeometryInstancedScene(instance.get(), objects_[instances[i].object].get());
            rtcSetGeometryTransform(instance.get(), 0, RTC_FORMAT_FLOAT4X4_COLUMN_MAJOR,
                                    &instances[i].world_from_object[0][0]);
            rtcCommitGeometry(instance.get());
            rtcAttachGeometryByID(top_.get(), instance.get(), i);
        }
        rtcCommitScene(top_.get());
    }

    RTCScene root() const { return single_ ? single_ : top_.get(); }

    Hit hit_of(const RTCRayHit& query) const {
        if (query.hit.geomID == RTC_INVALID_GEOMETRY_ID) return {};
        return {query.ray.tfar, query.hit.u, query.hit.v, single_ ? 0 : query.hit.instID[0],
                query.hit.primID};
    }

    Device device_;
    std::vector<EmbreeScene> objects_;
    EmbreeScene top_;
    RTCScene single_ = nullptr;  ///< of objects_, when it is all there is
};

}  // namespace

std::unique_ptr<Tracer> build_embree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances,
                                            int threads) {
    return std::make_unique<EmbreeTracer>(objects, instances, threads);
}

}  // namespace tessera
