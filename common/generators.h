// The generators behind generate_scene(), one per file.
#pragma once

#include "common/scene.h"

namespace tessera {

SceneBundle generate_building();
SceneBundle generate_cornell();
SceneBundle generate_office();
SceneBundle generate_sunflowers();

}  // namespace tessera
