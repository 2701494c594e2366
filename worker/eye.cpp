#include "worker/eye.h"

#include <bit>

namespace tessera {
namespace {

struct EyePath {
    std::uint32_t pixel = 0;
    std::uint32_t mirrors = 0;
    float length = 0;
    vec3 throughput{1};
    Sampler sampler;
};

/// Difference in emission that makes a rim.
constexpr float visible = 1.0f / 16;

std::uint32_t surface_id(const World& world, const Hit& hit, std::uint32_t mirrors) {
    const std::uint32_t object = world.surfaces.object_of(hit.instance);
    return std::max(hash(hash(hit.instance, object), mirrors), 1u);
}

/// The pixels in the picture's blocks of 4 x 4, whose rays the tracer likes to have together.
std::vector<std::uint32_t> in_blocks(const Rect& rect) {
    constexpr int side = 4;
    std::vector<std::uint32_t> pixels;
    for (int y0 = rect.y0 / side * side; y0 < rect.y1; y0 += side)
        for (int x0 = rect.x0 / side * side; x0 < rect.x1; x0 += side)
            for (int y = std::max(y0, rect.y0); y < std::min(y0 + side, rect.y1); ++y)
                for (int x = std::max(x0, rect.x0); x < std::min(x0 + side, rect.x1); ++x)
                    pixels.push_back(std::uint32_t((y - rect.y0) * rect.width() + x - rect.x0));
    return pixels;
}

/// Closest hits of rays that leave one point.
void trace_from_eye(const Tracer& tracer, std::span<const Ray> rays, std::span<Hit> hits) {
    std::vector<vec3> dirs;
    dirs.reserve(rays.size());
    for (const Ray& ray : rays) dirs.push_back(ray.dir);
    if (!rays.empty()) tracer.closest_from(rays[0].org, dirs, hits);
}

/// Follows eye rays to the first surface that scatters, adds what emits on the way to its pixel and
/// the end to `receivers`, and calls `arrive` with each path, the hit and the receiver. Returns the
/// number of rays traced. `pixel_width`: at unit distance.
template <class Arrive>
std::uint64_t follow(const World& world, float pixel_width, std::vector<EyePath> paths,
                     std::vector<Ray> rays, std::span<PixelSample> pixels,
                     std::vector<Receiver>& receivers, Arrive arrive) {
    TriangleCache cache;
    std::vector<Hit> hits(rays.size());
    trace_from_eye(world.tracer, rays, hits);
    std::uint64_t traced = rays.size();
    while (!paths.empty()) {
        std::size_t kept = 0;
        for (std::size_t i = 0; i < paths.size(); ++i) {
            if (!hits[i].valid()) {
                pixels[paths[i].pixel].emitted +=
                    paths[i].throughput * world.lights.sky().radiance(rays[i].dir);
                continue;
            }
            EyePath path = paths[i];
            Receiver& receiver = receivers.emplace_back();
            SurfacePoint& s = receiver.surface;
            path.length += hits[i].t * length(rays[i].dir);
            world.surfaces.find(rays[i], hits[i], cache, s, path.length * pixel_width);
            pixels[path.pixel].emitted += path.throughput * s.emission;
            if (!meets_delta(s.bsdf, path.sampler, path.throughput)) {
                receiver.pixel = path.pixel;
                receiver.throughput = path.throughput;
                arrive(path, hits[i], receiver);
                continue;
            }
            const bool goes_on =
                pass_delta(s, Carries::radiance, path.sampler, path.throughput, rays[kept]) &&
                ++path.mirrors <= max_mirrors;
            receivers.pop_back();
            if (goes_on) paths[kept++] = path;
        }
        paths.erase(paths.begin() + std::ptrdiff_t(kept), paths.end());
        rays.resize(kept);
        hits.resize(kept);
        world.tracer.closest_hits(rays, hits);
        traced += kept;
    }
    return traced;
}

/// Whether pixels differ enough in what they see of lamps for some to be at a rim.
bool has_rims(std::span<const PixelSample> pixels) {
    vec3 lo(1), hi(0);
    for (const PixelSample& pixel : pixels) {
        const vec3 seen = glm::clamp(pixel.emitted, 0.0f, 1.0f);
        lo = glm::min(lo, seen);
        hi = glm::max(hi, seen);
    }
    return max_component(hi - lo) > visible;
}

/// By how much the radiance differs that the neighbours of a pixel see, some of lamps; 0 where none
/// of it shows. The pixel's own ray has no say: that would favour what it happened to find.
float contrast_around(const TilePass& tile, std::span<const PixelSample> pixels,
                      std::uint32_t pixel) {
    const int width = tile.rect.width();
    const int x = int(pixel) % width, y = int(pixel) / width;
    vec3 lo(infinity), hi(0);
    for (int v = std::max(y - 1, 0); v <= std::min(y + 1, tile.rect.height() - 1); ++v) {
        for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width - 1); ++u) {
            if (u == x && v == y) continue;
            const vec3& seen = pixels[std::size_t(v * width + u)].emitted;
            lo = glm::min(lo, seen);
            hi = glm::max(hi, seen);
        }
    }
    const vec3 shown = glm::min(hi, 1.0f) - glm::min(lo, 1.0f);
    return max_component(shown) > visible ? max_component(hi - lo) : 0;
}

