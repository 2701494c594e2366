#include "worker/path.h"

namespace tessera {
namespace {

/// A path that starts at a receiver, which is vertex 0.
struct Path {
    std::uint32_t pixel = 0;
    std::uint32_t bounces = 0;  ///< reflections between receiver and current vertex, but for ideal
    std::uint32_t mirrors = 0;  ///< ideal reflections and refractions in a row
    Sampler sampler;
    SurfacePoint at;
    vec3 throughput{pi};  ///< from radiance to the receiver's irradiance
    float pdf = 0;        ///< of the ray that is on its way, per solid angle; 0 after a mirror
    vec3 from{0};         ///< where that ray left its last vertex that was not ideal
};

/// Light that reaches the receiver if the shadow ray of the same index is free.
struct Pending {
    std::uint32_t pixel = 0;
    bool direct = false;
    vec3 irradiance{0};
};

struct Batch {
    std::vector<Ray> shadow_rays;
    std::vector<Pending> pending;
    std::vector<std::uint8_t> blocked;
};

void deposit(PixelSample& pixel, bool direct, const vec3& irradiance) {
    (direct ? pixel.direct : pixel.indirect) += irradiance;
}

/// BRDF of the vertex times pi; at the receiver relative to its albedo, which is applied later.
vec3 scattering(const Path& path, const vec3& wi) {
    const SurfacePoint& s = path.at;
    if (path.bounces == 0) return shape(s.bsdf, s.n, s.wo, wi, Lobes::all);
    return s.bsdf.is_lambert() ? s.bsdf.diffuse : pi * eval(s.bsdf, s.n, s.wo, wi);
}

void sample_light(const World& world, Path& path, Batch& batch) {
    const float u_light = path.sampler.next().x;
    const auto light = world.lights.sample(path.at.p, u_light, path.sampler.next());
    const float cosine = light ? dot(path.at.n, light->wi) : 0;
    if (!(cosine > 0 && dot(path.at.ng, light->wi) > 0)) return;
    const float scattered_pdf = pdf(path.at.bsdf, path.at.n, path.at.wo, light->wi);
    const float weight = light->punctual ? 1 : power_heuristic(light->pdf, scattered_pdf);
    const vec3 irradiance = path.throughput * scattering(path, light->wi) * light->radiance *
                            (cosine / pi * weight / light->pdf);
    if (!(max_component(irradiance) > 0)) return;
    batch.shadow_rays.push_back(shadow_ray(path.at, *light));
    batch.pending.push_back({path.pixel, path.bounces == 0, irradiance});
}

/// Adds what photons bring to the vertex.
void add_photons(const PhotonMap& photons, const Path& path, std::span<PixelSample> pixels) {
    const SurfacePoint& s = path.at;
    vec3 sum(0);
    photons.find(s, [&](const Photon& photon, float density) {
        if (dot(s.n, photon.wi) > 0)
            sum += scattering(path, photon.wi) * photon.flux *
                   (density * photon_correction(s, photon.wi));
    });
    deposit(pixels[path.pixel], path.bounces == 0, path.throughput * sum / pi);
}

void trace_shadow_rays(const World& world, Batch& batch, std::span<PixelSample> pixels) {
    batch.blocked.resize(batch.shadow_rays.size());
    world.tracer.occluded(batch.shadow_rays, batch.blocked);
    for (std::size_t i = 0; i < batch.pending.size(); ++i) {
        const Pending& p = batch.pending[i];
        if (!batch.blocked[i]) deposit(pixels[p.pixel], p.direct, p.irradiance);
    }
    batch.shadow_rays.clear();
    batch.pending.clear();
}

/// Sends the path on by all but the ideal lobes; false when it ends.
bool reflect(Path& path, std::uint32_t bounces, Ray& ray) {
    const SurfacePoint& at = path.at;
    const vec2 u = path.sampler.next();
    const bool lambert = at.bsdf.is_lambert();
    const auto s = sample(at.bsdf, at.n, at.wo, lambert ? 0 : path.sampler.next().x, u);
    if (!s || !(dot(s->wi, at.ng) > 0)) return false;
    path.throughput *= scattering(path, s->wi);
    if (!lambert) path.throughput *= dot(at.n, s->wi) / (pi * s->pdf);
    path.pdf = s->pdf;
    path.from = at.p;
    path.mirrors = 0;
    // The ray may still find a light when no further reflection is allowed.
    if (path.bounces > bounces) return false;
    ++path.bounces;
    ray = {at.org, 0, s->wi, infinity};
    return true;
}

/// Chooses where the path goes on and writes its ray; false when it ends.
bool scatter(Path& path, std::uint32_t bounces, Ray& ray) {
    // Eye rays have made that choice at the receiver.
    if (path.bounces > 0 && meets_delta(path.at.bsdf, path.sampler, path.throughput)) {
        path.pdf = 0;
        if (++path.mirrors > max_mirrors ||
            !pass_delta(path.at, Carries::radiance, path.sampler, path.throughput, ray))
            return false;
    } else if (!reflect(path, bounces, ray)) {
        return false;
    }
    // Russian roulette by throughput, never for the receiver's own ray.
    const float survival = std::min(max_component(path.throughput) / pi, 0.95f);
    if (path.bounces > 1) {
        if (!(path.sampler.next().x < survival)) return false;
        path.throughput /= survival;
    }
    return true;
}

/// Adds what the new vertex emits, against the chance that next event estimation found it.
void add_emission(const World& world, const Path& path, const Hit& hit, const SurfacePoint& s,
                  std::span<PixelSample> pixels) {
    if (s.emission == vec3(0)) return;
    const float weight =
        path.pdf > 0 ? power_heuristic(path.pdf, world.lights.pdf(path.from, hit, s)) : 1;
    deposit(pixels[path.pixel], path.pdf > 0 && path.bounces == 1,
            path.throughput * s.emission * weight);
}

/// The same for the sky, which the path leaves for.
void add_sky(const World& world, const Path& path, const vec3& dir, std::span<PixelSample> pixels) {
    const vec3 radiance = world.lights.sky().radiance(dir);
    if (radiance == vec3(0)) return;
    const float weight = path.pdf > 0 ? power_heuristic(path.pdf, world.lights.sky_pdf(dir)) : 1;
    deposit(pixels[path.pixel], path.pdf > 0 && path.bounces == 1,
            path.throughput * radiance * weight);
}

}  // namespace

std::uint64_t trace_paths(const World& world, const TilePass& tile, std::uint32_t bounces,
                          const PhotonMap* photons, std::span<const Receiver> receivers,
                          std::span<PixelSample> pixels) {
    std::vector<Path> paths;
    paths.reserve(receivers.size());
    for (const Receiver& r : receivers)
        paths.push_back({.pixel = r.pixel, .sampler = tile.sampler(r.pixel, 1), .at = r.surface});
    std::vector<Ray> rays(paths.size());
    std::vector<Hit> hits(paths.size());
    Batch batch;
    std::uint64_t traced = 0;
    while (!paths.empty()) {
        // Light every diffuse vertex.
        for (Path& path : paths) {
            if (path.at.bsdf.is_delta() || path.bounces > bounces) continue;
            sample_light(world, path, batch);
            if (photons) add_photons(*photons, path, pixels);
        }
        traced += batch.shadow_rays.size();
        trace_shadow_rays(world, batch, pixels);

        // Send every path on its way; those that end leave the list.
        std::size_t kept = 0;
        for (Path& path : paths)
            if (scatter(path, bounces, rays[kept])) paths[kept++] = path;
        world.tracer.closest_hits(std::span(rays).first(kept), std::span(hits).first(kept));
        traced += kept;

        // Take in what they found.
        std::size_t alive = 0;
        for (std::size_t i = 0; i < kept; ++i) {
            if (!hits[i].valid()) {
                add_sky(world, paths[i], rays[i].dir, pixels);
                continue;
            }
            paths[i].at = world.surfaces.at(rays[i], hits[i]);
            add_emission(world, paths[i], hits[i], paths[i].at, pixels);
            paths[alive++] = paths[i];
        }
        paths.erase(paths.begin() + std::ptrdiff_t(alive), paths.end());
    }
    return traced;
}

}  // namespace tessera
