#include "client/page_json.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <map>
#include <nlohmann/json.hpp>

namespace tessera {
namespace {

using nlohmann::json;

/// A screen of 3840 x 2160 pixels.
constexpr std::size_t most_pixels = 3840 * 2160;
/// Of a picture's side; metres of a coordinate; stops of an exposure.
constexpr int most_side = 8192;
constexpr double most_coordinate = 1e6, most_exposure = 20;

const std::map<std::string, Channel> channels = {{"picture", Channel::radiance},
                                                 {"direct light", Channel::direct},
                                                 {"indirect light", Channel::indirect},
                                                 {"irradiance", Channel::irradiance},
                                                 {"albedo", Channel::albedo},
                                                 {"normal", Channel::normal},
                                                 {"depth", Channel::depth},
                                                 {"path length", Channel::path_length},
                                                 {"error", Channel::error},
                                                 {"tile owner", Channel::owner}};

double number_of(const json& value, double most) {
    const double number = value.get<double>();
    if (!(std::abs(number) <= most)) throw PageError(fmt::format("{} is out of range", number));
    return number;
}

std::uint32_t count_of(const json& value) {
    const double count = number_of(value, 4e9);
    if (count < 0) throw PageError(fmt::format("{} is out of range", count));
    return std::uint32_t(count);
}

vec3 vec3_of(const json& value) {
    const auto at = [&](int i) { return float(number_of(value.at(i), most_coordinate)); };
    return {at(0), at(1), at(2)};
}

Camera camera_of(const json& value) {
    const Camera camera{.name = {},
                        .eye = vec3_of(value.at("eye")),
                        .at = vec3_of(value.at("at")),
                        .up = vec3_of(value.at("up")),
                        .fov_y = float(number_of(value.at("fov"), 179))};
    const vec3 view = camera.at - camera.eye;
    if (!(length(cross(view, camera.up)) > 1e-6f * length(view) * length(camera.up)) ||
        camera.fov_y < 0.01f)
        throw PageError("the camera sees nothing");
    return camera;
}

ImageSize size_of(const json& value) {
    const ImageSize size{int(number_of(value.at(0), most_side)),
                         int(number_of(value.at(1), most_side))};
    if (std::min(size.width, size.height) < 1 || size.pixels() > most_pixels)
        throw PageError("no picture has that size");
    return size;
}

Channel channel_of(const json& value) {
    const auto found = channels.find(value.get<std::string>());
    if (found == channels.end()) throw PageError("no channel has that name");
    return found->second;
}

}  // namespace

void read_view(const json& message, View& view) {
    View next = view;
    next.spec.camera = camera_of(message.at("camera"));
    next.spec.size = size_of(message.at("size"));
    next.spec.settings.integrator =
        message.at("reference").get<bool>() ? Integrator::path : Integrator::igi;
    next.tone_map.exposure = float(number_of(message.at("exposure"), most_exposure));
    next.tone_map.curve = message.at("filmic").get<bool>() ? ToneCurve::filmic : ToneCurve::srgb;
    next.shown = channel_of(message.at("channel"));
    next.stamp = count_of(message.at("stamp"));
    view = next;
}

double read_seconds(const json& message) {
    constexpr double day = 86400;
    return std::max(number_of(message, day), 0.0);
}

PagePick read_pick(const json& message) {
    const json& point = message.at("pick");
    const auto at = [&](int i) { return float(number_of(point.at(i), 100)); };
    return {.point = {at(0), at(1)}, .number = count_of(message.at("number"))};
}

}  // namespace tessera
