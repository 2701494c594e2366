// Tone mapping: linear radiance to 8-bit sRGB.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstdint>
#include <span>
#include <vector>

#include "common/image.h"
#include "common/math.h"

namespace tessera {

enum class ToneCurve : std::uint8_t {
    srgb,    ///< clamp, then the sRGB transfer function (IEC 61966-2-1)
    filmic,  ///< shoulder for highlights first (Hable, "Uncharted 2: HDR Lighting", 2010)
};

struct ToneMap {
    ToneCurve curve = ToneCurve::srgb;
    float exposure = 0;  ///< stops: radiance is multiplied by 2^exposure

    bool operator==(const ToneMap&) const = default;
};

/// One channel of linear radiance to display-linear [0, 1], before the sRGB transfer function.
float apply_curve(const ToneMap& tone_map, float radiance);

/// The sRGB transfer function and its inverse over [0, 1].
float srgb_from_linear(float linear);
float linear_from_srgb(float srgb);

/// 255 * srgb_from_linear(apply_curve(radiance)), rounded, as a table: exact, and without a branch.
class ToneTable {
public:
    explicit ToneTable(const ToneMap& tone_map);

    /// Values that are not finite become black.
    std::uint8_t operator()(float radiance) const {
        const auto bits = std::bit_cast<std::uint32_t>(radiance);
        // Positive floats are ordered as their bits are; what else there is lies beyond infinity.
        const std::uint32_t above = bits < infinity ? std::max(bits, lowest_) - lowest_ : 0;
        const std::uint32_t within = std::min(above, cells * cell - 1);
        return std::uint8_t((cells_[within / cell] + within % cell) / cell);
    }

    /// The same for each of `radiance` times `scale`, by as many lanes as there are.
    void put(std::span<const float> radiance, float scale, std::uint8_t* out) const;

private:
    static constexpr std::uint32_t infinity = 0x7f800000;
    static constexpr std::uint32_t cell = 1 << 16;  ///< floats whose upper bits agree
    /// Twenty powers of two: from what is black to what is white, by either curve.
    static constexpr std::uint32_t cells = 20 * 128;
    std::uint32_t lowest_;  ///< bits of the first float in the first cell
    /// For each cell the byte of its first float times `cell`, and how much is carried into it from
    /// where in the cell the next byte begins. (By an exposure that makes white of the least floats
    /// bytes grow by more than one in a cell: then the next one stands for all.)
    std::array<std::uint32_t, cells> cells_;
};

/// 8-bit sRGB, three bytes per pixel, of a picture with at least three channels.
/// Values that are not finite become black.
std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map);

}  // namespace tessera
