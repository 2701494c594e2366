#include "worker/embree_scene.h"

#include <fmt/format.h>

#include "common/check.h"
#include "worker/affine.h"

namespace tessera {
namespace {

template <class T>
void copy_to_buffer(RTCGeometry geometry, RTCBufferType type, RTCFormat format,
                    std::span<const T> values) {
    // Embree pads its own buffers for vector loads; ours may end at the last byte of a page.
    void* buffer =
        rtcSetNewGeometryBuffer(geometry, type, 0, format, sizeof(T), std::max(values.size(), 1ul));
    std::copy(values.begin(), values.end(), static_cast<T*>(buffer));
}

bool count_bytes(void* total, ssize_t bytes, bool) {
    *static_cast<std::atomic<std::ptrdiff_t>*>(total) += bytes;
    return true;
}

}  // namespace

EmbreeScene::EmbreeScene(std::span<const TracerObject> objects,
                         std::span<const TracerInstance> instances, int threads, bool robust)
    : device_(rtcNewDevice(fmt::format("threads={}", threads).c_str())) {
    CHECK(device_ != nullptr);
    rtcSetDeviceMemoryMonitorFunction(device_.get(), count_bytes, &bytes_);
    for (const TracerObject& object : objects) objects_.push_back(object_scene(object, robust));
    if (instances.size() == 1 && instances[0].world_from_object == mat4(1))
        single_ = objects_[instances[0].object].get();
    else
        build_top(instances, robust);
    CHECK_EQ(rtcGetDeviceError(device_.get()), RTC_ERROR_NONE);
}

EmbreeScene::Scene EmbreeScene::new_scene(bool robust) const {
    Scene scene(rtcNewScene(device_.get()));
    rtcSetSceneFlags(scene.get(), robust ? RTC_SCENE_FLAG_ROBUST : RTC_SCENE_FLAG_NONE);
    rtcSetSceneBuildQuality(scene.get(), RTC_BUILD_QUALITY_HIGH);
    return scene;
}

EmbreeScene::Scene EmbreeScene::object_scene(const TracerObject& object, bool robust) const {
    Scene scene = new_scene(robust);
    if (!object.triangles.empty()) {
        const Geometry mesh(rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE));
        copy_to_buffer(mesh.get(), RTC_BUFFER_TYPE_VERTEX, RTC_FORMAT_FLOAT3, object.positions);
        copy_to_buffer(mesh.get(), RTC_BUFFER_TYPE_INDEX, RTC_FORMAT_UINT3, object.triangles);
        rtcCommitGeometry(mesh.get());
        rtcAttachGeometryByID(scene.get(), mesh.get(), 0);
    }
    rtcCommitScene(scene.get());
    return scene;
}

void EmbreeScene::build_top(std::span<const TracerInstance> instances, bool robust) {
    top_ = new_scene(robust);
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

}  // namespace tessera
