#include "worker/cutout_tracer.h"

#include <bit>

#include "worker/sampling.h"

namespace tessera {
namespace {

/// A number in [0, 1) that belongs to a ray's meeting with a triangle.
float chance_of(const Ray& ray, const Hit& hit) {
    std::uint32_t h = hash(hit.instance, hit.triangle);
    for (const float x : {ray.org.x, ray.org.y, ray.org.z, ray.dir.x, ray.dir.y, ray.dir.z})
        h = hash(h, std::bit_cast<std::uint32_t>(x));
    return unit_float(h);
}

class CutoutTracer : public Tracer {
public:
    CutoutTracer(std::shared_ptr<const Tracer> tracer, const Surfaces& surfaces)
        : tracer_(std::move(tracer)), surfaces_(surfaces) {}

    void closest_hits(std::span<const Ray> rays, std::span<Hit> hits) const override {
        tracer_->closest_hits(rays, hits);
        pass_holes(rays, hits);
    }

    void occluded(std::span<const Ray> rays, std::span<std::uint8_t> blocked) const override {
        tracer_->occluded(rays, blocked);
        std::vector<Ray> doubtful;
        std::vector<std::size_t> index;
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (blocked[i]) {
                doubtful.push_back(rays[i]);
                index.push_back(i);
            }
        std::vector<Hit> hits(doubtful.size());
        closest_hits(doubtful, hits);
        for (std::size_t i = 0; i < index.size(); ++i) blocked[index[i]] = hits[i].valid();
    }

    RayMask occluded_from(const vec3& origin, const Targets& targets, const RayMask& wanted,
                          OccluderCache* cache) const override {
        const RayMask doubtful = tracer_->occluded_from(origin, targets, wanted, cache);
        return Tracer::occluded_from(origin, targets, doubtful, nullptr);
    }

    void closest_from(const vec3& origin, std::span<const vec3> dirs,
                      std::span<Hit> hits) const override {
        tracer_->closest_from(origin, dirs, hits);
        std::vector<Ray> rays;
        rays.reserve(dirs.size());
        for (const vec3& dir : dirs) rays.push_back({origin, 0, dir, infinity});
        pass_holes(rays, hits);
    }

    Box bounds() const override { return tracer_->bounds(); }
    std::size_t memory_bytes() const override { return tracer_->memory_bytes(); }

private:
    /// Surfaces in a row that a ray may pass; then it is blocked.
    static constexpr int most_holes = 256;

    bool is_hole(const Ray& ray, const Hit& hit) const {
        if (!hit.valid()) return false;
        const float there = surfaces_.coverage(hit.instance, hit.triangle, {hit.u, hit.v});
        return !(there >= 1) && !(chance_of(ray, hit) < there);
    }

    /// Traces again, from there, the rays that hit holes, until none does.
    void pass_holes(std::span<const Ray> rays, std::span<Hit> hits) const {
        std::vector<Ray> open;
        std::vector<std::size_t> index;
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (is_hole(rays[i], hits[i])) {
                open.push_back(rays[i]);
                index.push_back(i);
            }
        std::vector<Hit> found;
        for (int pass = 0; pass < most_holes && !open.empty(); ++pass) {
            for (std::size_t k = 0; k < open.size(); ++k) open[k].tmin = hits[index[k]].t;
            found.resize(open.size());
            tracer_->closest_hits(open, found);
            std::size_t kept = 0;
            for (std::size_t k = 0; k < open.size(); ++k) {
                hits[index[k]] = found[k];
                if (!is_hole(open[k], found[k])) continue;
                open[kept] = open[k];
                index[kept++] = index[k];
            }
            open.resize(kept);
            index.resize(kept);
        }
    }

    std::shared_ptr<const Tracer> tracer_;
    const Surfaces& surfaces_;
};

}  // namespace

std::shared_ptr<const Tracer> with_cutouts(std::shared_ptr<const Tracer> tracer,
                                           const Surfaces& surfaces) {
    return std::make_shared<CutoutTracer>(std::move(tracer), surfaces);
}

}  // namespace tessera
