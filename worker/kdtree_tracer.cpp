#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <array>
#include <atomic>
#include <numeric>

#include "common/check.h"
#include "worker/affine.h"
#include "worker/bvh.h"
#include "worker/clip.h"
#include "worker/kdtree.h"
#include "worker/kernels.h"

namespace tessera {
namespace {

// Rays are as fast in trees from 0.5 to 4; the leanest is smallest and soonest built.
constexpr KdCosts object_costs{.traversal = 1, .intersection = 0.25f};

Triangle triangle_of(const TracerObject& object, std::uint32_t i) {
    const uvec3& v = object.triangles[i];
    return {object.positions[v.x], object.positions[v.y], object.positions[v.z], i};
}

/// Bounds of all triangles that can be hit.
RawVector<BoxRef> triangle_refs(const TracerObject& object) {
    constexpr std::uint32_t none = ~0u;
    RawVector<BoxRef> refs(object.triangles.size());
    std::atomic<bool> complete = true;
    tbb::parallel_for(std::uint32_t(0), std::uint32_t(refs.size()), [&](std::uint32_t i) {
        const Triangle t = triangle_of(object, i);
        const bool sound = !is_degenerate(t);
        refs[i] = {min(t.a, min(t.b, t.c)), sound ? i : none, max(t.a, max(t.b, t.c)), 0};
        if (!sound) complete = false;
    });
    if (!complete) std::erase_if(refs, [](const BoxRef& ref) { return ref.item == none; });
    return refs;
}

BoxTree kd_boxes(const TracerObject& object, std::uint32_t leaf_size) {
    const ClippedBounds clipped = [&](std::uint32_t i, const Box& cell) {
        const Triangle triangle = triangle_of(object, i);
        return is_degenerate(triangle) ? Box{} : clipped_bounds(triangle, cell);
    };
    const auto count = std::uint32_t(object.triangles.size());
    return boxes_of(build_kdtree(count, clipped, object_costs), clipped, leaf_size);
}

template <int width>
WideObject<width> build_object(const TracerObject& object, TreeBuilder builder) {
    const BoxTree tree = builder == TreeBuilder::bvh ? build_bvh(triangle_refs(object), width)
                                                     : kd_boxes(object, width);
    WideObject<width> out;
    constexpr std::uint32_t none = ~0u;
    std::vector<std::uint32_t> lanes;  // of all blocks
    out.tree = collapse<width>(tree, {.node = 1, .block = 1, .block_size = width},
                               [&](std::span<const std::uint32_t> items) {
                                   const auto first = std::uint32_t(lanes.size() / width);
                                   lanes.insert(lanes.end(), items.begin(), items.end());
                                   lanes.resize((lanes.size() + width - 1) / width * width, none);
                                   return WideLink::leaf(
                                       first, std::uint32_t(lanes.size() / width) - first);
                               });
    CHECK(lanes.size() / width <= WideLink::max_first);
    out.blocks.resize(lanes.size() / width);
    tbb::parallel_for(std::size_t(0), out.blocks.size(), [&](std::size_t block) {
        std::array<Triangle, width> triangles;
        std::size_t count = 0;
        for (; count < width && lanes[block * width + count] != none; ++count)
            triangles[count] = triangle_of(object, lanes[block * width + count]);
        out.blocks[block] = TriangleBlock<width>::of(std::span(triangles).first(count));
    });
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

BoxRef finite(const Box& box, std::uint32_t item) {
    const vec3 most(std::numeric_limits<float>::max());
    return {clamp(box.lo, -most, most), item, clamp(box.hi, -most, most), 0};
}

/// Over boxes that are worth a lane each.
template <int width>
WideTree<width> top_tree(const RawVector<BoxRef>& refs) {
    std::vector<WideNode<width>> lowest;  // their lanes are the items
    const WideCosts costs{.node = 1, .block = 1, .block_size = width, .max_blocks = 1};
    const auto make_leaf = [&](std::span<const std::uint32_t> items) {
        WideNode<width> node;
        for (int i = 0; i < int(items.size()); ++i) {
            const BoxRef& ref = refs[items[i]];
            node.set_child(i, {ref.lo, ref.hi}, WideLink::leaf(ref.item, 1));
        }
        lowest.push_back(node);
        return WideLink::leaf(std::uint32_t(lowest.size()) - 1, 1);
    };
    WideTree<width> tree = collapse<width>(build_bvh(refs, width), costs, make_leaf);
    const auto offset = std::uint32_t(tree.nodes.size());
    for (WideNode<width>& node : tree.nodes)
        for (WideLink& link : node.children)
            if (link.is_leaf()) link = WideLink::node(offset + link.first());
    tree.nodes.insert(tree.nodes.end(), lowest.begin(), lowest.end());
    return tree;
}

template <int width>
void build_top(WideScene<width>& scene, std::span<const TracerInstance> instances) {
    RawVector<BoxRef> refs;
    for (std::uint32_t i = 0; i < instances.size(); ++i) {
        const auto inverse = inverse_affine(instances[i].world_from_object);
        if (!inverse) continue;
        const Box& object_bounds = scene.objects[instances[i].object].tree.bounds;
        const Box box = instance_bounds(object_bounds, instances[i].world_from_object);
        if (box.empty()) continue;
        refs.push_back(finite(box, std::uint32_t(scene.instances.size())));
        scene.instances.push_back({instances[i].object, i, *inverse});
    }
    scene.top = top_tree<width>(refs);
    scene.items.resize(refs.size());
    std::iota(scene.items.begin(), scene.items.end(), 0u);
}

template <class Vector>
std::size_t heap_bytes(const Vector& values) {
    return values.capacity() * sizeof(typename Vector::value_type);
}

template <int width>
class KdTreeTracer final : public Tracer {
public:
    KdTreeTracer(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
                 TreeBuilder builder, Isa isa)
        : kernels_(kernels<width>(isa)) {
        scene_.single = instances.size() == 1 && instances[0].world_from_object == mat4(1);
        if (scene_.single) objects = objects.subspan(instances[0].object, 1);
        scene_.objects.resize(objects.size());
        tbb::parallel_for(std::size_t(0), objects.size(), [&](std::size_t i) {
            scene_.objects[i] = build_object<width>(objects[i], builder);
        });
        if (!scene_.single) build_top(scene_, instances);
    }

    void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const override {
        CHECK_EQ(rays.size(), hits.size());
        kernels_.closest_hits(scene_, rays, hits);
    }

    void occluded(std::span<const Ray> rays, std::span<std::uint8_t> blocked) const override {
        CHECK_EQ(rays.size(), blocked.size());
        kernels_.occluded(scene_, rays, blocked);
    }

    void occluded_from(const vec3& origin, std::span<const vec3> targets,
                       std::span<std::uint8_t> blocked, OccluderCache* cache) const override {
        CHECK_EQ(targets.size(), blocked.size());
        kernels_.occluded_from(scene_, origin, targets, blocked, cache);
    }

    void closest_from(const vec3& origin, std::span<const vec3> dirs,
                      std::span<Hit> hits) const override {
        CHECK_EQ(dirs.size(), hits.size());
        kernels_.closest_from(scene_, origin, dirs, hits);
    }

    Box bounds() const override { return scene_.bounds(); }

    std::size_t memory_bytes() const override {
        std::size_t bytes = heap_bytes(scene_.top.nodes) + heap_bytes(scene_.items) +
                            heap_bytes(scene_.instances) + heap_bytes(scene_.objects);
        for (const WideObject<width>& object : scene_.objects)
            bytes += heap_bytes(object.tree.nodes) + heap_bytes(object.blocks);
        return bytes;
    }

private:
    WideScene<width> scene_;
    const Kernels<width>& kernels_;
};

}  // namespace

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            TreeBuilder builder) {
    const Isa isa = chosen_isa();
    return tbb::task_arena(threads).execute([&]() -> std::unique_ptr<Tracer> {
        switch (width_of(isa)) {
            case 4:
                return std::make_unique<KdTreeTracer<4>>(objects, instances, builder, isa);
            case 8:
                return std::make_unique<KdTreeTracer<8>>(objects, instances, builder, isa);
            default:
                return std::make_unique<KdTreeTracer<16>>(objects, instances, builder, isa);
        }
    });
}

}  // namespace tessera
