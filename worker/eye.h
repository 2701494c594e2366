// Eye rays of a tile: one jittered ray per pixel, followed through mirrors and glass to the first
// surface that scatters, and more on the rims of lamps. What both integrators start from and fill
// in.
#pragma once

#include <vector>

#include "common/tile.h"
#include "worker/camera.h"
#include "worker/lights.h"
#include "worker/sample_table.h"
#include "worker/surface.h"
#include "worker/tracer.h"

namespace tessera {

/// Ideal reflections and refractions in a row; a ray that meets more is dropped.
inline constexpr std::uint32_t max_mirrors = 25;

/// All that is needed to trace light in a scene.
struct World {
    const Surfaces& surfaces;
    const Lights& lights;
    const Tracer& tracer;
    /// Lobes whose light PixelSample::albedo scales: all of them, or those lit by VPLs, and then
    /// the rest goes to `emitted`.
    Lobes filtered = Lobes::broad;
};

/// One pixel in one pass. Its radiance is emitted + albedo / pi * (direct + indirect).
struct PixelSample {
    vec3 emitted{0};   ///< radiance seen directly, in mirrors and in glossy reflection
    vec3 albedo{0};    ///< at the first diffuse hit, times the throughput of mirrors before it
    vec3 direct{0};    ///< irradiance there, straight from lights
    vec3 indirect{0};  ///< irradiance there, from surfaces
    vec3 normal{0};    ///< shading normal there
    float depth = infinity;     ///< path length from the eye to there
    std::uint32_t surface = 0;  ///< hash of instance, object and number of mirrors, never 0
    float path_length = 0;      ///< segments from the eye to there
};

/// The first diffuse hit of a pixel's eye ray.
struct Receiver {
    std::uint32_t pixel = 0;  ///< index within the tile
    SurfacePoint surface;
    vec3 throughput{1};  ///< from radiance that leaves there to the pixel's
};

/// Which pixels, in which pass of which frame.
struct TilePass {
    ImageSize size;
    Rect rect;
    std::uint32_t pass = 0;
    std::uint32_t seed = 0;
    std::uint32_t passes = 1;  ///< of the frame, at most

    ivec2 raster(std::uint32_t pixel) const {
        const auto width = std::uint32_t(rect.width());
        return {rect.x0 + int(pixel % width), rect.y0 + int(pixel / width)};
    }
    /// Of the pixel in the picture, along a Morton curve.
    std::uint32_t number(std::uint32_t pixel) const {
        const ivec2 at = raster(pixel);
        return spread_bits(std::uint32_t(at.x)) | spread_bits(std::uint32_t(at.y)) << 1;
    }
    /// One sequence for the whole picture: any 4^n pixels in a square of the grid get points that
    /// are well distributed among them (Ahmed and Wonka, "Screen-Space Blue-Noise Diffusion of
    /// Monte Carlo Sampling Error via Hierarchical Ordering of Pixels", 2020), and the filter's
    /// mean is all the better for it. So do the rounds of a pixel.
    Sampler sampler(std::uint32_t pixel, std::uint32_t purpose, std::uint32_t round) const {
        return {number(pixel), hash(seed, purpose), round + 1};
    }
    Sampler sampler(std::uint32_t pixel, std::uint32_t purpose) const {
        return sampler(pixel, purpose, pass);
    }
    /// A sequence of the pixel's own, for what must not depend on its neighbours' points.
    Sampler own_sampler(std::uint32_t pixel, std::uint32_t purpose, std::uint32_t index) const {
        return {index, hash(hash(seed, purpose), number(pixel))};
    }
    /// The same as sampler() for many pixels, with their first points, `pairs` each.
    SampleTable samplers(std::span<const std::uint32_t> pixels, std::uint32_t purpose,
                         std::uint32_t pairs, std::uint32_t round) const;
};

/// Whether a path goes on by ideal reflection or refraction; chosen by chance where `bsdf` scatters
/// otherwise, too. What it carries is made up for the choice.
bool meets_delta(const Bsdf& bsdf, Sampler& sampler, vec3& carried);

/// Paths from the eye carry the radiance that comes their way, paths from lights flux: they differ
/// where light is refracted (Veach 1997, 5.2).
enum class Carries : std::uint8_t { radiance, flux };

/// Sends a path on by the ideal lobes of `s`; false when it ends.
bool pass_delta(const SurfacePoint& s, Carries what, Sampler& sampler, vec3& carried, Ray& ray);

/// Traces the tile's eye rays: fills all of `pixels` but `direct` and `indirect`, and lists the
/// receivers, those of neighbouring pixels near each other. Whether a pixel is at the rim of a lamp
/// its neighbours tell, as far as they are in the tile's rect. Returns the number of rays traced.
std::uint64_t trace_eye_rays(const World& world, const Pinhole& camera, const TilePass& tile,
                             std::span<PixelSample> pixels, std::vector<Receiver>& receivers);

}  // namespace tessera
