#include "worker/bench/embree_rebuild.h"

#include <fmt/format.h>

#include "common/check.h"

namespace tessera {

EmbreeRebuild::EmbreeRebuild(int threads)
    : device_(rtcNewDevice(fmt::format("threads={}", threads).c_str())),
      scene_(rtcNewScene(device_.get())) {
    rtcSetSceneFlags(scene_.get(), RTC_SCENE_FLAG_DYNAMIC);
    rtcSetSceneBuildQuality(scene_.get(), RTC_BUILD_QUALITY_LOW);
}

EmbreeRebuild EmbreeRebuild::of_mesh(const Mesh& mesh, RTCBuildQuality quality, int threads) {
    EmbreeRebuild out(threads);
    EmbreeHandle<RTCGeometry> geometry = out.new_mesh(mesh);
    rtcSetGeometryBuildQuality(geometry.get(), quality);
    out.attach(std::move(geometry));
    out.rebuild();
    return out;
}

EmbreeRebuild EmbreeRebuild::of_instances(const TestScene& scene, int threads) {
    EmbreeRebuild out(threads);
    for (const Mesh& mesh : scene.meshes) {
        const EmbreeHandle<RTCGeometry> geometry = out.new_mesh(mesh);
        rtcCommitGeometry(geometry.get());
        out.objects_.emplace_back(rtcNewScene(out.device_.get()));
        rtcAttachGeometry(out.objects_.back().get(), geometry.get());
        rtcCommitScene(out.objects_.back().get());
    }
    for (const TracerInstance& instance : scene.instances) {
        EmbreeHandle<RTCGeometry> geometry(
            rtcNewGeometry(out.device_.get(), RTC_GEOMETRY_TYPE_INSTANCE));
        rtcSetGeometryInstancedScene(geometry.get(), out.objects_[instance.object].get());
        out.transforms_.push_back(instance.world_from_object);
        out.attach(std::move(geometry));
    }
    out.rebuild();
    return out;
}

EmbreeHandle<RTCGeometry> EmbreeRebuild::new_mesh(const Mesh& mesh) const {
    EmbreeHandle<RTCGeometry> geometry(rtcNewGeometry(device_.get(), RTC_GEOMETRY_TYPE_TRIANGLE));
    const auto set = [&](RTCBufferType type, RTCFormat format, const auto& values) {
        void* const buffer = rtcSetNewGeometryBuffer(geometry.get(), type, 0, format,
                                                     sizeof values[0], values.size());
        std::ranges::copy(values, static_cast<std::decay_t<decltype(values[0])>*>(buffer));
    };
    set(RTC_BUFFER_TYPE_VERTEX, RTC_FORMAT_FLOAT3, mesh.positions);
    set(RTC_BUFFER_TYPE_INDEX, RTC_FORMAT_UINT3, mesh.triangles);
    return geometry;
}

void EmbreeRebuild::attach(EmbreeHandle<RTCGeometry> geometry) {
    rtcAttachGeometry(scene_.get(), geometry.get());
    geometries_.push_back(std::move(geometry));
}

void EmbreeRebuild::rebuild() {
    for (std::size_t i = 0; i < geometries_.size(); ++i) {
        if (transforms_.empty())
            rtcUpdateGeometryBuffer(geometries_[i].get(), RTC_BUFFER_TYPE_VERTEX, 0);
        else
            rtcSetGeometryTransform(geometries_[i].get(), 0, RTC_FORMAT_FLOAT4X4_COLUMN_MAJOR,
                                    &transforms_[i][0][0]);
        rtcCommitGeometry(geometries_[i].get());
    }
    rtcCommitScene(scene_.get());
    CHECK_EQ(rtcGetDeviceError(device_.get()), RTC_ERROR_NONE);
}

}  // namespace tessera
