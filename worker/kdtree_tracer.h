// Our tracer: trees in two levels (Wald 2004, chapter 9). Each object has a tree over its
// triangles, shared by its instances; a tree over the boxes of the instances stands above. What
// need not be shared is one object in world space (worker/bake.h), which is often the whole scene.
// All are traced as wide trees (worker/wide_tree.h). The thesis's kd-trees, of which the tracer has
// its name, can be chosen for the objects; worker/bvh.h tells why they are not the default.
#pragma once

#include <optional>

#include "worker/tracer.h"
#include "worker/wide_scene.h"

namespace tessera {

struct KdTreeTracerConfig {
    TreeBuilder builder = TreeBuilder::bvh;
    /// How many triangles may be baked, rather than as many as seems best.
    std::optional<std::size_t> baked_triangles = {};
};

/// Rays hit a baked triangle where baked_position() puts its corners, and any other where they hit
/// it when they are transformed to its object's space. Trees are taken over from `before`, as far
/// as it was built in this way: see build_tracer().
std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            const KdTreeTracerConfig& config = {},
                                            const Tracer* before = nullptr);

}  // namespace tessera
