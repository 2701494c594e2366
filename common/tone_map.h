// Tone mapping: linear radiance to 8-bit sRGB.
#pragma once

#include <cstdint>
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

/// 8-bit sRGB, three bytes per pixel, of a picture with at least three channels.
/// Values that are not finite become black.
std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map);

}  // namespace tessera
