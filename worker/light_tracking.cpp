#include "worker/light_tracking.h"

namespace tessera {
namespace {

/// Paths, on a grid over the picture. Fewer find too few of the lights that matter, more take
/// longer than they save.
constexpr int most_paths = 4096;
/// Pixels for each path at least.
constexpr int pixels_per_path = 4;
/// Lights asked from where a path begins, and from where it goes.
constexpr std::uint32_t asked_first = 4, asked_later = 2;
/// Reflections after which paths end: what comes later is spread too evenly to tell lights apart.
constexpr std::uint32_t most_bounces = 3;

struct ScoutPath {
    SurfacePoint at;
    vec3 throughput{1};
    Sampler sampler;
    std::uint32_t bounces = 0;
    std::uint32_t mirrors = 0;
};

/// Light on its way to a path, and through it to the picture, if the ray is free.
struct Asked {
    std::uint32_t light = 0;
    bool direct = false;
    float radiance = 0;
};

std::vector<ScoutPath> begin_paths(const World& world, const Camera& camera, ImageSize size,
                                   std::uint32_t seed, std::uint64_t& rays) {
    const float paths = float(most_paths);
    const float shrink =
        std::min(std::sqrt(1 / float(pixels_per_path)), std::sqrt(paths / float(size.pixels())));
    const auto coarse = [&](int pixels) {
        return std::max(int(std::ceil(float(pixels) * shrink)), 1);
    };
    const ImageSize grid{coarse(size.width), coarse(size.height)};
    const TilePass tile{grid, {0, 0, grid.width, grid.height}, 0, seed};
    std::vector<PixelSample> pixels(grid.pixels());
    std::vector<Receiver> receivers;
    rays += trace_eye_rays(world, Pinhole(camera, grid), tile, pixels, receivers);
    std::vector<ScoutPath> paths_begun;
    const float share = float(size.pixels()) / float(grid.pixels());
    for (const Receiver& r : receivers)
        paths_begun.push_back({.at = r.surface,
                               .throughput = share * r.throughput,
                               .sampler = tile.sampler(r.pixel, 1)});
    return paths_begun;
}

/// Asks one light: number `i` of `count`.
void ask(const World& world, ScoutPath& path, std::uint32_t i, std::uint32_t count,
         std::vector<Ray>& rays, std::vector<Asked>& asked) {
    const SurfacePoint& s = path.at;
    const float u_light = (float(i) + path.sampler.next().x) / float(count);
    const auto light =
        world.lights.sample(s.p, std::min(u_light, 0x1.fffffep-1f), path.sampler.next());
    if (!light || s.bsdf.is_delta()) return;
    const float cosine = dot(s.n, light->wi);
    if (!(cosine > 0 && dot(s.ng, light->wi) > 0)) return;
    const float radiance =
        mean_component(path.throughput * eval(s.bsdf, s.n, s.wo, light->wi) * light->radiance) *
        (cosine / (light->pdf * float(count)));
    if (!(radiance > 0) || !std::isfinite(radiance)) return;
    rays.push_back(shadow_ray(s, *light));
    asked.push_back({light->index, path.bounces == 0, radiance});
}

/// Sends the path on; false when it ends.
bool scatter(ScoutPath& path, Ray& ray) {
    const SurfacePoint& s = path.at;
    if (path.bounces > 0 && meets_delta(s.bsdf, path.sampler, path.throughput))
        return ++path.mirrors <= max_mirrors &&
               pass_delta(s, Carries::radiance, path.sampler, path.throughput, ray);
    if (++path.bounces > most_bounces) return false;
    const float u_lobe = path.sampler.next().x;
    const auto scattered = sample(s.bsdf, s.n, s.wo, u_lobe, path.sampler.next());
    if (!scattered || !(dot(scattered->wi, s.ng) > 0)) return false;
    const float survival = std::min(max_component(scattered->weight), 1.0f);
    if (!(path.sampler.next().x < survival)) return false;
    path.throughput *= scattered->weight / survival;
    path.mirrors = 0;
    ray = {s.org, 0, scattered->wi, infinity};
    return true;
}

}  // namespace

LightEstimates scout_lights(const World& world, const Camera& camera, ImageSize size,
                            std::uint32_t seed, std::uint64_t& rays_traced) {
    LightEstimates estimates(world.lights.size());
    std::vector<ScoutPath> paths = begin_paths(world, camera, size, seed, rays_traced);
    std::vector<Ray> rays;
    std::vector<Hit> hits;
    std::vector<Asked> asked;
    std::vector<std::uint8_t> blocked;
    while (!paths.empty()) {
        // Ask lights from where each path is.
        rays.clear();
        asked.clear();
        for (ScoutPath& path : paths) {
            const std::uint32_t count = path.bounces == 0 ? asked_first : asked_later;
            for (std::uint32_t i = 0; i < count; ++i) ask(world, path, i, count, rays, asked);
        }
        blocked.resize(rays.size());
        world.tracer.occluded(rays, blocked);
        rays_traced += rays.size();
        for (std::size_t i = 0; i < rays.size(); ++i)
            if (!blocked[i])
                (asked[i].direct ? estimates.direct : estimates.indirect)[asked[i].light] +=
                    asked[i].radiance;

        // Go on.
        std::size_t kept = 0;
        rays.resize(paths.size());
        for (ScoutPath& path : paths)
            if (scatter(path, rays[kept])) paths[kept++] = path;
        rays.resize(kept);
        hits.resize(kept);
        world.tracer.closest_hits(rays, hits);
        rays_traced += kept;
        std::size_t alive = 0;
        for (std::size_t i = 0; i < kept; ++i) {
            if (!hits[i].valid()) continue;
            paths[i].at = world.surfaces.at(rays[i], hits[i]);
            paths[alive++] = paths[i];
        }
        paths.erase(paths.begin() + std::ptrdiff_t(alive), paths.end());
    }
    return estimates;
}

void recall(std::span<const LightEstimate> found, LightEstimates& estimates) {
    double before = 0, now = 0;
    for (const LightEstimate& e : found) before += double(e.radiance);
    for (const std::vector<float>* part : {&estimates.direct, &estimates.indirect})
        for (const float radiance : *part) now += double(radiance);
    if (!(before > 0)) return;
    const auto scale = float(now > 0 ? now / before : 1);
    for (const LightEstimate& e : found)
        if (e.light < estimates.indirect.size()) estimates.indirect[e.light] += scale * e.radiance;
}

}  // namespace tessera
