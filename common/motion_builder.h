// The steps by which generators let things move: a track that repeats, a node that follows it, an
// instance that the node carries.
#pragma once

#include <functional>

#include "common/scene.h"

namespace tessera {

/// How often a movement is repeated, and by how many keys it is followed, linearly between them.
struct Beat {
    double period = 1;  ///< seconds
    int times = 1;
    int keys = 8;  ///< of one period
};

/// Each adds one entry and returns its index; the functions take the part of the period, 0 to 1.
std::int32_t add_translations(Motion& motion, const Beat& beat,
                              const std::function<vec3(float)>& at);
std::int32_t add_rotations(Motion& motion, const Beat& beat,
                           const std::function<glm::quat(float)>& at);
std::int32_t add_weights(Motion& motion, const Beat& beat,
                         const std::function<std::vector<float>(float)>& at);
std::uint32_t add_node(Motion& motion, MotionNode node);

/// Lets the node carry an instance, which lies in the node as it lies in the world now, and whose
/// name must be its own.
void carry(SceneBundle& bundle, std::uint32_t instance, std::uint32_t node);

}  // namespace tessera
