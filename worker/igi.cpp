#include "worker/igi.h"

#include "worker/light_paths.h"

namespace tessera {
namespace {

/// Candidates among which one direct light sample is chosen. One lamp needs no choice; more than
/// four cost more than they gain.
std::uint32_t direct_candidates(const World& world) {
    return std::uint32_t(std::clamp<std::size_t>(world.lights.size() / 2, 1, 4));
}

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

/// How far a surface can be and exceed the bound of the geometry term, along a ray that leaves at
/// an angle of this cosine.
float reach(float cosine, float max_geometry) { return std::sqrt(cosine / max_geometry); }

/// Share of the emission in a direction that is left to direct sampling, where a short scattered
/// ray finds the lamp, too. `light_pdf` is that of one candidate.
float direct_weight(const World& world, float light_pdf, float cosine) {
    return power_heuristic(float(direct_candidates(world)) * light_pdf,
                           cosine_hemisphere_pdf(cosine));
}

/// Candidate `i`: a shift of the pixel's own point, so that the candidates spread over the lights.
DirectSample direct_candidate(const World& world, const IgiConfig& config, const SurfacePoint& s,
                              std::uint32_t i, float u_light, const vec2& u) {
    // Shifts by the plastic number's powers fill the square evenly (Roberts, "The Unreasonable
    // Effectiveness of Quasirandom Sequences", 2018).
    const vec2 place(fraction(u.x + float(i) * 0.75487766f),
                     fraction(u.y + float(i) * 0.56984029f));
    const float stratum =
        std::min((float(i) + u_light) / float(direct_candidates(world)), 0x1.fffffep-1f);
    const auto light = world.lights.sample(s.p, stratum, place);
    if (!light) return {};
    const float cosine = dot(s.n, light->wi);
    if (!(cosine > 0 && dot(s.ng, light->wi) > 0)) return {};
    const bool near = !light->punctual && light->distance < reach(cosine, config.max_geometry);
    const float weight = near ? direct_weight(world, light->pdf, cosine) : 1;
    return {*light, light->radiance * (cosine / light->pdf * weight)};
}

/// Adds the shadow ray to one point on a light; `albedo` scales what it brings.
void sample_direct(const World& world, const IgiConfig& config, const SurfacePoint& s,
                   std::uint32_t pixel, const vec3& albedo, Sampler& sampler, ShadowBatch& batch) {
    const vec2 u_choice = sampler.next();
    const vec2 u_place = sampler.next();
    const std::uint32_t candidates = direct_candidates(world);
    DirectSample chosen;
    float chosen_weight = 0;
    float total = 0;
    float u = u_choice.y;
    for (std::uint32_t i = 0; i < candidates; ++i) {
        const DirectSample c = direct_candidate(world, config, s, i, u_choice.x, u_place);
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
              albedo * chosen.irradiance * (total / (chosen_weight * float(candidates))));
}

/// Adds the shadow ray to one VPL of all sets, in place of a whole set; `throughput` scales what it
/// brings, `bounces` counts the reflections there were already.
void sample_vpl(const VplSets& sets, const IgiConfig& config, const SurfacePoint& s,
                std::uint32_t pixel, const vec3& throughput, std::uint32_t bounces,
                Sampler& sampler, ShadowBatch& batch) {
    if (sets.vpls.empty()) return;
    const auto count = std::uint32_t(sets.vpls.size());
    const auto chosen = std::min(std::uint32_t(sampler.next().x * float(count)), count - 1);
    const std::uint32_t per_set = count / (config.interleave * config.interleave);
    const Vpl& vpl = sets.vpls[chosen];
    if (bounces + vpl.bounces > config.bounces) return;
    const vec3 e = throughput * float(per_set) * irradiance(s, vpl, config.max_geometry);
    if (max_component(e) > 0) batch.add({vpl.org, 0, s.org - vpl.org, 1}, pixel, e);
}

/// A path of short rays: picks up what the bound cuts off.
struct ShortPath {
    std::uint32_t pixel = 0;
    std::uint32_t bounces = 0;  ///< reflections between the receiver and `at`
    Sampler sampler;
    SurfacePoint at;
    vec3 throughput{1};  ///< from irradiance at `at` to the receiver's
};

/// Russian roulette by what the path carries, once it has left its first ray's end.
bool survives(ShortPath& path) {
    if (path.bounces < 2) return true;
    const float survival = std::min(max_component(path.throughput), 0.95f);
    if (!(path.sampler.next().x < survival)) return false;
    path.throughput /= survival;
    return true;
}

/// Sends each path's next ray, no farther than the bound can be exceeded; paths whose ray would
/// leave through the surface end.
void aim(float max_geometry, std::vector<ShortPath>& paths, std::vector<Ray>& rays) {
    std::size_t kept = 0;
    rays.clear();
    for (ShortPath& path : paths) {
        const SurfacePoint& s = path.at;
        const vec3 local = sample_cosine_hemisphere(path.sampler.next());
        const vec3 dir = Frame(s.n).world_from_local(local);
        if (!(dot(dir, s.ng) > 0) || !survives(path)) continue;
        rays.push_back({s.org, 0, dir, reach(local.z, max_geometry)});
        paths[kept++] = path;
    }
    paths.erase(paths.begin() + std::ptrdiff_t(kept), paths.end());
}

/// Takes in the emission that `ray` found, against the chance that direct sampling finds it. Beside
/// a lamp its light changes from pixel to pixel: there it stays unfiltered.
void add_emission(const World& world, const IgiConfig& config, const ShortPath& path,
                  const Ray& ray, const Hit& hit, const SurfacePoint& s,
                  std::span<PixelSample> pixels) {
    if (s.emission == vec3(0)) return;
    const float light_pdf = world.lights.pdf(path.at.p, hit, s);
    const float weight = 1 - direct_weight(world, light_pdf, dot(path.at.n, ray.dir));
    const vec3 e = path.throughput * s.emission * (pi * weight);
    PixelSample& pixel = pixels[path.pixel];
    if (path.bounces > 0)
        pixel.indirect += e;
    else if (hit.t > config.filter_angle * pixel.depth)
        pixel.direct += e;
    else
        pixel.emitted += pixel.albedo / pi * e;
}

/// Moves `path` on to `s`; false when it carries nothing any more.
bool advance(ShortPath& path, const IgiConfig& config, const Ray& ray, float t,
             const SurfacePoint& s) {
    const float geometry = dot(ray.dir, path.at.n) * dot(s.ng, s.wo) / (t * t);
    path.throughput *= s.bsdf.reflectance * (1 - config.max_geometry / geometry);
    path.at = s;
    return !s.bsdf.specular() && max_component(path.throughput) > 0 &&
           ++path.bounces <= config.bounces;
}

}  // namespace

std::uint64_t gather_direct(const World& world, const TilePass& tile, const IgiConfig& config,
                            std::span<const Receiver> receivers, std::span<PixelSample> pixels) {
    ShadowBatch batch;
    for (const Receiver& r : receivers) {
        Sampler sampler = tile.sampler(r.pixel, 1);
        sample_direct(world, config, r.surface, r.pixel, vec3(1), sampler, batch);
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
    std::vector<ShortPath> paths;
    for (const Receiver& r : receivers)
        paths.push_back({.pixel = r.pixel, .sampler = tile.sampler(r.pixel, 2), .at = r.surface});
    std::vector<Ray> rays;
    std::vector<Hit> hits;
    ShadowBatch batch;
    std::uint64_t traced = 0;
    while (!paths.empty()) {
        aim(config.max_geometry, paths, rays);
        hits.resize(rays.size());
        world.tracer.closest_hits(rays, hits);
        traced += rays.size();

        // Light what they found: it emits, and reflects light from one lamp and one VPL.
        std::size_t kept = 0;
        for (std::size_t i = 0; i < rays.size(); ++i) {
            if (!hits[i].valid()) continue;
            ShortPath& path = paths[i];
            const SurfacePoint s = world.surfaces.at(rays[i], hits[i]);
            add_emission(world, config, path, rays[i], hits[i], s, pixels);
            if (!advance(path, config, rays[i], hits[i].t, s)) continue;
            sample_direct(world, config, s, path.pixel, path.throughput, path.sampler, batch);
            sample_vpl(sets, config, s, path.pixel, path.throughput, path.bounces, path.sampler,
                       batch);
            paths[kept++] = path;
        }
        paths.erase(paths.begin() + std::ptrdiff_t(kept), paths.end());
    }
    return traced + batch.trace(world.tracer, pixels, &PixelSample::indirect);
}

}  // namespace tessera
