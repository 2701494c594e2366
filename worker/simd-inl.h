// A vector of floats as wide as the target has them, in the words of this renderer. Included once
// for each target.
#if defined(TESSERA_SIMD_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_SIMD_INL_H
#undef TESSERA_SIMD_INL_H
#else
#define TESSERA_SIMD_INL_H
#endif

#include <array>
#include <bit>
#include <cstdint>

#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

constexpr hn::ScalableTag<float> lanes_tag;
constexpr int W = int(hn::MaxLanes(lanes_tag));
using Float = hn::Vec<decltype(lanes_tag)>;
using Mask = hn::Mask<decltype(lanes_tag)>;
using Bits = std::uint32_t;  ///< a mask, lane i in bit i
constexpr Bits all_lanes = (Bits(1) << W) - 1;

HWY_INLINE Float splat(float x) { return hn::Set(lanes_tag, x); }
HWY_INLINE Float load(const float* p) { return hn::Load(lanes_tag, p); }
HWY_INLINE void store(Float x, float* p) { hn::Store(x, lanes_tag, p); }

HWY_INLINE Bits bits(Mask mask) {
#if HWY_TARGET == HWY_AVX3
    return mask.raw;  // what the loop over bytes would come to
#else
    std::uint8_t bytes[8] = {};
    hn::StoreMaskBits(lanes_tag, mask, bytes);
    return bytes[0];
#endif
}

HWY_INLINE Mask mask_of(Bits set) {
    const std::uint8_t bytes[8] = {std::uint8_t(set), std::uint8_t(set >> 8)};
    return hn::LoadMaskBits(lanes_tag, bytes);
}

/// Calls `f` with the index of each bit that is set, from the lowest.
template <class F>
HWY_INLINE void for_each_bit(Bits set, F&& f) {
    for (; set; set &= set - 1) f(std::countr_zero(set));
}

/// For each mask of up to eight lanes the lanes that are set, the lowest first, in four bits each.
constexpr auto lanes_of_masks = [] {
    std::array<std::uint32_t, 256> table{};
    for (Bits mask = 0; mask < table.size(); ++mask)
        for (int lane = 0, count = 0; lane < 8; ++lane)
            if (mask >> lane & 1) table[mask] |= std::uint32_t(lane) << 4 * count++;
    return table;
}();

/// The lanes of the mask, moved together; what lies behind them is left open.
HWY_INLINE Float compress(Float x, Mask mask) {
    if constexpr (W > 8) {
        return hn::Compress(x, mask);
    } else {
        // gcc 12 copies the whole table of Highway's Compress to the stack for each call.
        const hn::RebindToSigned<decltype(lanes_tag)> index_tag;
        const auto packed = hn::Set(index_tag, std::int32_t(lanes_of_masks[bits(mask)]));
        const auto lanes = packed >> hn::ShiftLeft<2>(hn::Iota(index_tag, 0));
        return hn::TableLookupLanes(
            x, hn::IndicesFromVec(lanes_tag, hn::And(lanes, hn::Set(index_tag, W - 1))));
    }
}

/// The greater and the lesser one; `b` where `a` is not a number.
HWY_INLINE Float max_or_second(Float a, Float b) {
#if HWY_ARCH_X86
    return hn::Max(a, b);  // what its instruction does
#else
    return hn::IfThenElse(a > b, a, b);
#endif
}
HWY_INLINE Float min_or_second(Float a, Float b) {
#if HWY_ARCH_X86
    return hn::Min(a, b);
#else
    return hn::IfThenElse(a < b, a, b);
#endif
}

HWY_INLINE void prefetch(const void* at, std::size_t bytes) {
    for (std::size_t i = 0; i < bytes; i += 64) hwy::Prefetch(static_cast<const char*>(at) + i);
}

/// Right to 2^-21 and better.
HWY_INLINE Float reciprocal(Float x) {
    const Float r = hn::ApproximateReciprocal(x);
    return r * hn::NegMulAdd(x, r, splat(2));
}

HWY_INLINE Float min3(Float a, Float b, Float c) { return hn::Min(a, hn::Min(b, c)); }
HWY_INLINE Float max3(Float a, Float b, Float c) { return hn::Max(a, hn::Max(b, c)); }

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
