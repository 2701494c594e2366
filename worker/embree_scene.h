// Embree's side of a scene: one Embree scene for each object, and one of instances above; a single
// untransformed instance stands alone. Includes Embree's header: only for who calls Embree itself.
#pragma once

#include <embree3/rtcore.h>

#include <atomic>
#include <memory>
#include <span>
#include <vector>

#include "worker/tracer.h"

namespace tessera {

struct EmbreeRelease {
    void operator()(RTCDevice device) const { rtcReleaseDevice(device); }
    void operator()(RTCScene scene) const { rtcReleaseScene(scene); }
    void operator()(RTCGeometry geometry) const { rtcReleaseGeometry(geometry); }
};
template <class Handle>
using EmbreeHandle = std::unique_ptr<std::remove_pointer_t<Handle>, EmbreeRelease>;

class EmbreeScene {
public:
    /// Built at HIGH quality with up to `threads` threads. `robust` is Embree's flag: slower, and
    /// watertight.
    EmbreeScene(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
                int threads, bool robust);

    RTCScene root() const { return single_ ? single_ : top_.get(); }
    /// Whether there is no level of instances, and hits so carry no instance id.
    bool is_single() const { return single_ != nullptr; }

    /// What Embree holds, its copies of the vertex and index buffers included.
    std::size_t memory_bytes() const { return std::size_t(bytes_.load()); }

private:
    using Device = EmbreeHandle<RTCDevice>;
    using Scene = EmbreeHandle<RTCScene>;
    using Geometry = EmbreeHandle<RTCGeometry>;

    Scene new_scene(bool robust) const;
    Scene object_scene(const TracerObject& object, bool robust) const;
    void build_top(std::span<const TracerInstance> instances, bool robust);

    std::atomic<std::ptrdiff_t> bytes_{0};  ///< told by the device, from many threads
    Device device_;
    std::vector<Scene> objects_;
    Scene top_;
    RTCScene single_ = nullptr;  ///< of objects_, when it is all there is
};

}  // namespace tessera
