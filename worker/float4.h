// Four floats side by side, for the one place where a single ray meets four triangles at once. The
// compilers' vector extension maps it to SSE, NEON or plain code.
#pragma once

#include <array>
#include <bit>
#include <cstdint>

namespace tessera {

using Float4 = float __attribute__((vector_size(16)));
using Mask4 = std::int32_t __attribute__((vector_size(16)));  ///< per lane: all bits, or none

inline Float4 min(Float4 a, Float4 b) { return a < b ? a : b; }
inline Float4 max(Float4 a, Float4 b) { return a > b ? a : b; }
inline Float4 abs(Float4 a) { return Float4(Mask4(a) & 0x7fffffff); }

inline bool all(Mask4 mask) {
    const auto halves = std::bit_cast<std::array<std::uint64_t, 2>>(mask);
    return (halves[0] & halves[1]) == ~std::uint64_t(0);
}

}  // namespace tessera
