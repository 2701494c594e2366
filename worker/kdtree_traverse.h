// One ray through a kd-tree, front to back: the iterative traversal of Wald, "Realtime Ray Tracing
// and Interactive Global Illumination" (2004), 7.2.2, for both levels of the scene, for closest hit
// and for occlusion.
//
// What keeps it exact: a plane distance is used as an interval that surely holds it, so a child is
// skipped only when the ray misses it for certain, and a ray meets flat cells and cells it merely
// touches; the nearer child follows from the sign bit of the direction, which tells -0 from +0;
// comparisons are written so that a ray inside a split plane (distance NaN) visits both children
// with the whole segment; and traversal ends not at the first hit but when no cell left to visit
// starts before it.
#pragma once

#include "worker/kdtree.h"

namespace tessera {

/// What traversal needs of a ray, computed once.
class KdRay {
public:
    explicit KdRay(const Ray& ray);

    /// Clips [t_near, t_far] to the box, rounded outwards; false when nothing is left.
    bool clip(const Box& box, float& t_near, float& t_far) const;

    /// Calls `leaf(node)` for every leaf with items that the segment may meet, in order. `leaf`
    /// returns the largest t that still matters: the hit's, or -infinity to stop.
    template <class Leaf>
    void traverse(const KdTree& tree, float t_near, float t_far, Leaf&& leaf) const;

private:
    float org_[3];
    float inv_below_[3];  ///< 1 / dir, a little smaller and larger: a distance along the ray times
    float inv_above_[3];  ///< these lies surely below and above the true one
    std::uint32_t negative_[3];  ///< sign bit of dir
};

inline KdRay::KdRay(const Ray& ray) {
    // A plane distance goes through four roundings, 2^-24 each; this leaves twice as much.
    constexpr float slack = 0x1p-21f;
    for (int k = 0; k < 3; ++k) {
        const float inv = 1 / ray.dir[k];
        org_[k] = ray.org[k];
        inv_below_[k] = inv * (1 - slack);
        inv_above_[k] = inv * (1 + slack);
        negative_[k] = std::signbit(ray.dir[k]);
    }
}

inline bool KdRay::clip(const Box& box, float& t_near, float& t_far) const {
    for (int k = 0; k < 3; ++k) {
        const float entry = ((negative_[k] ? box.hi[k] : box.lo[k]) - org_[k]) * inv_below_[k];
        const float exit = ((negative_[k] ? box.lo[k] : box.hi[k]) - org_[k]) * inv_above_[k];
        // NaN, for a ray inside the face, leaves the segment as it is.
        t_near = entry > t_near ? entry : t_near;
        t_far = exit < t_far ? exit : t_far;
    }
    return t_near <= t_far;
}

template <class Leaf>
inline void KdRay::traverse(const KdTree& tree, float t_near, float t_far, Leaf&& leaf) const {
    struct Entry {
        const KdNode* node;
        float t_near, t_far;
    };
    Entry stack[kdtree_max_depth];
    Entry* top = stack;
    const KdNode* const nodes = tree.nodes.data();
    const KdNode* node = nodes;
    while (true) {
        // Go down to the nearest leaf and leave the far children for later.
        while (!node->is_leaf()) {
            const int axis = node->axis();
            const float distance = node->position() - org_[axis];
            const float below = distance * inv_below_[axis];
            const float above = distance * inv_above_[axis];
            const KdNode* const children = nodes + node->lower_child();
            const KdNode* const near_child = children + negative_[axis];
            const KdNode* const far_child = children + (negative_[axis] ^ 1);
            if (below > t_far) {
                node = near_child;
            } else if (above < t_near) {
                node = far_child;
            } else {
                *top++ = {far_child, below > t_near ? below : t_near, t_far};
                node = near_child;
                t_far = above < t_far ? above : t_far;
            }
        }
        if (node->item_count() > 0) {
            const float t_last = leaf(*node);
            // Drop the cells that start behind it.
            while (top != stack && !(top[-1].t_near <= t_last)) --top;
        }
        if (top == stack) return;
        --top;
        node = top->node;
        t_near = top->t_near;
        t_far = top->t_far;
    }
}

}  // namespace tessera
