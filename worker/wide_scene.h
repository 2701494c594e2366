// What the kernels trace: two levels of wide trees (Wald 2004, chapter 9), and how they are built.
#pragma once

#include <atomic>
#include <memory>
#include <mutex>

#include "common/raw_vector.h"
#include "worker/affine.h"
#include "worker/bake.h"
#include "worker/tracer.h"
#include "worker/triangle.h"
#include "worker/wide_tree.h"

namespace tessera {

/// An object's tree; its leaves hold runs of blocks.
template <int width>
struct WideObject {
    WideTree<width> tree;
    RawVector<TriangleBlock<width>> blocks;

    std::size_t memory_bytes() const {
        return tree.nodes.capacity() * sizeof(tree.nodes[0]) +
               blocks.capacity() * sizeof(blocks[0]);
    }
};

/// Stands for all baked instances (worker/bake.h).
inline constexpr std::uint32_t baked_instance = no_instance - 1;

struct WideInstance {
    std::uint32_t object = 0;
    std::uint32_t id = 0;  ///< the caller's index, or baked_instance
    Affine object_from_world;

    /// Null in world space.
    const Affine* transform() const { return id == baked_instance ? nullptr : &object_from_world; }
};

/// An object that is built when a ray first asks for it.
template <int width>
class LateObject {
public:
    /// `source` must live as long; it is built by so many threads.
    LateObject(const TracerObject& source, int threads) : source_(source), threads_(threads) {}

    /// Thread-safe.
    const WideObject<width>& get() {
        if (!is_built()) build();
        return object_;
    }
    bool is_built() const { return built_.load(std::memory_order_acquire); }
    std::size_t memory_bytes() const { return is_built() ? object_.memory_bytes() : 0; }

private:
    void build();

    TracerObject source_;
    int threads_;
    std::once_flag once_;
    std::atomic<bool> built_ = false;
    WideObject<width> object_;
};

template <int width>
struct WideScene {
    /// Never null. Versions of a scene share what they have in common.
    std::vector<std::shared_ptr<const WideObject<width>>> objects;
    /// Empty, or for each object null or what it will be: `objects` then knows but its bounds.
    std::vector<std::shared_ptr<LateObject<width>>> late;
    bool single = false;                         ///< object 0, untransformed, is all there is
    std::uint32_t single_id = 0;                 ///< the instance it is
    std::shared_ptr<const TriangleNames> names;  ///< of the triangles of baked_instance

    WideTree<width>
        top;  ///< over the instances, in world space; its leaves hold runs of items, each once
    std::vector<std::uint32_t> items;
    std::vector<WideInstance> instances;

    const WideObject<width>& object(std::uint32_t i) const {
        return late.empty() || !late[i] ? *objects[i] : late[i]->get();
    }

    const Box& bounds() const { return single ? objects[0]->tree.bounds : top.bounds; }

    /// What the caller calls a triangle that was hit.
    TriangleName name_of(std::uint32_t instance, std::uint32_t triangle) const {
        return instance == baked_instance ? (*names)[triangle] : TriangleName{instance, triangle};
    }
};

/// What makes the objects' trees.
enum class TreeBuilder : std::uint8_t {
    bvh,     ///< worker/bvh.h: the default
    quick,   ///< the same with larger leaves, in four fifths of the time: for what deforms
    kdtree,  ///< worker/kdtree.h: the thesis's, to be measured
};

/// Bounds of all that can be hit, in parallel on the caller's oneTBB arena.
Box bounds_of(const TracerObject& object);

/// Builds the tree of one object, in parallel on the caller's oneTBB arena.
template <int width>
WideObject<width> build_object(const TracerObject& object, TreeBuilder builder);

/// Builds the level above `scene.objects` anew, in parallel on the caller's oneTBB arena. Of the
/// instances it leaves out the `baked` ones, if that is not empty: the last object holds them.
template <int width>
void build_top(WideScene<width>& scene, std::span<const TracerInstance> instances,
               std::span<const std::uint8_t> baked);

}  // namespace tessera
