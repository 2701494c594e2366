// Our tracer: kd-trees in two levels (Wald 2004, chapter 9). Each object has a tree over its
// triangles, shared by its instances; a tree over the boxes of the instances stands above, unless
// the scene is a single untransformed instance. Both are traced as wide trees (worker/wide_tree.h).
#pragma once

#include "worker/tracer.h"

namespace tessera {

/// What makes the objects' trees.
enum class TreeBuilder : std::uint8_t {
    bvh,     ///< worker/bvh.h
    kdtree,  ///< worker/kdtree.h: slow to build, and often there twice, but it splits space
};

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            TreeBuilder builder = TreeBuilder::bvh);

}  // namespace tessera
