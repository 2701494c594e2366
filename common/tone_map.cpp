#include "common/tone_map.h"

#include <array>
#include <bit>
#include <cmath>

namespace tessera {
namespace {

/// Hable's curve with his published constants, before normalisation by its value at white.
float hable(float x) {
    constexpr float a = 0.15f, b = 0.50f, c = 0.10f, d = 0.20f, e = 0.02f, f = 0.30f;
    return (x * (a * x + c * b) + d * e) / (x * (a * x + b) + d * f) - e / f;
}

/// `radiance` times 2^exposure on the curve.
float on_curve(ToneCurve curve, float exposed) {
    constexpr float white = 11.2f;  // Hable's linear white point
    if (!std::isfinite(exposed)) return 0;
    const float mapped = curve == ToneCurve::filmic ? hable(2 * exposed) / hable(white) : exposed;
    return std::min(mapped, 1.0f);
}

std::uint8_t srgb_byte(float linear) { return std::uint8_t(255 * srgb_from_linear(linear) + 0.5f); }

/// srgb_byte() by table: tone mapping is between a viewer and its picture.
class SrgbBytes {
public:
    SrgbBytes() {
        for (int byte = 1; byte < 256; ++byte) lowest_[std::size_t(byte)] = lowest(byte);
        lowest_[256] = infinity;
        for (int cell = 0; cell <= cells; ++cell)
            guess_[std::size_t(cell)] = srgb_byte(float(cell) / cells);
    }

    /// For 0 <= v <= 1.
    std::uint8_t operator()(float v) const {
        std::size_t byte = guess_[std::size_t(v * cells)];
        while (v >= lowest_[byte + 1]) ++byte;
        return std::uint8_t(byte);
    }

private:
    static constexpr int cells = 4096;  // of less than a byte each

    /// The least value that becomes this byte or more.
    static float lowest(int byte) {
        std::uint32_t below = 0, found = std::bit_cast<std::uint32_t>(1.0f);
        while (found - below > 1) {
            const std::uint32_t middle = (below + found) / 2;
            (srgb_byte(std::bit_cast<float>(middle)) >= byte ? found : below) = middle;
        }
        return std::bit_cast<float>(found);
    }

    std::array<float, 257> lowest_{};
    std::array<std::uint8_t, cells + 1> guess_{};
};

}  // namespace

float apply_curve(const ToneMap& tone_map, float radiance) {
    return on_curve(tone_map.curve, std::max(0.0f, radiance) * std::exp2(tone_map.exposure));
}

float srgb_from_linear(float linear) {
    return linear <= 0.0031308f ? 12.92f * linear : 1.055f * std::pow(linear, 1 / 2.4f) - 0.055f;
}

float linear_from_srgb(float srgb) {
    return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f);
}

std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map) {
    const SrgbBytes bytes;
    const float exposure = std::exp2(tone_map.exposure);
    std::vector<std::uint8_t> out(image.size.pixels() * 3);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (std::size_t c = 0; c < 3; ++c) {
            const float radiance = image.data[p * std::size_t(image.channels) + c];
            out[3 * p + c] = bytes(on_curve(tone_map.curve, std::max(0.0f, radiance) * exposure));
        }
    return out;
}

}  // namespace tessera
