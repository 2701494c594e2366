// Quasi-random walks from the lights: where they land, virtual point lights stand (Keller, "Instant
// Radiosity", 1997). A VPL is the light that leaves a surface after a diffuse reflection there, so
// it carries indirect light only; light straight from lamps is sampled apart. Russian roulette by
// reflectance keeps the power of a path's VPLs nearly equal. Only what broad lobes reflect becomes
// a VPL; the walk itself goes on by all lobes, through mirrors and glass.
//
// Out of many candidate VPLs those that matter for the picture are kept: each candidate's
// contribution to a few points that the eye sees (the view's pilots) decides how likely it is taken
// (after Georgiev and Slusallek, "Simple and Robust Iterative Importance Sampling of Virtual Point
// Lights", 2010). We differ in resampling systematically along a Morton curve, so that every
// interleaved set spreads over the scene, and in giving a share of the choice to power alone.
#pragma once

#include "worker/eye.h"
#include "worker/vpl.h"

namespace tessera {

/// Which light paths.
struct LightPaths {
    std::uint32_t round = 0;  ///< rounds go on where those before ended
    std::uint32_t count = 0;
    std::uint32_t bounces = 64;  ///< at most
    std::uint32_t seed = 0;
};

/// The VPLs' intensities are those of a single path: divide by their number. Adds the rays traced
/// to `rays`.
std::vector<Vpl> walk_light_paths(const World& world, const LightPaths& paths, std::uint64_t& rays);

/// Irradiance at a receiver from a VPL, occlusion aside, as the receiver's broad lobes weigh it;
/// `max_geometry` bounds cos * cos / d^2.
vec3 irradiance(const SurfacePoint& s, const Vpl& vpl, float max_geometry);

/// How the sets of a frame are made.
struct VplConfig {
    std::uint32_t interleave = 3;  ///< n, for n x n sets
    std::uint32_t vpls = 6;        ///< per set
    std::uint32_t paths = 0;       ///< light paths per pass
    std::uint32_t bounces = 64;
    std::uint32_t seed = 0;
    float max_geometry = infinity;
};

/// Candidates per VPL taken.
inline constexpr std::uint32_t candidates_per_vpl = 8;

/// Light paths per pass that make about candidates_per_vpl * n * n * vpls candidates: found by
/// walking a fixed number of paths. At most eight paths per candidate, where most light is lost.
std::uint32_t count_light_paths(const World& world, const VplConfig& config);

/// The sets of one pass: the same on every machine. `pilots` are points that the eye sees.
VplSets make_vpl_sets(const World& world, const VplConfig& config, std::uint32_t pass,
                      std::span<const Receiver> pilots);

}  // namespace tessera
