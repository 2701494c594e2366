// Embree's side of what is built anew for every frame: meshes that deform, instances that move.
#pragma once

#include <embree3/rtcore.h>

#include "worker/bench/tracer_scenes.h"
#include "worker/embree_scene.h"

namespace tessera {

class EmbreeRebuild {
public:
    /// A mesh whose vertices move; `quality` is LOW for a new tree, or REFIT for new boxes in the
    /// tree that there is.
    static EmbreeRebuild of_mesh(const Mesh& mesh, RTCBuildQuality quality, int threads);
    /// The instances of `scene` above objects that stay as they are.
    static EmbreeRebuild of_instances(const TestScene& scene, int threads);

    /// As after everything has moved.
    void rebuild();

private:
    explicit EmbreeRebuild(int threads);
    EmbreeHandle<RTCGeometry> new_mesh(const Mesh& mesh) const;
    void attach(EmbreeHandle<RTCGeometry> geometry);

    EmbreeHandle<RTCDevice> device_;
    EmbreeHandle<RTCScene> scene_;
    std::vector<EmbreeHandle<RTCScene>> objects_;  ///< of instances
    std::vector<EmbreeHandle<RTCGeometry>> geometries_;
    std::vector<mat4> transforms_;  ///< of instances; empty for a mesh
};

}  // namespace tessera
