// Messages <-> frames: where Protocol Buffers become values and back. Pure; fuzzed.
// Law: decode(encode(m)) == m for every message that respects the limits below.
#pragma once

#include <cstdint>
#include <memory>
#include <span>

#include "common/framing.h"
#include "common/messages.h"

namespace tessera {

/// Largest picture side in pixels.
inline constexpr int max_image_side = 16384;
/// Largest picture in pixels: 8192 x 8192, about 4 GB of float channels on the server.
inline constexpr std::uint64_t max_image_pixels = std::uint64_t(1) << 26;
/// More tiles than a picture of that size can have.
inline constexpr std::uint32_t max_tiles = 1u << 20;
/// More tiles than travel in one message.
inline constexpr std::size_t max_tiles_together = 4096;
inline constexpr std::uint32_t max_passes = 1u << 24;
inline constexpr std::uint32_t max_vpls = 1u << 16;
inline constexpr std::uint32_t max_interleave = 64;
/// A JPEG file takes at most this much more than the bytes of its picture.
inline constexpr std::uint64_t max_jpeg_overhead = 64 << 10;
/// Longest name, token or build text of a peer in bytes.
inline constexpr std::size_t max_name_bytes = 256;

/// A message ready for the wire: frame header and Protocol Buffers bytes, then the payload, which
/// is shared with the message and not copied.
struct EncodedMessage {
    Bytes head;
    Payload payload;

    std::size_t size() const { return head.size() + payload.bytes.size(); }
};

/// Throws UserError when the message is larger than max_message_bytes (a scene too large to send).
EncodedMessage encode(Message message);

/// Throws ProtocolError, naming the message and the field, for everything malformed or out of
/// range: the caller can rely on every limit above, on finite numbers and on known enumerators.
/// Does not check what only a scene or a frame can tell (indices of deltas, tiles of a frame).
Message decode(const FrameHeader& header, std::span<const std::byte> message, Payload payload);

}  // namespace tessera
