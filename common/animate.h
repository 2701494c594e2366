// Where things are at a time: the motion of a scene, evaluated into edits. Pure.
//
// Interpolation is glTF 2.0's (appendix C): of rotations along the great circle. Vertices are
// blended linearly, morph targets before skins.
#pragma once

#include <vector>

#include "common/motion.h"
#include "common/scene_edit.h"

namespace tessera {

/// `track` at `seconds`; `components` numbers.
std::vector<float> sample(const Track& track, double seconds);
/// The same of rotations (x, y, z, w).
glm::quat sample_rotation(const Track& track, double seconds);

/// World from each node.
std::vector<glm::dmat4> node_transforms(const Motion& motion, double seconds);

/// Where a deformed object's vertices are; `world_from_node` as node_transforms() says.
Shape deformed_shape(const Motion& motion, const Motion::Deformed& object, double seconds,
                     std::span<const glm::dmat4> world_from_node);

struct MotionEdits {
    std::vector<EditOperation> operations;
    BlobStore blobs;  ///< that they name
};

/// What puts everything that moves where it is at `seconds`. What the scene does not hold is left
/// out. With `shape_error` vertices travel in fewer bytes and are off by at most so much.
MotionEdits edits_at(const Scene& scene, const Motion& motion, double seconds,
                     float shape_error = 0);

/// The scene at that time, with its blobs.
SceneBundle bundle_at(const SceneBundle& bundle, double seconds);

}  // namespace tessera
