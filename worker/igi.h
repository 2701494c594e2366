// Instant Global Illumination: Wald, Kollig, Benthin, Keller and Slusallek, "Interactive Global
// Illumination using Fast Ray Tracing" (2002). Each pixel gathers from one of n x n interleaved
// sets of virtual point lights (Keller and Heidrich, "Interleaved Sampling", 2001); the
// discontinuity filter then averages over neighbours, which used the other sets.
//
// We differ in compensating for the bound of the geometry term (Kollig and Keller, "Illumination in
// the Presence of Weak Singularities", 2004) by paths of short rays, which make up for the bound at
// their own vertices, too, so that nothing is lost; and in taking light straight from lamps apart
// from the VPLs: one point on one light per pixel and pass, chosen among candidates by what they
// would contribute (Talbot, Cline and Egbert, "Importance Resampling for Global Illumination",
// 2005), combined with lamps that the short rays find.
//
// VPLs light broad lobes only. Narrow ones, mirrors and glass are followed by rays from wherever
// they are met: seen by the eye, or by a scattered ray, which then is not cut short. Light of small
// lamps and of lights without size that passes mirrors and glass comes by photons (caustics.h). So
// a refined picture converges to the path tracer's, caustics included.
#pragma once

#include "worker/caustics.h"
#include "worker/vpl.h"

namespace tessera {

/// What each light sends into a tile: the radiance of its pixels, summed up in each quarter, so
/// that quarters that are rendered apart add up to the same bits.
class LightTally {
public:
    LightTally(std::size_t lights, const Rect& pixels)
        : pixels_(pixels), lights_(lights), radiance_(quarters * lights) {}

    /// `pixel`: index within `pixels`.
    void add(std::uint32_t light, std::uint32_t pixel, const vec3& radiance) {
        const int x = pixels_.x0 + int(pixel) % pixels_.width();
        const int y = pixels_.y0 + int(pixel) / pixels_.width();
        radiance_[quarter_of(x, y) * lights_ + light] += mean_component(radiance);
    }
    /// Those that send anything, by number.
    std::vector<LightEstimate> estimates() const;

private:
    Rect pixels_;
    std::size_t lights_;
    std::vector<float> radiance_;  ///< quarter by quarter
};

struct IgiConfig {
    std::uint32_t interleave = 3;
    /// Bound of cos * cos / d^2 between a VPL and a receiver, m^-2: without it VPLs near a surface
    /// make bright spots.
    float max_geometry = infinity;
    std::uint32_t bounces = 64;
    /// What the discontinuity filter spans, seen from the eye; rad.
    float filter_angle = 0;
    /// Whether any surface has lobes that are not broad.
    bool has_rest = false;
    /// Null: all caustics are found by rays.
    const PhotonMap* photons = nullptr;
    const Caustics* caustics = nullptr;  ///< which `photons` are of
    /// Where to add up what each light sends; null where lights are not tracked.
    LightTally* tally = nullptr;
};

/// Adds direct irradiance to `pixels`, but for the share of near lamps that gather_compensation()
/// brings, and what photons bring. Returns the number of rays traced.
std::uint64_t gather_direct(const World& world, const TilePass& tile, const IgiConfig& config,
                            std::span<const Receiver> receivers, std::span<PixelSample> pixels);

/// Adds what gather_indirect() leaves out. A scattered ray per receiver, or for every other where
/// no surface has lobes that are not broad, finds surfaces so near that their geometry term exceeds
/// the bound, adds the excess of their light, and near lamps, and goes on from there; and it finds
/// what narrow and ideal lobes reflect towards the receiver. One more follows the receiver's own
/// narrow lobe. Returns the number of rays traced.
std::uint64_t gather_rest(const World& world, const TilePass& tile, const IgiConfig& config,
                          const VplSets& sets, std::span<const Receiver> receivers,
                          std::span<PixelSample> pixels);

/// Adds indirect irradiance, each pixel from its own set. Returns the number of rays traced.
std::uint64_t gather_indirect(const World& world, const TilePass& tile, const IgiConfig& config,
                              const VplSets& sets, std::span<const Receiver> receivers,
                              std::span<PixelSample> pixels);

}  // namespace tessera
