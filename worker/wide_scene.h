// What the kernels trace: two levels of wide trees (Wald 2004, chapter 9).
#pragma once

#include "worker/affine.h"
#include "worker/raw_vector.h"
#include "worker/triangle.h"
#include "worker/wide_tree.h"

namespace tessera {

/// An object's tree; its leaves hold runs of blocks.
template <int width>
struct WideObject {
    WideTree<width> tree;
    RawVector<TriangleBlock<width>> blocks;
};

struct WideInstance {
    std::uint32_t object = 0;
    std::uint32_t id = 0;  ///< the caller's index
    Affine object_from_world;
};

template <int width>
struct WideScene {
    std::vector<WideObject<width>> objects;
    bool single = false;  ///< object 0, untransformed, is all there is

    WideTree<width> top;  ///< over the instances, in world space; its leaves hold runs of items
    std::vector<std::uint32_t> items;
    std::vector<WideInstance> instances;

    const Box& bounds() const { return single ? objects[0].tree.bounds : top.bounds; }
};

}  // namespace tessera
