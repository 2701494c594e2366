#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>

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
                 int threads, const KdTreeTracerConfig& config, Isa isa)
        : kernels_(kernels<width>(isa)) {
        if (instances.size() == 1 && instances[0].world_from_object == mat4(1)) {
            scene_.single = true;
            scene_.objects.push_back(
                build_object<width>(objects[instances[0].object], config.builder));
            return;
        }
        const std::vector<std::uint8_t> baked =
            choose_baked(objects, instances,
                         config.baked_triangles.value_or(bakeable_triangles(objects, instances)));
        scene_.single = !baked.empty() && std::ranges::count(baked, 0) == 0;
        build_objects(objects, instances, baked, threads, config.builder);
        if (!scene_.single) build_top(scene_, instances, baked);
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
                            heap_bytes(scene_.instances) + heap_bytes(scene_.objects) +
                            scene_.names.memory_bytes();
        for (const WideObject<width>& object : scene_.objects) bytes += object.memory_bytes();
        for (const auto& late : scene_.late)
            if (late) bytes += late->memory_bytes();
        return bytes;
    }

private:
    /// Those that unbaked instances use, and behind them what is baked; alone if that is all.
    void build_objects(std::span<const TracerObject> objects,
                       std::span<const TracerInstance> instances,
                       std::span<const std::uint8_t> baked, int threads, TreeBuilder builder) {
        std::vector<std::uint8_t> used(objects.size());
        for (std::size_t i = 0; i < instances.size(); ++i)
            if (!baked[i]) used[instances[i].object] = true;
        BakedMesh mesh = bake(objects, instances, baked);
        scene_.names = std::move(mesh.names);
        const std::size_t shared = scene_.single ? 0 : objects.size();
        scene_.objects.resize(shared + 1);
        tbb::parallel_for(std::size_t(0), shared + 1, [&](std::size_t i) {
            if (i == shared)
                scene_.objects[i] = build_object<width>({mesh.positions, mesh.triangles}, builder);
            else if (used[i] && objects[i].deforms)
                scene_.objects[i].tree.bounds = bounds_of(objects[i]);
            else if (used[i])
                scene_.objects[i] = build_object<width>(objects[i], builder);
        });
        if (scene_.single) scene_.single_id = baked_instance;
        if (std::ranges::any_of(objects, &TracerObject::deforms)) delay(objects, used, threads);
    }

    void delay(std::span<const TracerObject> objects, std::span<const std::uint8_t> used,
               int threads) {
        scene_.late.resize(scene_.objects.size());
        for (std::size_t i = 0; i < objects.size(); ++i)
            if (used[i] && objects[i].deforms)
                scene_.late[i] = std::make_unique<LateObject<width>>(objects[i], threads);
    }

    WideScene<width> scene_;
    const Kernels<width>& kernels_;
};

}  // namespace

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            const KdTreeTracerConfig& config) {
    const Isa isa = chosen_isa();
    return tbb::task_arena(threads).execute([&]() -> std::unique_ptr<Tracer> {
        switch (width_of(isa)) {
            case 4:
                return std::make_unique<KdTreeTracer<4>>(objects, instances, threads, config, isa);
            case 8:
                return std::make_unique<KdTreeTracer<8>>(objects, instances, threads, config, isa);
            default:
                return std::make_unique<KdTreeTracer<16>>(objects, instances, threads, config, isa);
        }
    });
}

}  // namespace tessera
