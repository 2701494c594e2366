#include "client/web_viewer.h"

#include <fmt/format.h>
#include <png.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <nlohmann/json.hpp>
#include <set>

#include "client/camera_control.h"
#include "client/edit_json.h"
#include "common/check.h"
#include "common/false_colour.h"
#include "common/scene_bounds.h"

namespace tessera {
namespace {

using nlohmann::json;
using Clock = std::chrono::steady_clock;

/// Pages show one picture while the next is under way.
constexpr std::size_t most_unshown = 2;
constexpr std::chrono::seconds status_interval{1};
/// A page shows controls for no more lights than these.
constexpr std::size_t most_lights = 64;
/// And names no more workers.
constexpr std::size_t most_owners = 32;

// ---- To JSON ------------------------------------------------------------------------------------

/// Lights, and surfaces that emit, with the edit that sets their strength.
json lights_of(const Scene& scene) {
    json out = json::array();
    const auto add = [&](const char* set, const std::string& name, const char* field,
                         const vec3& value) {
        if (out.size() < most_lights)
            out.push_back(
                {{"set", set}, {"name", name}, {"field", field}, {"value", json_of(value)}});
    };
    for (const Light& light : scene.lights) add("light", light.name, "intensity", light.intensity);
    for (const Material& material : scene.materials)
        if (max_component(material.emission) > 0)
            add("material", material.name, "emission", material.emission);
    return out;
}

json cameras_of(const Scene& scene) {
    json out = json::array();
    for (const Camera& camera : scene.cameras) out.push_back(json_of(camera));
    return out;
}

/// Names are not always UTF-8.
std::string text_of(const json& value) {
    return value.dump(-1, ' ', false, json::error_handler_t::replace);
}

/// Fast rather than small: it is made once, when the picture has settled.
std::string png_of(const std::vector<std::uint8_t>& srgb8, ImageSize size) {
    png_image image{};
    image.version = PNG_IMAGE_VERSION;
    image.width = png_uint_32(size.width);
    image.height = png_uint_32(size.height);
    image.format = PNG_FORMAT_RGB;
    image.flags = PNG_IMAGE_FLAG_FAST;
    png_alloc_size_t bytes = PNG_IMAGE_PNG_SIZE_MAX(image);
    std::string out(bytes, '\0');
    CHECK(png_image_write_to_memory(&image, out.data(), &bytes, 0, srgb8.data(), 0, nullptr));
    out.resize(bytes);
    return out;
}

const Instance* find_instance(const Scene& scene, const std::string& name) {
    for (const Instance& instance : scene.instances)
        if (!name.empty() && instance.name == name) return &instance;
    return nullptr;
}

std::string chosen_scene(const std::string& name, const RenderClient& client) {
    if (!name.empty()) return name;
    if (client.welcome().scenes.empty())
        throw UserError("the server holds no scene: start it with one, or name one with --scene");
    return client.welcome().scenes.front();
}

}  // namespace

WebViewer::WebViewer(const WebViewerConfig& config)
    : client_(config.server),
      scene_name_(chosen_scene(config.scene, client_)),
      player_(config.motion) {
    client_.watch(scene_name_);
    wanted_.request = 1;
    wanted_.spec.scene = scene_name_;
    wanted_.spec.settings.passes = config.passes;
    asked_ = wanted_;
    home_ = scene().cameras.empty()
                ? framing_camera(
                      scene_bounds({scene(), client_.fetch_blobs(scene_name_, scene().meshes)}))
                : scene().cameras.front();
    tell_about();
}

// ---- What the page says -------------------------------------------------------------------------

void WebViewer::hear(const std::vector<std::string>& messages) {
    try {
        for (const std::string& message : messages) hear(json::parse(message));
    } catch (const json::exception& error) {
        throw PageError(error.what());
    }
    // Of several views only the last is worth a picture.
    if (wanted_ == asked_) return;
    client_.show(wanted_);
    asked_ = wanted_;
}

void WebViewer::hear(const json& message) {
    if (message.contains("view")) {
        read_view(message.at("view"), wanted_);
    } else if (message.contains("shown")) {
        shown(message);
    } else if (message.contains("play")) {
        player_.play(message.at("play").get<bool>());
    } else if (message.contains("seek")) {
        player_.seek(read_seconds(message.at("seek")));
    } else if (message.contains("pick")) {
        pick(message);
    } else if (message.contains("select")) {
        selected_ = message.at("select").get<std::string>();
        tell_about();
    } else if (message.contains("edit")) {
        edit(message.at("edit"));
    } else {
        throw PageError("nobody knows what that message means");
    }
}

void WebViewer::shown(const json& message) {
    if (unshown_.empty()) return;
    const auto [told, jpeg] = unshown_.front();
    unshown_.pop_front();
    if (!jpeg || !message.contains("seconds")) return;
    const double seconds = read_seconds(message.at("seconds"));
    const double all = std::chrono::duration<double>(Clock::now() - told).count();
    jpeg_quality_ = next_jpeg_quality(jpeg_quality_, seconds, all - seconds);
    wanted_.jpeg_quality = std::uint32_t(jpeg_quality_);
}

void WebViewer::pick(const json& message) {
    const auto [point, number] = read_pick(message);
    json answer = {{"number", number}};
    if (const auto picked = picker().pick(scene(), eye_ray(wanted_.spec.camera, point))) {
        const Instance& instance = scene().instances[picked->instance];
        answer["instance"] = instance.name;
        answer["origin"] = json_of(vec3(instance.world_from_object[3]));
        answer["point"] = json_of(picked->p);
        answer["material"] = scene().materials[picked->material].name;
    }
    tell(PageNews::picked, {{"picked", answer}});
}

/// What another viewer has deleted in the meantime is no fault of the page.
void WebViewer::edit(const json& operation) {
    try {
        client_.send_edit(scene_name_, {operation_of_json(operation, scene())});
    } catch (const UserError& error) {
        tell(PageNews::notice, {{"notice", error.what()}});
    }
}

const Picker& WebViewer::picker() {
    if (!picker_ || !picker_->knows(scene()))
        picker_.emplace(scene(), client_.fetch_blobs(scene_name_, scene().meshes));
    return *picker_;
}

// ---- What the page hears ------------------------------------------------------------------------

std::vector<PageMessage> WebViewer::news(std::chrono::milliseconds patience) {
    // What is to be told already does not wait.
    client_.poll(news_.empty() ? patience : std::chrono::milliseconds(0));
    if (client_.scene().version != told_version_) tell_about();
    move();
    for (const std::string& complaint : client_.take_complaints())
        tell(PageNews::notice, {{"notice", complaint}});
    if (const auto status = client_.take_status()) {
        std::uint32_t threads = 0;
        json owners = json::array();
        for (const WorkerStatus& worker : status->workers) {
            threads += worker.threads;
            if (owners.size() < most_owners)
                owners.push_back(
                    {{"name", worker.name}, {"colour", colour_of_number(worker.peer)}});
        }
        tell(PageNews::status, {{"status",
                                 {{"workers", status->workers.size()},
                                  {"threads", threads},
                                  {"owners", owners},
                                  {"viewers", status->viewers}}}});
    }
    if (Clock::now() - status_asked_ >= status_interval) {
        status_asked_ = Clock::now();
        client_.ask_status();
    }
    if (unshown_.size() < most_unshown)
        if (const auto picture = client_.take_picture()) tell_picture(*picture);
    return std::exchange(news_, {});
}

/// Puts what moves where it is by now, and tells where that is.
void WebViewer::move() {
    const auto edits = player_.step(scene(), client_.scene().version, seen_version_, Clock::now());
    if (edits) client_.send_edit(scene_name_, edits->operations, edits->blobs);
    if (player_.duration() > 0 &&
        (player_.seconds() != told_seconds_ || player_.playing() != told_playing_))
        tell_motion();
}

void WebViewer::tell_motion() {
    told_seconds_ = player_.seconds();
    told_playing_ = player_.playing();
    tell(PageNews::motion, {{"motion",
                             {{"seconds", told_seconds_},
                              {"duration", player_.duration()},
                              {"playing", told_playing_}}}});
}

void WebViewer::tell(PageNews kind, const json& message) {
    news_.push_back({kind, text_of(message)});
}

void WebViewer::tell_about() {
    told_version_ = client_.scene().version;
    tell(PageNews::about, {{"about",
                            {{"scene", scene_name_},
                             {"version", told_version_},
                             {"passes", wanted_.spec.settings.passes},
                             {"home", json_of(home_)},
                             {"cameras", cameras_of(scene())},
                             {"lights", lights_of(scene())},
                             {"selection", selection()}}}});
}

/// Null when nothing is selected, or no longer there.
json WebViewer::selection() const {
    const Instance* instance = find_instance(scene(), selected_);
    if (!instance) return nullptr;
    const std::vector<std::uint32_t>& used = scene().objects[instance->object].materials;
    json materials = json::array();
    for (const std::uint32_t m : std::set(used.begin(), used.end()))
        materials.push_back(json_of(scene().materials[m]));
    return {{"instance", instance->name},
            {"place", json_of(vec3(instance->world_from_object[3]))},
            {"materials", materials}};
}

void WebViewer::tell_picture(const ShownPicture& picture) {
    const ViewPicture& about = picture.about;
    const bool jpeg = !picture.jpeg.empty();
    const std::string header = text_of({{"type", jpeg ? "image/jpeg" : "image/png"},
                                        {"stamp", about.stamp},
                                        {"version", about.version},
                                        {"width", picture.size.width},
                                        {"height", picture.size.height},
                                        {"passes", about.passes},
                                        {"settled", about.settled},
                                        {"error", about.error_estimate},
                                        {"first_seconds", about.first_seconds},
                                        {"render_seconds", about.render_seconds},
                                        {"rays", about.rays}});
    const auto length = std::uint32_t(header.size());
    std::string bytes;
    for (int shift = 0; shift < 32; shift += 8) bytes.push_back(char(length >> shift));
    bytes += header;
    if (jpeg)
        bytes.append(reinterpret_cast<const char*>(picture.jpeg.data()), picture.jpeg.size());
    else
        bytes += png_of(picture.srgb8, picture.size);
    seen_version_ = about.version;
    unshown_.push_back({.told = Clock::now(), .jpeg = jpeg});
    news_.push_back({PageNews::picture, std::move(bytes)});
}

}  // namespace tessera
