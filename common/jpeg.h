// JPEG files in memory (libjpeg-turbo): how pictures travel while they change.
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "common/blob.h"
#include "common/image.h"

namespace tessera {

/// `rgb`: three bytes per pixel. Colours keep the full resolution; quality of 100.
Bytes encode_jpeg(std::span<const std::uint8_t> rgb, ImageSize size, int quality);

/// The picture as three bytes per pixel. Throws std::runtime_error when `file` is no JPEG of that
/// size.
std::vector<std::uint8_t> decode_jpeg(std::span<const std::byte> file, ImageSize size);

}  // namespace tessera
