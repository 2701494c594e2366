// The reference: a path tracer with next event estimation, combined with scattered rays by multiple
// importance sampling (Veach, "Robust Monte Carlo Methods for Light Transport Simulation", 1997,
// power heuristic). Unbiased; walks all paths of a tile in step, so that rays are traced in
// batches.
#pragma once

#include "worker/eye.h"

namespace tessera {

/// Adds direct and indirect irradiance of one path per receiver to `pixels`; at most `bounces`
/// reflections between a light's first surface and the receiver. Returns the number of rays traced.
std::uint64_t trace_paths(const World& world, const TilePass& tile, std::uint32_t bounces,
                          std::span<const Receiver> receivers, std::span<PixelSample> pixels);

}  // namespace tessera
