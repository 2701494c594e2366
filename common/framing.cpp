#include "common/framing.h"

#include <fmt/format.h>

#include <bit>
#include <cstring>

#include "common/messages.h"

namespace tessera {
namespace {

static_assert(std::endian::native == std::endian::little, "frame headers are little-endian");

template <class T>
void put(std::span<std::byte> bytes, std::size_t offset, T value) {
    std::memcpy(bytes.subspan(offset, sizeof value).data(), &value, sizeof value);
}

template <class T>
T get(std::span<const std::byte> bytes, std::size_t offset) {
    T value;
    std::memcpy(&value, bytes.subspan(offset, sizeof value).data(), sizeof value);
    return value;
}

void require_at_most(const char* what, std::uint32_t bytes, std::uint32_t limit,
                     const char* option = nullptr) {
    if (bytes > limit)
        throw ProtocolError(fmt::format("sends a {} of {} bytes, at most {} allowed{}{}", what,
                                        bytes, limit, option ? " by " : "", option ? option : ""));
}

}  // namespace

std::array<std::byte, frame_header_bytes> encode(const FrameHeader& header) {
    std::array<std::byte, frame_header_bytes> bytes{};
    put(bytes, 0, frame_magic);
    put(bytes, 4, header.kind);
    put(bytes, 8, header.message_bytes);
    put(bytes, 12, header.payload_bytes);
    return bytes;
}

FrameHeader decode_header(std::span<const std::byte, frame_header_bytes> bytes,
                          const FrameLimits& limits) {
    if (get<std::uint32_t>(bytes, 0) != frame_magic)
        throw ProtocolError("does not speak this protocol (no frame starts where one should)");
    if (get<std::uint16_t>(bytes, 6) != 0)
        throw ProtocolError("reserved bytes of a frame header are set");
    const FrameHeader header{.kind = get<std::uint16_t>(bytes, 4),
                             .message_bytes = get<std::uint32_t>(bytes, 8),
                             .payload_bytes = get<std::uint32_t>(bytes, 12)};
    require_at_most("message", header.message_bytes, limits.message_bytes, limits.option);
    require_at_most("payload", header.payload_bytes, limits.payload_bytes);
    return header;
}

}  // namespace tessera
