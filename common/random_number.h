// Chance for generated scenes: numbers by index, the same bits everywhere.
#pragma once

#include <cstdint>

namespace tessera {

/// A number in [0, 1) for each index (a hash of Wellons' "lowbias32").
inline float random_unit(std::uint32_t index) {
    index ^= index >> 16;
    index *= 0x7feb352du;
    index ^= index >> 15;
    index *= 0x846ca68bu;
    index ^= index >> 16;
    return float(index >> 8) * 0x1p-24f;
}

inline float random_between(std::uint32_t index, float lo, float hi) {
    return lo + (hi - lo) * random_unit(index);
}

}  // namespace tessera
