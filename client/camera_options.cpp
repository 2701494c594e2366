#include "client/camera_options.h"

#include <fmt/format.h>

#include "common/check.h"
#include "common/message_codec.h"
#include "common/scene_bounds.h"

namespace tessera {
namespace {

using Note = std::function<void(const std::string&)>;

ImageSize parse_size(const std::string& text) {
    ImageSize size;
    char x = 0, rest = 0;
    const bool parsed =
        std::sscanf(text.c_str(), "%d%c%d%c", &size.width, &x, &size.height, &rest) == 3 &&
        x == 'x';
    if (!parsed || std::min(size.width, size.height) < 1 ||
        std::max(size.width, size.height) > max_image_side || size.pixels() > max_image_pixels)
        throw CLI::ValidationError(
            "--size",
            fmt::format("`{}` is not WIDTHxHEIGHT, each at most {} and together at most {} pixels",
                        text, max_image_side, max_image_pixels));
    return size;
}

vec3 to_vec3(const std::vector<float>& v) { return {v[0], v[1], v[2]}; }

Camera scene_camera(const CameraOptions& options, const SceneBundle& bundle, const Note& note) {
    const std::vector<Camera>& cameras = bundle.scene.cameras;
    if (options.camera.empty()) {
        if (!cameras.empty()) return cameras.front();
        if (options.eye.empty()) note("no camera in the scene: framing all of it");
        return framing_camera(scene_bounds(bundle));
    }
    std::string known;
    for (const Camera& camera : cameras) {
        if (camera.name == options.camera) return camera;
        known += (known.empty() ? "" : ", ") + camera.name;
    }
    throw UserError(fmt::format("--camera {}: the scene has no such camera; it has: {}",
                                options.camera, known.empty() ? "none" : known));
}

}  // namespace

Camera chosen_camera(const CameraOptions& options, const SceneBundle& bundle, const Note& note) {
    Camera camera = scene_camera(options, bundle, note);
    if (!options.eye.empty()) camera.eye = to_vec3(options.eye);
    if (!options.at.empty()) camera.at = to_vec3(options.at);
    if (!options.up.empty()) camera.up = to_vec3(options.up);
    if (options.fov) camera.fov_y = *options.fov;
    const vec3 view = camera.at - camera.eye;
    if (glm::length(glm::cross(view, camera.up)) <=
        1e-6f * glm::length(view) * glm::length(camera.up))
        throw UserError(
            "the camera looks along its own up direction or nowhere: change --eye, --at or --up");
    return camera;
}

void add_camera_options(CLI::App* command, CameraOptions& o) {
    command->add_option_function<std::string>(
        "--size", [&o](const std::string& text) { o.size = parse_size(text); },
        "WxH in pixels (default 640x480)");
    command->add_option("--eye", o.eye, "x,y,z of the eye")->delimiter(',')->expected(3);
    command->add_option("--at", o.at, "x,y,z of the point looked at")->delimiter(',')->expected(3);
    command->add_option("--up", o.up, "x,y,z upwards")->delimiter(',')->expected(3);
    command->add_option("--fov", o.fov, "vertical field of view in degrees")
        ->check(CLI::Range(0.01, 179.0));
    command->add_option("--camera", o.camera,
                        "a camera of the scene, by name (default: its first)");
}

}  // namespace tessera
