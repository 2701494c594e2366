// The reference: a path tracer with next event estimation, combined with scattered rays by multiple
// importance sampling (Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997,
// power heuristic). Unbiased, but for light that no ray can find: that of lights without size
// through mirrors and glass comes by photons, and is right in the limit (caustics.h). Walks all
// paths of a tile in step, so that rays are traced in batches.
#pragma once

#include "worker/caustics.h"

namespace tessera {

/// Adds direct and indirect irradiance of one path per receiver to `pixels`; at most `bounces`
/// reflections between a light's first surface and the receiver. `photons`: of lights without size
/// through mirrors and glass, or null. Returns the number of rays traced.
std::uint64_t trace_paths(const World& world, const TilePass& tile, std::uint32_t bounces,
                          const PhotonMap* photons, std::span<const Receiver> receivers,
                          std::span<PixelSample> pixels);

}  // namespace tessera
