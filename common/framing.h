// Bytes <-> length-prefixed frames. A frame is a fixed header, a Protocol Buffers message and an
// optional raw payload. Limits are checked from the header, before anything is allocated. Pure;
// fuzzed.
//
//   offset  bytes  little-endian
//   0       4      magic "TSR1"
//   4       2      kind: number of the message in protocol.proto's enum Kind
//   6       2      reserved, zero
//   8       4      length of the message in bytes
//   12      4      length of the payload in bytes
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

namespace tessera {

inline constexpr std::uint32_t frame_magic = 0x31525354;  // "TSR1"
inline constexpr std::size_t frame_header_bytes = 16;
/// Largest message: a scene delta of a million instances.
inline constexpr std::uint32_t max_message_bytes = 256u << 20;
/// Largest message before the handshake is done: strangers get no memory.
inline constexpr std::uint32_t max_hello_bytes = 64u << 10;
/// Largest payload: bulk data goes in chunks of chunk_bytes, a 16x16 tile with all channels is 24
/// KiB.
inline constexpr std::uint32_t max_payload_bytes = 4u << 20;
/// Chunk of bulk data: 2 ms of a Gigabit link, so that a control message never waits longer.
inline constexpr std::uint32_t chunk_bytes = 256u << 10;

struct FrameHeader {
    std::uint16_t kind = 0;
    std::uint32_t message_bytes = 0;
    std::uint32_t payload_bytes = 0;

    bool operator==(const FrameHeader&) const = default;
};

std::array<std::byte, frame_header_bytes> encode(const FrameHeader& header);

struct FrameLimits {
    std::uint32_t message_bytes = max_message_bytes;
    std::uint32_t payload_bytes = max_payload_bytes;
    const char* option = nullptr;  ///< by which an operator raises message_bytes, if he can
};

/// Throws ProtocolError when the magic is wrong, reserved bits are set or a limit is exceeded.
FrameHeader decode_header(std::span<const std::byte, frame_header_bytes> bytes,
                          const FrameLimits& limits);

}  // namespace tessera
