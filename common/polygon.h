// Polygons -> triangles, for file formats whose faces have any number of corners.
#pragma once

#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

/// Triangles of the polygon with these corners, as indices into `corners`, wound as it is. A convex
/// polygon becomes a fan around its first corner; others lose one ear at a time (Meisters,
/// "Polygons have Ears", 1975). Polygons that cross themselves, and those of more than 256 corners
/// that are not convex, become a fan too. Fewer than three corners have no triangles.
std::vector<uvec3> triangulate(std::span<const vec3> corners);

}  // namespace tessera
