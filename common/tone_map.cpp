#include "common/tone_map.h"

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
    const float exposed = std::max(0.0f, radiance) * std::exp2(tone_map.exposure);
    if (!std::isfinite(exposed)) return 0;
    const float mapped =
        tone_map.curve == ToneCurve::filmic ? hable(2 * exposed) / hable(white) : exposed;
    return std::min(mapped, 1.0f);
}

float srgb_from_linear(float linear) {
    return linear <= 0.0031308f ? 12.92f * linear : 1.055f * std::pow(linear, 1 / 2.4f) - 0.055f;
}

float linear_from_srgb(float srgb) {
    return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f);
}

std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map) {
    std::vector<std::uint8_t> out;
    out.reserve(image.size.pixels() * 3);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (int c = 0; c < 3; ++c) {
            const float value = apply_curve(tone_map, image.data[p * image.channels + c]);
            out.push_back(std::uint8_t(255 * srgb_from_linear(value) + 0.5f));
        }
    return out;
}

}  // namespace tessera
