#include "common/false_colour.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

namespace tessera {
namespace {

constexpr Rgb8 points[] = {{68, 1, 84},    {71, 44, 122},  {59, 81, 139},
                           {44, 113, 142}, {33, 144, 141}, {39, 173, 129},
                           {92, 200, 99},  {170, 220, 50}, {253, 231, 37}};
constexpr int last = int(std::size(points)) - 1;
constexpr Rgb8 no_number{70, 70, 70};

/// Errors are shown from 1/10,000 to 1, by their logarithm; paths up to eight segments.
constexpr float least_error_log10 = -4, longest_path = 8;

template <class ColourOf>
std::vector<std::uint8_t> by_pixel(const Image& image, const ColourOf& colour_of) {
    std::vector<std::uint8_t> out;
    out.reserve(3 * image.data.size());
    for (const float value : image.data) {
        const Rgb8 colour = colour_of(value);
        out.insert(out.end(), colour.begin(), colour.end());
    }
    return out;
}

std::vector<std::uint8_t> normal_colours(const Image& normals) {
    std::vector<std::uint8_t> out;
    for (const float n : normals.data)
        out.push_back(std::uint8_t(255 * std::clamp(0.5f * n + 0.5f, 0.0f, 1.0f) + 0.5f));
    return out;
}

/// The hash's own bits.
Rgb8 hash_colour(float surface) {
    const auto bits = std::bit_cast<std::uint32_t>(surface);
    return {std::uint8_t(bits), std::uint8_t(bits >> 8), std::uint8_t(bits >> 16)};
}

}  // namespace

Rgb8 viridis(float t) {
    if (std::isnan(t)) return no_number;
    const float at = float(last) * std::clamp(t, 0.0f, 1.0f);
    const int i = std::min(int(at), last - 1);
    Rgb8 out;
    for (std::size_t c = 0; c < 3; ++c)
        out[c] = std::uint8_t(
            std::lerp(float(points[i][c]), float(points[i + 1][c]), at - float(i)) + 0.5f);
    return out;
}

/// Hues a golden section of the circle apart.
Rgb8 colour_of_number(std::uint64_t number) {
    const double hue = std::fmod(0.618033988749895 * double(number), 1.0);
    Rgb8 out;
    for (int c = 0; c < 3; ++c) {
        const double wave = std::cos(2 * 3.141592653589793 * (hue - c / 3.0));
        out[std::size_t(c)] = std::uint8_t(150 + 90 * wave);
    }
    return out;
}

float map_position(Channel channel, float value) {
    constexpr float none = std::numeric_limits<float>::quiet_NaN();
    switch (channel) {
        case Channel::depth:
            return std::isfinite(value) ? 1 / (1 + value) : none;
        case Channel::path_length:
            return value > 0 ? (value - 1) / (longest_path - 1) : none;
        case Channel::error:
            return std::isfinite(value) ? 1 - std::log10(std::max(value, 1e-9f)) / least_error_log10
                                        : none;
        default:
            return none;
    }
}

std::vector<LegendMark> legend_of(Channel channel) {
    std::vector<std::pair<float, const char*>> values;
    if (channel == Channel::depth)
        values = {{1e9f, "far"}, {3.0f, "3 m"}, {1.0f, "1 m"}, {1 / 3.0f, "1/3 m"}, {0.0f, "0"}};
    if (channel == Channel::path_length)
        values = {{1.0f, "1"}, {2.0f, "2"}, {3.0f, "3"}, {5.0f, "5"}, {8.0f, "8+"}};
    if (channel == Channel::error)
        values = {{1e-4f, "0.0001"}, {1e-3f, "0.001"}, {1e-2f, "0.01"}, {1e-1f, "0.1"}, {1, "1"}};
    std::vector<LegendMark> out;
    for (const auto& [value, text] : values) out.push_back({map_position(channel, value), text});
    return out;
}

const std::map<std::string, Channel>& channel_names() {
    static const std::map<std::string, Channel> names = {{"albedo", Channel::albedo},
                                                         {"normal", Channel::normal},
                                                         {"depth", Channel::depth},
                                                         {"irradiance", Channel::irradiance},
                                                         {"direct", Channel::direct},
                                                         {"indirect", Channel::indirect},
                                                         {"path-length", Channel::path_length},
                                                         {"error", Channel::error},
                                                         {"owner", Channel::owner}};
    return names;
}

std::vector<std::uint8_t> to_rgb8(const Image& image, Channel channel, const ToneMap& tone_map) {
    switch (channel) {
        case Channel::normal:
            return normal_colours(image);
        case Channel::surface:
            return by_pixel(image, hash_colour);
        case Channel::owner:
            return by_pixel(image, [](float v) { return colour_of_number(std::uint64_t(v)); });
        case Channel::depth:
        case Channel::path_length:
        case Channel::error:
            return by_pixel(image, [&](float v) { return viridis(map_position(channel, v)); });
        default:
            return to_srgb8(image, tone_map);
    }
}

}  // namespace tessera
