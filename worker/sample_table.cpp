// What sampling.h says of one number, said of a vector of them. All is integers but for the last,
// exact conversion, so every instruction set gives the same bits.
#include "worker/sample_table.h"

#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)
// See kernels.cpp.
#define HWY_BROKEN_EMU128 0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "worker/sample_table.cpp"
#include "hwy/foreach_target.h"
// foreach_target.h comes first.
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;

constexpr hn::ScalableTag<std::uint32_t> tag;
using Word = hn::Vec<decltype(tag)>;

HWY_INLINE Word splat(std::uint32_t x) { return hn::Set(tag, x); }

/// Swaps neighbouring groups of `size` bits, of which `low` holds every other.
template <int size>
HWY_INLINE Word swap_bits(Word x, std::uint32_t low) {
    return (hn::ShiftLeft<size>(x & splat(low)) | (hn::ShiftRight<size>(x) & splat(low)));
}

HWY_INLINE Word reverse_lanes(Word x) {
    x = swap_bits<1>(x, 0x55555555);
    x = swap_bits<2>(x, 0x33333333);
    x = swap_bits<4>(x, 0x0f0f0f0f);
    x = swap_bits<8>(x, 0x00ff00ff);
    return swap_bits<16>(x, 0x0000ffff);
}

HWY_INLINE Word scramble_lanes(Word x, std::uint32_t seed) {
    x = (x ^ (x * splat(0x3d20adea))) + splat(seed);
    x = x * splat((seed >> 16) | 1);
    x = x ^ (x * splat(0x05526c56));
    return x ^ (x * splat(0x53a22864));
}

HWY_INLINE Word sobol_1_lanes(Word x) {
    x = x ^ hn::ShiftRight<16>(x);
    x = x ^ hn::ShiftRight<8>(x & splat(0xff00ff00));
    x = x ^ hn::ShiftRight<4>(x & splat(0xf0f0f0f0));
    x = x ^ hn::ShiftRight<2>(x & splat(0xcccccccc));
    return x ^ hn::ShiftRight<1>(x & splat(0xaaaaaaaa));
}

HWY_INLINE auto unit_lanes(Word reversed, std::uint32_t shift) {
    constexpr hn::RebindToSigned<decltype(tag)> ints;
    constexpr hn::RebindToFloat<decltype(tag)> floats;
    const Word bits = hn::ShiftRight<8>(reverse_lanes(reversed) ^ splat(shift));
    return hn::ConvertTo(floats, hn::BitCast(ints, bits)) * hn::Set(floats, 0x1p-24f);
}

/// Fills points[i * pairs + pair]; behind its `count` indices there is room for a whole vector.
void make_points(const std::uint32_t* indices, std::size_t count, std::uint32_t seed,
                 std::uint32_t round, std::uint32_t pairs, vec2* points) {
    constexpr hn::RebindToFloat<decltype(tag)> floats;
    static_assert(hn::MaxLanes(tag) <= SampleTable::most_lanes);
    const std::size_t lanes = hn::Lanes(tag);
    for (std::uint32_t pair = 0; pair < pairs; ++pair) {
        const std::uint32_t s = hash(seed, pair);
        const SobolBits shift = digital_shift(round, s);
        const std::uint32_t seed_x = hash(s ^ 0x68bc21eb), seed_y = hash(s ^ 0x02e5be93);
        for (std::size_t i = 0; i < count; i += lanes) {
            const Word index = hn::LoadU(tag, indices + i);
            const Word shuffled = reverse_lanes(scramble_lanes(reverse_lanes(index), s));
            HWY_ALIGN float xs[hn::MaxLanes(tag)], ys[hn::MaxLanes(tag)];
            hn::Store(unit_lanes(scramble_lanes(shuffled, seed_x), shift.x), floats, xs);
            hn::Store(unit_lanes(scramble_lanes(sobol_1_lanes(shuffled), seed_y), shift.y), floats,
                      ys);
            for (std::size_t lane = 0; lane < std::min(lanes, count - i); ++lane)
                points[(i + lane) * pairs + pair] = {xs[lane], ys[lane]};
        }
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace tessera {

HWY_EXPORT(make_points);

SampleTable::SampleTable(std::vector<std::uint32_t> indices, std::uint32_t seed,
                         std::uint32_t round, std::uint32_t pairs)
    : indices_(std::move(indices)),
      seed_(seed),
      round_(round),
      pairs_(pairs),
      points_(indices_.size() * pairs) {
    const std::size_t count = indices_.size();
    indices_.resize(count + most_lanes);
    HWY_DYNAMIC_DISPATCH(make_points)(indices_.data(), count, seed, round, pairs, points_.data());
}

}  // namespace tessera
#endif
