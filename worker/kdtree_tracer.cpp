#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <array>
#include <unordered_map>

#include "common/check.h"
#include "worker/affine.h"
#include "worker/clip.h"
#include "worker/kdtree_traverse.h"
#include "worker/triangle.h"

namespace tessera {
namespace {

// Rays are as fast in trees from 0.5 to 4; the leanest is smallest and soonest built.
constexpr KdCosts object_costs{.traversal = 1, .intersection = 0.25f};
// A ray that meets an instance is transformed and walks a tree.
constexpr KdCosts top_costs{.traversal = 1, .intersection = 20};

/// An object's tree; its leaves hold runs of blocks.
struct KdObject {
    KdTree tree;
    std::vector<TriangleBlock> blocks;
};

struct KdInstance {
    std::uint32_t object = 0;
    std::uint32_t id = 0;  ///< the caller's index
    Affine object_from_world;
};

template <class T>
std::size_t heap_bytes(const std::vector<T>& values) {
    return values.capacity() * sizeof(T);
}

std::vector<Triangle> sound_triangles(const TracerObject& object) {
    std::vector<Triangle> sound;
    sound.reserve(object.triangles.size());
    for (std::uint32_t i = 0; i < object.triangles.size(); ++i) {
        const uvec3& v = object.triangles[i];
        const Triangle triangle{object.positions[v.x], object.positions[v.y], object.positions[v.z],
                                i};
        if (!is_degenerate(triangle)) sound.push_back(triangle);
    }
    return sound;
}

/// Copies the triangles of each item list into blocks, in the order of the lists, and makes the
/// leaves count blocks instead of items: what is near in the tree is near in memory.
std::vector<TriangleBlock> pack_leaves(KdTree& tree, const std::vector<Triangle>& triangles) {
    std::vector<TriangleBlock> blocks;
    std::unordered_map<std::uint32_t, std::uint32_t> first_blocks;  // lists may be shared
    std::vector<Triangle> list;
    for (KdNode& node : tree.nodes) {
        if (!node.is_leaf() || node.item_count() == 0) continue;
        const auto [first_block, is_new] =
            first_blocks.try_emplace(node.first_item(), std::uint32_t(blocks.size()));
        if (is_new) {
            list.clear();
            for (const std::uint32_t item : tree.items_of(node)) list.push_back(triangles[item]);
            for (std::size_t i = 0; i < list.size(); i += 4)
                blocks.push_back(TriangleBlock::of(
                    std::span(list).subspan(i).first(std::min<std::size_t>(4, list.size() - i))));
        }
        node = KdNode::leaf(first_block->second, (node.item_count() + 3) / 4);
    }
    tree.items = {};
    blocks.shrink_to_fit();
    return blocks;
}

KdObject build_object(const TracerObject& object) {
    const std::vector<Triangle> triangles = sound_triangles(object);
    KdObject out;
    out.tree = build_kdtree(
        std::uint32_t(triangles.size()),
        [&](std::uint32_t i, const Box& cell) { return clipped_bounds(triangles[i], cell); },
        object_costs);
    out.blocks = pack_leaves(out.tree, triangles);
    return out;
}

/// World bounds of an instance, widened by what rounding can move a ray that is transformed into
/// the object's space.
Box instance_bounds(const Box& object_bounds, const mat4& world_from_object) {
    Box box = transformed(object_bounds, world_from_object);
    if (box.empty()) return box;
    const vec3 scale = max(abs(box.lo), abs(box.hi));
    const vec3 margin(0x1p-19f * max_component(scale));
    return {box.lo - margin, box.hi + margin};
}

/// One ray's way through the scene, and the best hit so far.
template <bool any_hit>
class Query {
public:
    explicit Query(const Ray& ray) { hit_.t = ray.tmax; }

    /// Traces through an object's tree; `ray` is in the object's space.
    void trace(const KdObject& object, const Ray& ray, std::uint32_t instance) {
        const KdRay kd_ray(ray);
        float t_near = ray.tmin, t_far = hit_.t;
        if (!kd_ray.clip(object.tree.bounds, t_near, t_far)) return;
        const TriangleRay triangle_ray(ray);
        kd_ray.traverse(object.tree, t_near, t_far, [&](const KdNode& leaf) {
            const TriangleBlock* const first = &object.blocks[leaf.first_item()];
            for (const TriangleBlock& block : std::span(first, leaf.item_count())) {
                const Mask4 misses = triangle_ray.surely_misses(block, last_t());
                if (all(misses)) continue;
                for (int i = 0; i < 4; ++i)
                    if (!misses[i]) test(triangle_ray, block, i, instance);
                if (any_hit && hit_.valid()) break;
            }
            return last_t();
        });
    }

    /// The largest t that can still change the answer.
    float last_t() const { return any_hit && hit_.valid() ? -infinity : hit_.t; }

