#include "worker/kdtree_tracer.h"

#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>

#include <algorithm>
#include <unordered_map>

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
    /// `before` may be null.
    KdTreeTracer(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
                 int threads, const KdTreeTracerConfig& config, Isa isa, const KdTreeTracer* before)
        : threads_(threads),
          builder_(config.builder),
          kernels_(kernels<width>(isa)),
          objects_(objects.begin(), objects.end()),
          instances_(instances.begin(), instances.end()) {
        if (before && before->builder_ != builder_) before = nullptr;
        if (instances.size() == 1 && instances[0].world_from_object == mat4(1)) {
            scene_.single = true;
            objects_ = {objects[instances[0].object]};
            objects_[0].deforms = false;
            scene_.objects = {built(objects_[0], Earlier(before))};
            return;
        }
        baked_ =
            choose_baked(objects, instances,
                         config.baked_triangles.value_or(bakeable_triangles(objects, instances)));
        scene_.single = !baked_.empty() && std::ranges::count(baked_, 0) == 0;
        build_objects(before);
        if (!scene_.single) build_top(scene_, instances, baked_);
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
                            heap_bytes(objects_) + heap_bytes(instances_) + heap_bytes(baked_);
        if (scene_.names) bytes += scene_.names->memory_bytes();
        for (const auto& object : scene_.objects) bytes += object->memory_bytes();
        for (const auto& late : scene_.late)
            if (late) bytes += late->memory_bytes();
        return bytes;
    }

private:
    using Object = std::shared_ptr<const WideObject<width>>;

    /// Trees that can be taken over, by the geometry that they were built from.
    class Earlier {
    public:
        /// `tracer` may be null.
        explicit Earlier(const KdTreeTracer* tracer) : tracer_(tracer) {
            if (!tracer_) return;
            for (std::size_t i = 0; i < tracer_->shared_objects(); ++i)
                if (tracer_->is_built(i) || tracer_->late(i))
                    index_[tracer_->objects_[i].positions.data()] = i;
        }

        /// Where the tracer has it.
        std::optional<std::size_t> find(const TracerObject& object) const {
            const auto found = index_.find(object.positions.data());
            if (found == index_.end() || !same(tracer_->objects_[found->second], object)) return {};
            return found->second;
        }
        const KdTreeTracer* operator->() const { return tracer_; }

    private:
        const KdTreeTracer* tracer_;
        std::unordered_map<const vec3*, std::size_t> index_;
    };

    static bool same(const TracerObject& a, const TracerObject& b) {
        return a.positions.data() == b.positions.data() &&
               a.positions.size() == b.positions.size() &&
               a.triangles.data() == b.triangles.data() &&
               a.triangles.size() == b.triangles.size() && a.deforms == b.deforms;
    }

    /// How many of `objects_` the scene knows one by one: all, unless everything is baked.
    std::size_t shared_objects() const {
        return scene_.single && !baked_.empty() ? 0 : objects_.size();
    }
    bool is_built(std::size_t i) const { return !scene_.objects[i]->blocks.empty(); }

    std::shared_ptr<LateObject<width>> late(std::size_t i) const {
        return scene_.late.empty() ? nullptr : scene_.late[i];
    }

    Object built(const TracerObject& object, const Earlier& earlier) const {
        if (const auto i = earlier.find(object)) return earlier->scene_.objects[*i];
        return built(object);
    }
    Object built(const TracerObject& object) const {
        return std::make_shared<const WideObject<width>>(build_object<width>(object, builder_));
    }

    /// Those that unbaked instances use, and behind them what is baked; alone if that is all.
    void build_objects(const KdTreeTracer* before) {
        std::vector<std::uint8_t> used(objects_.size());
        for (std::size_t i = 0; i < instances_.size(); ++i)
            if (!baked_[i]) used[instances_[i].object] = true;
        const std::size_t shared = scene_.single ? 0 : objects_.size();
        const auto nothing = std::make_shared<const WideObject<width>>();
        scene_.objects.assign(shared + 1, nothing);
        if (std::ranges::any_of(objects_, &TracerObject::deforms)) scene_.late.resize(shared + 1);
        const Earlier earlier(before);
        tbb::parallel_for(std::size_t(0), shared + 1, [&](std::size_t i) {
            if (i == shared)
                bake_all(before);
            else if (used[i] && objects_[i].deforms)
                delay(i, earlier);
            else if (used[i])
                scene_.objects[i] = built(objects_[i], earlier);
        });
        if (scene_.single) scene_.single_id = baked_instance;
    }

    void bake_all(const KdTreeTracer* before) {
        if (before && bakes_the_same(*before)) {
            scene_.objects.back() = before->scene_.objects.back();
            scene_.names = before->scene_.names;
            return;
        }
        BakedMesh mesh = bake(objects_, instances_, baked_);
        scene_.objects.back() = built({mesh.positions, mesh.triangles});
        scene_.names = std::make_shared<const TriangleNames>(std::move(mesh.names));
    }

    bool bakes_the_same(const KdTreeTracer& other) const {
        if (other.baked_.empty()) return false;
        const std::size_t most = std::max(baked_.size(), other.baked_.size());
        for (std::size_t i = 0; i < most; ++i) {
            const bool here = i < baked_.size() && baked_[i];
            if (here != (i < other.baked_.size() && other.baked_[i])) return false;
            if (!here) continue;
            const TracerInstance &a = instances_[i], &b = other.instances_[i];
            if (a.world_from_object != b.world_from_object ||
                !same(objects_[a.object], other.objects_[b.object]))
                return false;
        }
        return true;
    }

    void delay(std::size_t i, const Earlier& earlier) {
        if (const auto place = earlier.find(objects_[i])) {
            scene_.objects[i] = earlier->scene_.objects[*place];
            scene_.late[i] = earlier->late(*place);
            return;
        }
        WideObject<width> unknown;
        unknown.tree.bounds = bounds_of(objects_[i]);
        scene_.objects[i] = std::make_shared<const WideObject<width>>(std::move(unknown));
        scene_.late[i] = std::make_shared<LateObject<width>>(objects_[i], threads_);
    }

    WideScene<width> scene_;
    int threads_;
    TreeBuilder builder_;
    const Kernels<width>& kernels_;
    // What it was built from, to be compared with what comes next.
    std::vector<TracerObject> objects_;
    std::vector<TracerInstance> instances_;
    std::vector<std::uint8_t> baked_;  ///< by instance; empty: `single` without baking
};

}  // namespace

std::unique_ptr<Tracer> build_kdtree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            const KdTreeTracerConfig& config,
                                            const Tracer* before) {
    const Isa isa = chosen_isa();
    const auto build = [&]<int width>(std::integral_constant<int, width>) {
        return std::make_unique<KdTreeTracer<width>>(
            objects, instances, threads, config, isa,
            dynamic_cast<const KdTreeTracer<width>*>(before));
    };
    return tbb::task_arena(threads).execute([&]() -> std::unique_ptr<Tracer> {
        switch (width_of(isa)) {
            case 4:
                return build(std::integral_constant<int, 4>());
            case 8:
                return build(std::integral_constant<int, 8>());
            default:
                return build(std::integral_constant<int, 16>());
        }
    });
}

}  // namespace tessera
