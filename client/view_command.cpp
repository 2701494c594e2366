// tessera view: the desktop viewer on an open scene of a server, or on a scene that an embedded
// cluster renders.

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "client/camera_options.h"
#include "client/commands.h"
#include "client/interrupt.h"
#include "client/local_cluster.h"
#include "client/viewer.h"
#include "common/check.h"
#include "common/scene_bounds.h"
#include "common/scene_io.h"

namespace tessera {
namespace {

using Json = nlohmann::json;

struct ViewOptions {
    std::string scene;
    std::string server;
    std::string keys;
    LocalClusterConfig cluster;
    CameraOptions camera;
    std::uint32_t passes = 256;
    int pictures = 0;
    std::string screenshot;
};

// ---- What is remembered -------------------------------------------------------------------------

std::filesystem::path memory_file() {
    const char* config = std::getenv("XDG_CONFIG_HOME");
    const char* home = std::getenv("HOME");
    if (config && *config) return std::filesystem::path(config) / "tessera" / "view.json";
    if (home && *home) return std::filesystem::path(home) / ".config" / "tessera" / "view.json";
    return {};
}

Json json_of(const vec3& v) { return {v.x, v.y, v.z}; }
vec3 vec3_of(const Json& v) { return {v.at(0), v.at(1), v.at(2)}; }

Json json_of(const ViewerMemory& memory) {
    Json cameras = Json::object();
    for (const auto& [scene, camera] : memory.cameras)
        cameras[scene] = {{"eye", json_of(camera.eye)},
                          {"at", json_of(camera.at)},
                          {"up", json_of(camera.up)},
                          {"fov", camera.fov_y}};
    const WindowConfig& window = memory.window;
    return {{"window", {window.x, window.y, window.size.width, window.size.height}},
            {"exposure", memory.tone_map.exposure},
            {"filmic", memory.tone_map.curve == ToneCurve::filmic},
            {"panel", memory.panel},
            {"cameras", cameras}};
}

ViewerMemory memory_of(const Json& from) {
    ViewerMemory memory;
    const Json& window = from.at("window");
    memory.window = {
        .title = {},
        .x = window.at(0),
        .y = window.at(1),
        .size = {std::max(window.at(2).get<int>(), 320), std::max(window.at(3).get<int>(), 240)}};
    memory.tone_map.exposure = from.at("exposure");
    memory.tone_map.curve = from.at("filmic") ? ToneCurve::filmic : ToneCurve::srgb;
    memory.panel = from.at("panel");
    for (const auto& [scene, camera] : from.at("cameras").items())
        memory.cameras[scene] = {.name = {},
                                 .eye = vec3_of(camera.at("eye")),
                                 .at = vec3_of(camera.at("at")),
                                 .up = vec3_of(camera.at("up")),
                                 .fov_y = camera.at("fov")};
    return memory;
}

/// What was remembered, as far as it can be read: a viewer starts without it, too.
ViewerMemory recalled(const std::filesystem::path& file) {
    try {
        std::ifstream in(file);
        return in ? memory_of(Json::parse(in)) : ViewerMemory{};
    } catch (const Json::exception&) {
        return {};
    }
}

void remember(const ViewerMemory& memory, const std::filesystem::path& file) {
    if (file.empty()) return;
    std::error_code ignored;
    std::filesystem::create_directories(file.parent_path(), ignored);
    std::ofstream(file) << json_of(memory).dump(2) << '\n';
}

// ---- Scene and camera ---------------------------------------------------------------------------

/// The name of an open scene: the one asked for, else the server's first. A file that the server
/// does not hold is uploaded and opened to all, and its motion is known then.
std::string open_scene(const ViewOptions& options, RenderClient& client, Motion& motion) {
    const std::vector<std::string>& open = client.welcome().scenes;
    const std::string name = std::filesystem::path(options.scene).filename().string();
    if (name.empty() && open.empty())
        throw UserError("the server holds no scene: name one, a file or a generated scene");
    if (name.empty()) return open.front();
    if (std::find(open.begin(), open.end(), name) != open.end()) return name;
    LoadedScene loaded = load_scene(options.scene);
    for (const std::string& note : loaded.notes) fmt::print(stderr, "tessera: {}\n", note);
    client.upload_scene(name, loaded.bundle);
    client.share_scene(name);
    motion = std::move(loaded.bundle.motion);
    return name;
}

Camera first_camera(const ViewOptions& options, const ViewerMemory& memory,
                    const std::string& scene, RenderClient& client) {
    const CameraOptions& o = options.camera;
    const bool chosen = !o.camera.empty() || !o.eye.empty() || !o.at.empty() || o.fov;
    const auto remembered = memory.cameras.find(scene);
    if (!chosen && remembered != memory.cameras.end()) return remembered->second;
    SceneBundle bundle{.scene = client.scene().scene, .blobs = {}};
    // Only a camera that frames all needs the meshes.
    if (bundle.scene.cameras.empty()) bundle.blobs = client.fetch_blobs(scene, bundle.scene.meshes);
    return chosen_camera(o, bundle, [](const std::string&) {});
}

void run(const ViewOptions& options) {
    if (options.scene.empty() && options.server.empty())
        throw UserError("name a scene, or a server with --server");
    const bool scripted = options.pictures > 0;
    const auto file = scripted ? std::filesystem::path() : memory_file();
    ViewerMemory memory = recalled(file);
    Interrupt interrupt;
    std::optional<LocalCluster> cluster;
    if (options.server.empty()) cluster.emplace(options.cluster);
    RenderClient client(
        {.address = cluster ? cluster->address() : options.server,
         .credentials = cluster ? cluster->credentials() : load_credentials(options.keys),
         .tick =
             [&] {
                 interrupt.check();
                 if (cluster) cluster->check_alive();
             },
         .reconnects = !cluster});
    Motion motion;
    const std::string scene = open_scene(options, client, motion);
    client.watch(scene);
    memory.window.title = fmt::format("{} - Tessera", scene);
    if (scripted) memory.window.size = options.camera.size;
    Viewer viewer({.scene = scene,
                   .camera = first_camera(options, memory, scene, client),
                   .settings = {.passes = options.passes},
                   .format = cluster ? PictureFormat::srgb8 : PictureFormat::automatic,
                   .pictures = options.pictures,
                   .screenshot = options.screenshot,
                   .motion = std::move(motion)},
                  client, memory);
    viewer.run();
    remember(memory, file);
}

}  // namespace

void add_view_command(CLI::App& app) {
    auto options = std::make_shared<ViewOptions>();
    options->camera.size = {1280, 800};
    CLI::App* command = app.add_subcommand("view", "Look at a scene, move through it, change it");
    command->add_option("SCENE", options->scene,
                        "a scene of the server, a file, or the name of a generated scene");
    auto* server =
        command->add_option("--server", options->server, "HOST:PORT instead of this machine alone");
    add_keys_option(command, options->keys)->needs(server);
    add_camera_options(command, options->camera);
    command->add_option("--passes", options->passes, "passes until a picture has settled")
        ->check(CLI::Range(1u, 1u << 20))
        ->capture_default_str();
    command->add_option("--workers", options->cluster.workers, "worker processes on this machine")
        ->check(CLI::Range(1, 64))
        ->excludes(server);
    command->add_option("--threads", options->cluster.threads, "render threads of each of them")
        ->check(CLI::Range(1, 1024))
        ->excludes(server);
    auto* frames = command
                       ->add_option("--frames", options->pictures,
                                    "for scripts: end after so many pictures in a window of --size")
                       ->check(CLI::PositiveNumber);
    command
        ->add_option("--screenshot", options->screenshot,
                     "for scripts: picture file for the whole window at the end")
        ->needs(frames);
    command->callback([options] { run(*options); });
}

}  // namespace tessera
