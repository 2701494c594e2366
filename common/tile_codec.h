// A tile's pixels as they travel: the same bits in fewer bytes. Most of a tile shows one surface,
// or a few, so that whole channels hold one value or a handful: such a channel becomes a palette
// and a few bits per pixel. What differs from pixel to pixel is noise in the lower bits of floats,
// which no coding that must keep them shrinks for less time than a network takes; it stays as it
// is. Pure; fuzzed.
//
// Channels follow each other in the order of enum Channel, nothing between them:
//
//   bytes  little-endian
//   1      bits per pixel: 0, 1, 2 or 4 of an index into the palette, or 32: no palette
//   ...    the palette: 2^bits entries, each the floats of a pixel
//   ...    the indices, pixel by pixel from the lowest bits on; the last byte is filled up
//   ...    without a palette, instead of both: the floats of every pixel
#pragma once

#include <span>

#include "common/blob.h"
#include "common/tile.h"

namespace tessera {

/// `data` as in TileResult, of `pixels` pixels.
Bytes pack_tile(ChannelSet channels, std::size_t pixels, std::span<const float> data);

/// Whether the bytes are a tile of that size with these channels. Every index then is one of its
/// palette.
bool is_packed_tile(ChannelSet channels, std::size_t pixels, std::span<const std::byte> packed);

enum class Unpacked : std::uint8_t {
    same_bits,
    radiance_is_a_sum,  ///< of this tile alone: 0 + radiance, and 0 where it is not finite
};

/// Puts a packed tile into its place `rect` of `planes`, the same channels of a whole picture. Our
/// bug if it is no such tile. Goes past the caches where the planes are larger: call
/// finish_unpacking() before another thread reads them.
void unpack_tile(ChannelSet channels, std::span<const std::byte> packed, const Rect& rect,
                 ImageSize picture, std::span<float> planes, Unpacked how = Unpacked::same_bits);
void finish_unpacking();

}  // namespace tessera
