// Virtual point lights: Keller, "Instant Radiosity" (1997).
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "common/math.h"
#include "worker/bsdf.h"

namespace tessera {

/// Light that leaves a surface point, as if from a tiny lamp: Lambertian where nothing glossy is.
struct Vpl {
    vec3 org{0};                ///< beside the surface, where shadow rays start
    vec3 ng{0};                 ///< unit normal of the lit side
    vec3 intensity{0};          ///< along the normal, W/sr
    std::uint32_t bounces = 1;  ///< reflections since the light, the one here counted
    vec3 n{0};                  ///< shading normal of the lit side
    vec3 wo{0};                 ///< where the light came from, unit
    Bsdf bsdf;
    std::uint32_t light = 0;  ///< where the path began, where lights are tracked
};

/// The n x n sets of one pass, one after the other.
struct VplSets {
    std::vector<Vpl> vpls;
    std::vector<std::uint32_t> first;  ///< of each set, and the end of the last
    ivec2 offset{0};                   ///< shift of the interleaving grid, pixels
    std::uint64_t rays = 0;            ///< traced to make them

    std::span<const Vpl> set(std::uint32_t i) const {
        return std::span(vpls).subspan(first[i], first[i + 1] - first[i]);
    }
};

/// Which set the pixel at `raster` uses: from image coordinates, so that tiles fit together.
inline std::uint32_t set_index(const ivec2& raster, const ivec2& offset, std::uint32_t n) {
    const auto x = std::uint32_t(raster.x + offset.x) % n;
    const auto y = std::uint32_t(raster.y + offset.y) % n;
    return y * n + x;
}

}  // namespace tessera
