#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include "common/check.h"
#include "worker/affine.h"
#include "worker/clip.h"
#include "worker/kernels.h"

namespace tessera {
namespace {

// Rays are as fast in trees from 0.5 to 4; the leanest is smallest and soonest built.
constexpr KdCosts object_costs{.traversal = 1, .intersection = 0.25f};
// A ray that meets an instance is transformed and walks a tree.
constexpr KdCosts top_costs{.traversal = 1, .intersection = 20};

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

template <int width>
WideObject<width> build_object(const TracerObject& object) {
    const std::vector<Triangle> triangles = sound_triangles(object);
    const ClippedBounds clipped = [&](std::uint32_t i, const Box& cell) {
        return clipped_bounds(triangles[i], cell);
    };
    const KdTree tree = build_kdtree(std::uint32_t(triangles.size()), clipped, object_costs);
    WideObject<width> out;
    std::vector<Triangle> list;
    const std::uint32_t limit = WideLink::max_count * width;
    out.tree =
        collapse<width>(tree, clipped, width, limit, [&](std::span<const std::uint32_t> items) {
            const auto leaf = WideLink::leaf(std::uint32_t(out.blocks.size()),
                                             std::uint32_t(items.size() + width - 1) / width);
            list.clear();
            for (const std::uint32_t item : items) list.push_back(triangles[item]);
            for (std::size_t i = 0; i < list.size(); i += width)
                out.blocks.push_back(TriangleBlock<width>::of(std::span(list).subspan(i).first(
                    std::min<std::size_t>(width, list.size() - i))));
            return leaf;
        });
    CHECK(out.blocks.size() <= WideLink::max_first);
    out.blocks.shrink_to_fit();
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

template <int width>
void build_top(WideScene<width>& scene, std::span<const TracerInstance> instances) {
    std::vector<Box> boxes;
    for (std::uint32_t i = 0; i < instances.size(); ++i) {
        const auto inverse = inverse_affine(instances[i].world_from_object);
        if (!inverse) continue;
        const Box& object_bounds = scene.objects[instances[i].object].tree.bounds;
        boxes.push_back(instance_bounds(object_bounds, instances[i].world_from_object));
        scene.instances.push_back({instances[i].object, i, *inverse});
    }
    const ClippedBounds clipped = [&](std::uint32_t i, const Box& cell) {
        return Box{max(boxes[i].lo, cell.lo), min(boxes[i].hi, cell.hi)};
    };
    const KdTree tree = build_kdtree(std::uint32_t(boxes.size()), clipped, top_costs);
    const std::uint32_t limit = WideLink::max_count;
    scene.top = collapse<width>(tree, clipped, 1, limit, [&](std::span<const std::uint32_t> items) {
        const auto leaf =
            WideLink::leaf(std::uint32_t(scene.items.size()), std::uint32_t(items.size()));
        scene.items.insert(scene.items.end(), items.begin(), items.end());
        return leaf;
    });
}

template <class T>
std::size_t heap_bytes(const std::vector<T>& values) {
    return values.capacity() * sizeof(T);
}

template <int width>
class KdTreeTracer final : public Tracer {
public:
    KdTreeTracer(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
                 Isa isa)
        : kernels_(kernels<width>(isa)) {
        scene_.single = instances.size() == 1 && instances[0].world_from_object == mat4(1);
        if (scene_.single) objects = objects.subspan(instances[0].object, 1);
        scene_.objects.resize(objects.size());
        tbb::parallel_for(std::size_t(0), objects.size(), [&](std::size_t i) {
            scene_.objects[i] = build_object<width>(objects[i]);
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

    RayMask occluded_from(const vec3& origin, const Targets& targets, const RayMask& wanted,
                          OccluderCache* cache) const override {
        return kernels_.occluded_from(scene_, origin, targets, wanted, cache);
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
                                            std::span<const TracerInstance> instances,
                                            int threads) {
    const Isa isa = chosen_isa();
    return tbb::task_arena(threads).execute([&]() -> std::unique_ptr<Tracer> {
        switch (width_of(isa)) {
            case 4:
                return std::make_unique<KdTreeTracer<4>>(objects, instances, isa);
            case 8:
                return std::make_unique<KdTreeTracer<8>>(objects, instances, isa);
            default:
                return std::make_unique<KdTreeTracer<16>>(objects, instances, isa);
        }
    });
}

}  // namespace tessera
