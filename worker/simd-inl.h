// A vector of floats as wide as the target has them, in the words of this renderer. Included once
// for each target.
#if defined(TESSERA_SIMD_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_SIMD_INL_H
#undef TESSERA_SIMD_INL_H
#else
#define TESSERA_SIMD_INL_H
#endif

#include <bit>

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
