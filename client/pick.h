// Which instance lies under the pointer: the viewer's own trace through the scene as it holds it,
// so that a click is answered at once, whatever the cluster is at. Every triangle of every instance
// whose box the ray meets is tried: milliseconds even in large scenes.
#pragma once

#include <optional>
#include <vector>

#include "common/scene.h"

namespace tessera {

struct Picked {
    std::uint32_t instance = 0;
    std::uint32_t material = 0;  ///< of the triangle hit
    vec3 p{0};                   ///< where, world space
    float t = infinity;
};

class Picker {
public:
    /// Decodes the meshes that `scene` names and `blobs` holds; others cannot be picked.
    Picker(const Scene& scene, const BlobStore& blobs);

    /// Whether no mesh has come or gone since.
    bool knows(const Scene& scene) const { return scene.meshes == meshes_; }

    /// The nearest instance of `scene`, which may have been edited since.
    std::optional<Picked> pick(const Scene& scene, const Ray& ray) const;

    /// World-space bounds of an instance.
    Box bounds(const Scene& scene, const Instance& instance) const;

private:
    struct Shape {
        Mesh mesh;
        Box bounds;
    };
    std::vector<BlobId> meshes_;
    std::vector<Shape> shapes_;  ///< of each
};

}  // namespace tessera
