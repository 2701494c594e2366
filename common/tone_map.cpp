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

}  // namespace

float apply_curve(const ToneMap& tone_map, float radiance) {
    constexpr float white = 11.2f;  // Hable's linear white point
    constexpr float beyond = 1e6f;  // white for long, and its square is still a float
    const float exposed = std::max(0.0f, radiance) * std::exp2(tone_map.exposure);
    if (!std::isfinite(exposed)) return 0;
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

/// quantised() as a table. Positive floats are ordered as their bits are, so each of the 256 values
/// begins at some bits; a first guess comes from the upper ones.
class ToneTable {
public:
    explicit ToneTable(const ToneMap& tone_map) {
        for (int value = 1; value < 256; ++value)
            begin_[std::size_t(value)] = first_of(tone_map, value, begin_[std::size_t(value) - 1]);
        begin_.back() = ~0u;
        std::size_t value = 0;
        for (std::size_t upper = 0; upper < guess_.size(); ++upper) {
            while (begin_[value + 1] <= upper << shift) ++value;
            guess_[upper] = std::uint8_t(value);
        }
    }

    std::uint8_t operator()(float radiance) const {
        const auto bits = std::bit_cast<std::uint32_t>(radiance);
        if (bits >= infinity) return 0;  // negative, infinite or not a number
        std::size_t value = guess_[bits >> shift];
        // Without a branch, which could not be predicted; one step is enough nearly always.
        value += begin_[value + 1] <= bits;
        while (begin_[value + 1] <= bits) ++value;
        return std::uint8_t(value);
    }

private:
    static constexpr int shift = 16;
    static constexpr std::uint32_t infinity = 0x7f800000;

    /// The least bits from `from` on whose value is at least `value`.
    static std::uint32_t first_of(const ToneMap& tone_map, int value, std::uint32_t from) {
        std::uint32_t low = from, high = infinity;
        while (low < high) {
            const std::uint32_t middle = low + (high - low) / 2;
            if (quantised(tone_map, std::bit_cast<float>(middle)) >= value)
                high = middle;
            else
                low = middle + 1;
        }
        return low;
    }

    /// 0 for value 0, infinity for those that no float has; then a guard.
    std::array<std::uint32_t, 257> begin_{};
    std::array<std::uint8_t, (infinity >> shift) + 1> guess_{};
};

}  // namespace

std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map) {
    const ToneTable table(tone_map);
    std::vector<std::uint8_t> out(image.size.pixels() * 3);
    const std::size_t channels = std::size_t(image.channels);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (std::size_t c = 0; c < 3; ++c) out[3 * p + c] = table(image.data[p * channels + c]);
    return out;
}

}  // namespace tessera