    Hit result() const { return hit_.valid() ? hit_ : Hit{}; }

private:
    void test(const TriangleRay& ray, const TriangleBlock& block, int lane,
              std::uint32_t instance) {
        const std::uint32_t triangle = block.ids[lane];
        // The best hit so far is met again in each leaf that its triangle reaches.
        if (triangle == TriangleBlock::no_triangle ||
            (triangle == hit_.triangle && instance == hit_.instance))
            return;
        TriangleHit found;
        if (!ray.hits(block.lane(lane), found)) return;
        const auto precedes = [&] {
            return std::pair(instance, triangle) < std::pair(hit_.instance, hit_.triangle);
        };
        if (found.t < hit_.t || (found.t == hit_.t && hit_.valid() && precedes()))
            hit_ = {found.t, found.u, found.v, instance, triangle};
    }

    Hit hit_;
};

/// Remembers instances that a ray was tested against: their boxes overlap many cells, and a test is
/// expensive (Wald 2004, 9.6.1). Forgetting one costs time only.
class Mailbox {
public:
    Mailbox() { seen_.fill(~0u); }
    /// Whether `instance` was surely seen before.
    bool test_and_set(std::uint32_t instance) {
        return std::exchange(seen_[instance % seen_.size()], instance) == instance;
    }

private:
    std::array<std::uint32_t, 16> seen_;
};

class KdTreeTracer final : public Tracer {
public:
    KdTreeTracer(std::span<const TracerObject> objects, std::span<const TracerInstance> instances)
        : objects_(objects.size()) {
        tbb::parallel_for(std::size_t(0), objects.size(),
                          [&](std::size_t i) { objects_[i] = build_object(objects[i]); });
        if (instances.size() == 1 && instances[0].world_from_object == mat4(1)) {
            single_ = &objects_[instances[0].object];
            return;
        }
        build_top(instances);
    }

    void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const override {
        CHECK_EQ(rays.size(), hits.size());
        for (std::size_t i = 0; i < rays.size(); ++i) hits[i] = trace<false>(rays[i]);
    }

    void occluded(std::span<const Ray> rays, std::span<std::uint8_t> blocked) const override {
        CHECK_EQ(rays.size(), blocked.size());
        for (std::size_t i = 0; i < rays.size(); ++i) blocked[i] = trace<true>(rays[i]).valid();
    }

    Box bounds() const override { return single_ ? single_->tree.bounds : top_.bounds; }

    std::size_t memory_bytes() const override {
        std::size_t bytes = heap_bytes(top_.nodes) + heap_bytes(top_.items) +
                            heap_bytes(instances_) + heap_bytes(objects_);
        for (const KdObject& object : objects_)
            bytes += heap_bytes(object.tree.nodes) + heap_bytes(object.blocks);
        return bytes;
    }

private:
    void build_top(std::span<const TracerInstance> instances) {
        std::vector<Box> boxes;
        for (std::uint32_t i = 0; i < instances.size(); ++i) {
            const auto inverse = inverse_affine(instances[i].world_from_object);
            if (!inverse) continue;
            const Box& object_bounds = objects_[instances[i].object].tree.bounds;
            boxes.push_back(instance_bounds(object_bounds, instances[i].world_from_object));
            instances_.push_back({instances[i].object, i, *inverse});
        }
        const auto clipped = [&](std::uint32_t i, const Box& cell) {
            return Box{max(boxes[i].lo, cell.lo), min(boxes[i].hi, cell.hi)};
        };
        top_ = build_kdtree(std::uint32_t(boxes.size()), clipped, top_costs);
    }

    template <bool any_hit>
    Hit trace(const Ray& ray) const {
        // It would meet every cell, only to miss every triangle.
        if (!is_finite(ray.org) || !is_finite(ray.dir)) return {};
        Query<any_hit> query(ray);
        if (single_)
            query.trace(*single_, ray, 0);
        else
            trace_instances(ray, query);
        return query.result();
    }

    template <bool any_hit>
    void trace_instances(const Ray& ray, Query<any_hit>& query) const {
        const KdRay kd_ray(ray);
        float t_near = ray.tmin, t_far = ray.tmax;
        if (!kd_ray.clip(top_.bounds, t_near, t_far)) return;
        Mailbox mailbox;
        kd_ray.traverse(top_, t_near, t_far, [&](const KdNode& leaf) {
            for (const std::uint32_t item : top_.items_of(leaf)) {
                if (query.last_t() == -infinity) break;
                if (mailbox.test_and_set(item)) continue;
                const KdInstance& instance = instances_[item];
                query.trace(objects_[instance.object], transformed(ray, instance.object_from_world),
                            instance.id);
            }
            return query.last_t();
        });
    }

    std::vector<KdObject> objects_;
    std::vector<KdInstance> instances_;
    KdTree top_;                        ///< over instances_, in world space
    const KdObject* single_ = nullptr;  ///< of objects_, when it is all there is
};

}  // namespace

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances,
                                            int threads) {
    return tbb::task_arena(threads).execute(
        [&] { return std::make_unique<KdTreeTracer>(objects, instances); });
}

}  // namespace tessera
