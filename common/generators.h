// The generators behind generate_scene(), one per file.
#pragma once

#include "common/scene.h"

namespace tessera {

SceneBundle generate_cornell();
SceneBundle generate_office();

}  // namespace tessera
