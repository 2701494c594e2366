// From where, and how large: options that several commands share.
#pragma once

#include <CLI/CLI.hpp>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "common/image.h"
#include "common/scene.h"

namespace tessera {

struct CameraOptions {
    ImageSize size{640, 480};
    std::vector<float> eye, at, up;
    std::optional<float> fov;
    std::string camera;
};

void add_camera_options(CLI::App* command, CameraOptions& options);

/// The camera that the options ask for, else the scene's first, else one that frames all; `note`
/// hears what the user should know. Throws UserError when the scene lacks it or it sees nothing.
Camera chosen_camera(const CameraOptions& options, const SceneBundle& bundle,
                     const std::function<void(const std::string&)>& note);

}  // namespace tessera
