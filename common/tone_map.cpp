#include "common/tone_map.h"

#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "common/tone_map.cpp"
#include "hwy/foreach_target.h"
// foreach_target.h comes first.
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

/// ToneTable's operator() for whole batches of values; returns how many these are. The lanes do all
/// but the look-up: to gather is no faster than to load one by one, and slower on many machines.
std::size_t put_batches(std::span<const std::uint32_t> table, std::uint32_t first,
                        std::span<const float> radiance, float scale, std::uint8_t* out) {
    constexpr std::size_t batch = 64;
    constexpr int cell_bits = 16;
    constexpr hn::CappedTag<float, 16> floats;
    constexpr hn::RebindToSigned<decltype(floats)> ints;
    constexpr hn::RebindToUnsigned<decltype(floats)> words;
    constexpr hn::Rebind<std::uint8_t, decltype(floats)> bytes;
    const std::size_t lanes = hn::Lanes(floats);
    const auto lowest = hn::Set(ints, std::int32_t(first));
    const auto highest = hn::Set(ints, std::int32_t((table.size() << cell_bits) - 1));
    const auto infinite = hn::Set(ints, 0x7f800000);
    const auto lower_bits = hn::Set(words, (1u << cell_bits) - 1);
    const auto scales = hn::Set(floats, scale);
    HWY_ALIGN std::uint32_t cells[batch], within[batch];
    const std::size_t count = radiance.size() / batch * batch;
    for (std::size_t begin = 0; begin < count; begin += batch) {
        for (std::size_t i = 0; i < batch; i += lanes) {
            // Negative ones are negative integers, too.
            const auto bits = hn::BitCast(ints, hn::LoadU(floats, &radiance[begin + i]) * scales);
            const auto above = hn::IfThenElseZero(bits < infinite, hn::Max(bits, lowest) - lowest);
            const auto cell = hn::BitCast(words, hn::Min(above, highest));
            hn::Store(hn::ShiftRight<cell_bits>(cell), words, cells + i);
            hn::Store(hn::And(cell, lower_bits), words, within + i);
        }
        for (std::uint32_t& cell : cells) cell = table[cell];
        for (std::size_t i = 0; i < batch; i += lanes) {
            const auto sum = hn::Load(words, cells + i) + hn::Load(words, within + i);
            hn::StoreU(hn::TruncateTo(bytes, hn::ShiftRight<cell_bits>(sum)), bytes,
                       out + begin + i);
        }
    }
    return count;
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE

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

HWY_EXPORT(put_batches);

void ToneTable::put(std::span<const float> radiance, float scale, std::uint8_t* out) const {
    const std::size_t done =
        HWY_DYNAMIC_DISPATCH(put_batches)(cells_, lowest_, radiance, scale, out);
    for (std::size_t i = done; i < radiance.size(); ++i) out[i] = (*this)(radiance[i] * scale);
}

std::vector<std::uint8_t> to_srgb8(const Image& image, const ToneMap& tone_map) {
    const ToneTable table(tone_map);
    std::vector<std::uint8_t> out(image.size.pixels() * 3);
    if (image.channels == 3) {
        table.put(image.data, 1, out.data());
        return out;
    }
    const std::size_t channels = std::size_t(image.channels);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (std::size_t c = 0; c < 3; ++c) out[3 * p + c] = table(image.data[p * channels + c]);
    return out;
}

}  // namespace tessera
#endif
