// What a scene needs, decided once when it is loaded.
#pragma once

#include "worker/caustics.h"
#include "worker/lights.h"
#include "worker/renderer.h"

namespace tessera {

ScenePlan make_plan(const Scene& scene, const Surfaces& surfaces, const Lights& lights,
                    const Caustics& caustics);

}  // namespace tessera
