// Our tracer: trees in two levels (Wald 2004, chapter 9). Each object has a tree over its
// triangles, shared by its instances; a tree over the boxes of the instances stands above, unless
// the scene is a single untransformed instance. Both are traced as wide trees (worker/wide_tree.h).
// The thesis's kd-trees, of which the tracer has its name, can be chosen for the objects;
// worker/bvh.h tells why they are not the default.
#pragma once

#include "worker/tracer.h"
#include "worker/wide_scene.h"

namespace tessera {

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            TreeBuilder builder = TreeBuilder::bvh);

}  // namespace tessera
