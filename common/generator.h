// Benchmark scenes made by the program itself, the same bits everywhere: procedural stand-ins for
// the scenes of Wald's thesis (2004), whose files are not public.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "common/scene.h"

namespace tessera {

struct GeneratedScene {
    std::string name;
    std::string description;  ///< one line for `tessera scene --list`
};

std::vector<GeneratedScene> generated_scenes();

/// Nothing when no generator has that name. Every scene has a camera and light.
std::optional<SceneBundle> generate_scene(const std::string& name);

}  // namespace tessera
