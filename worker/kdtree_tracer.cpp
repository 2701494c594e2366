#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include "common/check.h"
#include "worker/kernels.h"

namespace tessera {
namespace {

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
