#include "worker/eye.h"

namespace tessera {
namespace {

struct EyePath {
    std::uint32_t pixel = 0;
    std::uint32_t mirrors = 0;
    float length = 0;
    vec3 throughput{1};
};

std::uint32_t surface_id(const World& world, const Hit& hit, std::uint32_t mirrors) {
    const std::uint32_t object = world.surfaces.object_of(hit.instance);
    return std::max(hash(hash(hit.instance, object), mirrors), 1u);
}

}  // namespace

Sampler TilePass::sampler(std::uint32_t pixel, std::uint32_t purpose) const {
    const ivec2 at = raster(pixel);
    const std::uint32_t number = std::uint32_t(at.y) * std::uint32_t(size.width) + at.x;
    return {pass, hash(hash(seed, purpose), number)};
}

std::uint64_t trace_eye_rays(const World& world, const Pinhole& camera, const TilePass& tile,
                             std::span<PixelSample> pixels, std::vector<Receiver>& receivers) {
    std::vector<EyePath> paths(pixels.size());
    std::vector<Ray> rays(pixels.size());
    std::vector<Hit> hits(pixels.size());
    for (std::uint32_t i = 0; i < pixels.size(); ++i) {
        paths[i].pixel = i;
        rays[i] = camera.ray(vec2(tile.raster(i)) + tile.sampler(i, 0).next());
    }

    std::uint64_t traced = 0;
    receivers.clear();
    while (!paths.empty()) {
        world.tracer.closest_hits(rays, hits);
        traced += rays.size();
        std::size_t kept = 0;
        for (std::size_t i = 0; i < paths.size(); ++i) {
            if (!hits[i].valid()) continue;
            const SurfacePoint s = world.surfaces.at(rays[i], hits[i]);
            EyePath path = paths[i];
            path.length += hits[i].t * length(rays[i].dir);
            PixelSample& pixel = pixels[path.pixel];
            pixel.emitted += path.throughput * s.emission;
            path.throughput *= s.bsdf.reflectance;
            if (!s.bsdf.specular()) {
                pixel.albedo = path.throughput;
                pixel.normal = s.n;
                pixel.depth = path.length;
                pixel.surface = surface_id(world, hits[i], path.mirrors);
                receivers.push_back({path.pixel, s});
                continue;
            }
            const auto reflected = sample(s.bsdf, s.n, s.wo, vec2(0));
            if (!reflected || dot(reflected->wi, s.ng) <= 0 || ++path.mirrors > max_mirrors)
                continue;
            paths[kept] = path;
            rays[kept++] = {s.org, 0, reflected->wi, infinity};
        }
        paths.resize(kept);
        rays.resize(kept);
        hits.resize(kept);
    }
    // Mirrors delay some pixels: put them back in order.
    std::sort(receivers.begin(), receivers.end(),
              [](const Receiver& a, const Receiver& b) { return a.pixel < b.pixel; });
    return traced;
}

}  // namespace tessera