/// More rays through a pixel at such a rim: a power of two that makes what one of all passes
/// decides invisible, within bounds.
std::uint32_t rays_at_rim(float contrast, std::uint32_t passes) {
    constexpr float least = 16, most = 64;
    const float wanted = contrast / (visible * float(passes));
    // Of light that is not finite the contrast may be no number.
    return std::bit_floor(std::uint32_t(wanted > least ? std::min(wanted, most) : least));
}

/// Sends more rays through the rims of lamps, where one ray finds all of a great radiance or
/// nothing; only what emits is taken from them.
std::uint64_t refine_rims(const World& world, const Pinhole& camera, const TilePass& tile,
                          std::span<PixelSample> pixels) {
    if (!has_rims(pixels)) return 0;
    std::vector<float> contrasts;
    for (std::uint32_t pixel = 0; pixel < pixels.size(); ++pixel)
        contrasts.push_back(contrast_around(tile, pixels, pixel));
    std::vector<EyePath> paths;
    std::vector<Ray> rays;
    for (std::uint32_t pixel = 0; pixel < pixels.size(); ++pixel) {
        if (!(contrasts[pixel] > 0)) continue;
        const std::uint32_t count = rays_at_rim(contrasts[pixel], tile.passes);
        const float share = 1 / float(count + 1);
        pixels[pixel].emitted *= share;
        for (std::uint32_t k = 0; k < count; ++k) {
            const Sampler sampler = tile.own_sampler(pixel, 4, tile.pass * count + k);
            paths.push_back({.pixel = pixel, .throughput = vec3(share), .sampler = sampler});
            rays.push_back(camera.ray(vec2(tile.raster(pixel)) + paths.back().sampler.next()));
        }
    }
    std::vector<Receiver> unused;
    return follow(world, camera.pixel_width(), std::move(paths), std::move(rays), pixels, unused,
                  [&](const EyePath&, const Hit&, const Receiver&) { unused.clear(); });
}

}  // namespace

bool meets_delta(const Bsdf& bsdf, Sampler& sampler, vec3& carried) {
    const float chance = bsdf.delta_share;
    if (chance == 0 || chance == 1) return chance == 1;
    const bool meets = sampler.next().x < chance;
    carried /= meets ? chance : 1 - chance;
    return meets;
}

bool pass_delta(const SurfacePoint& s, Carries what, Sampler& sampler, vec3& carried, Ray& ray) {
    const bool choice = s.bsdf.delta != Bsdf::Delta::mirror;
    const float u = choice ? sampler.next().x : 0;
    const vec2 u_facet = s.bsdf.delta_alpha > 0 ? sampler.next() : vec2(0);
    const auto passed = sample_delta(s.bsdf, s.n, s.wo, u, u_facet);
    // A shading normal may send light through the surface that shall reflect it.
    if (!passed || (dot(passed->wi, s.ng) > 0) != (dot(passed->wi, s.n) > 0)) return false;
    carried *= passed->weight;
    if (what == Carries::radiance) carried *= passed->radiance_scale;
    ray = {s.leave(passed->wi), 0, passed->wi, infinity};
    return true;
}

SampleTable TilePass::samplers(std::span<const std::uint32_t> pixels, std::uint32_t purpose,
                               std::uint32_t pairs, std::uint32_t round) const {
    std::vector<std::uint32_t> indices;
    indices.reserve(pixels.size());
    for (const std::uint32_t pixel : pixels) indices.push_back(number(pixel));
    return {std::move(indices), hash(seed, purpose), round + 1, pairs};
}

std::uint64_t trace_eye_rays(const World& world, const Pinhole& camera, const TilePass& tile,
                             std::span<PixelSample> pixels, std::vector<Receiver>& receivers) {
    const std::vector<std::uint32_t> order = in_blocks(tile.rect);
    std::vector<EyePath> paths;
    std::vector<Ray> rays;
    paths.reserve(order.size());
    rays.reserve(order.size());
    for (const std::uint32_t pixel : order) {
        // Neighbours tell rims, and so must know nothing of where the pixel's own ray goes.
        paths.push_back({.pixel = pixel, .sampler = tile.own_sampler(pixel, 0, tile.pass)});
        rays.push_back(camera.ray(vec2(tile.raster(pixel)) + paths.back().sampler.next()));
    }
    receivers.clear();
    receivers.reserve(order.size());
    const std::uint64_t traced =
        follow(world, camera.pixel_width(), std::move(paths), std::move(rays), pixels, receivers,
               [&](const EyePath& path, const Hit& hit, const Receiver& receiver) {
                   const SurfacePoint& s = receiver.surface;
                   PixelSample& pixel = pixels[path.pixel];
                   pixel.albedo = path.throughput * s.bsdf.reflectance(world.filtered);
                   pixel.normal = s.n;
                   pixel.depth = path.length;
                   pixel.surface = surface_id(world, hit, path.mirrors);
                   pixel.path_length = float(path.mirrors + 1);
               });
    return traced + refine_rims(world, camera, tile, pixels);
}

}  // namespace tessera
