#include "worker/igi.h"

#include "worker/light_paths.h"

namespace tessera {
namespace {

/// Candidates among which one direct light sample is chosen.
constexpr std::uint32_t direct_candidates = 4;

/// Shadow rays under way, and what each adds to its pixel when it is free.
struct ShadowBatch {
    std::vector<Ray> rays;
    std::vector<std::uint32_t> pixels;
    std::vector<vec3> irradiance;
    std::vector<std::uint8_t> blocked;

    void add(const Ray& ray, std::uint32_t pixel, const vec3& e) {
        rays.push_back(ray);
        pixels.push_back(pixel);
        irradiance.push_back(e);
    }
    /// Adds what is free to `sum` of its pixel. Returns the number of rays traced.
    std::uint64_t trace(const Tracer& tracer, std::span<PixelSample> samples,
                        vec3 PixelSample::*sum) {
        blocked.resize(rays.size());
        tracer.occluded(rays, blocked);
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (!blocked[i]) samples[pixels[i]].*sum += irradiance[i];
        return rays.size();
    }
};

float fraction(float x) { return x - std::floor(x); }

struct DirectSample {
    LightSample light;
    vec3 irradiance{0};
};

/// Candidate `i`: a shift of the pixel's own point, so that the candidates spread over the lights.
DirectSample direct_candidate(const World& world, const SurfacePoint& s, std::uint32_t i,
                              float u_light, const vec2& u) {
    // Shifts by the plastic number's powers fill the square evenly (Roberts, "The Unreasonable
    // Effectiveness of Quasirandom Sequences", 2018).
    const vec2 place(fraction(u.x + float(i) * 0.75487766f),
                     fraction(u.y + float(i) * 0.56984029f));
    const float stratum = std::min((float(i) + u_light) / direct_candidates, 0x1.fffffep-1f);
    const auto light = world.lights.sample(s.p, stratum, place);
    if (!light) return {};
    const float cosine = dot(s.n, light->wi);
    if (!(cosine > 0 && dot(s.ng, light->wi) > 0)) return {};
    return {*light, light->radiance * (cosine / light->pdf)};
}

/// Adds the shadow ray to one point on a light; `albedo` scales what it brings.
void sample_direct(const World& world, const SurfacePoint& s, std::uint32_t pixel,
                   const vec3& albedo, Sampler& sampler, ShadowBatch& batch) {
    const vec2 u_choice = sampler.next();
    const vec2 u_place = sampler.next();
    DirectSample chosen;
    float chosen_weight = 0;
    float total = 0;
    float u = u_choice.y;
    for (std::uint32_t i = 0; i < direct_candidates; ++i) {
        const DirectSample c = direct_candidate(world, s, i, u_choice.x, u_place);
        const float weight = mean_component(c.irradiance);
        if (!(weight > 0) || !std::isfinite(weight)) continue;
        // Reservoir of one, with the same random number stretched again after each decision.
        total += weight;
        const float p = weight / total;
        if (u < p) {
            u /= p;
            chosen = c;
            chosen_weight = weight;
        } else {
            u = (u - p) / (1 - p);
        }
    }
    if (total <= 0) return;
    batch.add(shadow_ray(s, chosen.light), pixel,
              albedo * chosen.irradiance * (total / (chosen_weight * direct_candidates)));
}

/// Adds the shadow ray to one VPL of all sets, in place of a whole set; `albedo` scales what it
/// brings.
void sample_vpl(const VplSets& sets, const IgiConfig& config, const SurfacePoint& s,
                std::uint32_t pixel, const vec3& albedo, Sampler& sampler, ShadowBatch& batch) {
    if (sets.vpls.empty()) return;
    const auto count = std::uint32_t(sets.vpls.size());
    const auto chosen = std::min(std::uint32_t(sampler.next().x * float(count)), count - 1);
    const std::uint32_t per_set = count / (config.interleave * config.interleave);
    const Vpl& vpl = sets.vpls[chosen];
    const vec3 e = albedo * float(per_set) * irradiance(s, vpl, config.max_geometry);
    if (max_component(e) > 0) batch.add({vpl.org, 0, s.org - vpl.org, 1}, pixel, e);
}

}  // namespace

std::uint64_t gather_direct(const World& world, const TilePass& tile,
                            std::span<const Receiver> receivers, std::span<PixelSample> pixels) {
    ShadowBatch batch;
    for (const Receiver& r : receivers) {
        Sampler sampler = tile.sampler(r.pixel, 1);
        sample_direct(world, r.surface, r.pixel, vec3(1), sampler, batch);
    }
    return batch.trace(world.tracer, pixels, &PixelSample::direct);
}

std::uint64_t gather_indirect(const World& world, const TilePass& tile, const IgiConfig& config,
                              const VplSets& sets, std::span<const Receiver> receivers,
                              std::span<PixelSample> pixels) {
    // Sort the receivers by set: rays from one VPL then follow each other.
    const std::uint32_t set_count = config.interleave * config.interleave;
    std::vector<std::vector<const Receiver*>> of_set(set_count);
    for (const Receiver& r : receivers)
        of_set[set_index(tile.raster(r.pixel), sets.offset, config.interleave)].push_back(&r);

    ShadowBatch batch;
    for (std::uint32_t set = 0; set < set_count; ++set) {
        for (const Vpl& vpl : sets.set(set)) {
            for (const Receiver* r : of_set[set]) {
                const vec3 e = irradiance(r->surface, vpl, config.max_geometry);
                if (max_component(e) > 0)
                    batch.add({vpl.org, 0, r->surface.org - vpl.org, 1}, r->pixel, e);
            }
        }
    }
    return batch.trace(world.tracer, pixels, &PixelSample::indirect);
}

std::uint64_t gather_compensation(const World& world, const TilePass& tile, const IgiConfig& config,
                                  const VplSets& sets, std::span<const Receiver> receivers,
                                  std::span<PixelSample> pixels) {
    if (config.bounces < 1 || config.max_geometry == infinity) return 0;
    // Send rays no farther than the bound can be exceeded.
    std::vector<Ray> rays;
    std::vector<const Receiver*> senders;
    for (const Receiver& r : receivers) {
        const SurfacePoint& s = r.surface;
        Sampler sampler = tile.sampler(r.pixel, 2);
        const vec3 dir = Frame(s.n).world_from_local(sample_cosine_hemisphere(sampler.next()));
        if (!(dot(dir, s.ng) > 0)) continue;
        rays.push_back({s.org, 0, dir, std::sqrt(dot(dir, s.n) / config.max_geometry)});
        senders.push_back(&r);
    }
    std::vector<Hit> hits(rays.size());
    world.tracer.closest_hits(rays, hits);

    // Light what they found from one lamp and one VPL.
    ShadowBatch batch;
    for (std::size_t i = 0; i < rays.size(); ++i) {
        if (!hits[i].valid()) continue;
        const SurfacePoint s = world.surfaces.at(rays[i], hits[i]);
        const float geometry =
            dot(rays[i].dir, senders[i]->surface.n) * dot(s.ng, s.wo) / (hits[i].t * hits[i].t);
        const vec3 share = s.bsdf.reflectance * (1 - config.max_geometry / geometry);
        if (s.bsdf.specular() || !(max_component(share) > 0)) continue;
        const std::uint32_t pixel = senders[i]->pixel;
        Sampler sampler = tile.sampler(pixel, 3);
        sample_direct(world, s, pixel, share, sampler, batch);
        if (config.bounces >= 2) sample_vpl(sets, config, s, pixel, share, sampler, batch);
    }
    return rays.size() + batch.trace(world.tracer, pixels, &PixelSample::indirect);
}

}  // namespace tessera
