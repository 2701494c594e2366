// What every loader does to a mesh before it enters a scene, so that the tracer never meets a
// triangle without area or a vertex that is nowhere.
#pragma once

#include <cstddef>
#include <string>
#include <vector>

#include "common/mesh.h"

namespace tessera {

/// What cleaning took away or repaired, summed over the meshes of a scene.
struct MeshCleaning {
    std::size_t degenerate = 0;      ///< triangles of repeated vertices or exactly no area
    std::size_t not_finite = 0;      ///< triangles with a NaN or infinite vertex
    std::size_t bad_attributes = 0;  ///< normals of no length, attributes that are not finite
    std::size_t empty_meshes = 0;    ///< meshes of which nothing is left

    MeshCleaning& operator+=(const MeshCleaning& other);
};

/// Drops degenerate triangles and those with vertices that are not finite, then the vertices that
/// no triangle uses. A normal that is no direction becomes that of a triangle at its vertex; a
/// texture coordinate that is not finite becomes zero. Slots that are all zero go. Indices must be
/// in range.
MeshCleaning clean_mesh(Mesh& mesh);

/// One sentence for each count that is not zero.
std::vector<std::string> describe(const MeshCleaning& cleaning);

/// Appends `part` to `mesh`, both clean. A side that lacks normals gets those of its triangles (its
/// vertices are split for that: it looks flat, as without normals); missing texture coordinates and
/// slots are zero.
void append(Mesh& mesh, Mesh part);

}  // namespace tessera
