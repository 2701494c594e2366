#include "common/tone_map.h"

#include <algorithm>
#include <bit>
#include <cmath>

namespace tessera {
namespace {

/// Hable's curve with his published constants, before normalisation by its value at white.
float hable(float x) {
    constexpr float a = 0.15f, b = 0.50f, c = 0.10f, d = 0.20f, e = 0.02f, f = 0.30f;
    return (x * (a * x + c * b) + d * e) / (x * (a * x + b) + d * f) - e / f;
}

}  // namespace

float apply_curve(const ToneMap& tone_map, float radiance) {
    constexpr float white = 11.2f;  // Hable's linear white point
    constexpr float beyond = 1e6f;  // white for long, and its square is still a float
    const float exposed = std::max(0.0f, radiance) * std::exp2(tone_map.exposure);
    if (!std::isfinite(radiance) || std::isnan(exposed)) return 0;
    const float mapped = tone_map.curve == ToneCurve::filmic
                             ? hable(std::min(2 * exposed, beyond)) / hable(white)
                             : exposed;
    return std::min(mapped, 1.0f);
}

float srgb_from_linear(float linear) {
    return linear <= 0.0031308f ? 12.92f * linear : 1.055f * std::pow(linear, 1 / 2.4f) - 0.055f;
}

float linear_from_srgb(float srgb) {
    return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f);
}

namespace {

std::uint8_t quantised(const ToneMap& tone_map, float radiance) {
    return std::uint8_t(255 * srgb_from_linear(apply_curve(tone_map, radiance)) + 0.5f);
}

/// The least bits from `from` up to `end` whose value is more than `value`; `end` if there are
/// none.
std::uint32_t first_above(const ToneMap& tone_map, int value, std::uint32_t from,
                          std::uint32_t end) {
    const auto is_above = [&](std::uint32_t bits) {
        return quantised(tone_map, std::bit_cast<float>(bits)) > value;
    };
    if (from == end || !is_above(end - 1)) return end;
    while (from < end) {
        const std::uint32_t middle = from + (end - from) / 2;
        if (is_above(middle))
            end = middle;
        else
            from = middle + 1;
    }
    return end;
}

}  // namespace

ToneTable::ToneTable(const ToneMap& tone_map)
    : lowest_(first_above(tone_map, 0, 0, infinity) / cell * cell) {
    std::uint32_t begin = lowest_;
    for (std::uint32_t& carried : cells_) {
        const std::uint32_t end = std::min(begin + cell, infinity);
        const std::uint32_t value = quantised(tone_map, std::bit_cast<float>(begin));
        const std::uint32_t next = first_above(tone_map, int(value), begin, end);
        carried = value * cell + (next == end ? 0 : cell - (next - begin));
        begin = end;
    }
}

std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map) {
    const ToneTable table(tone_map);
    std::vector<std::uint8_t> out;
    out.reserve(image.size.pixels() * 3);
    const std::size_t channels = std::size_t(image.channels);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (std::size_t c = 0; c < 3; ++c) out.push_back(table(image.data[p * channels + c]));
    return out;
}

}  // namespace tessera
