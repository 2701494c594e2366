// World bounds of a scene, and a camera for scenes that bring none.
#pragma once

#include "common/math.h"
#include "common/scene.h"

namespace tessera {

/// World-space bounds of all instances; empty when nothing is placed. Decodes every mesh.
Box scene_bounds(const SceneBundle& bundle);

/// A camera that sees the whole of `bounds` from the front, a little above and to the right.
Camera framing_camera(const Box& bounds);

/// Whether anything in the scene gives light.
bool has_light(const Scene& scene);

}  // namespace tessera
