// Bodies of messages of one kind, for fuzzers of what is done with them.
#pragma once

#include <algorithm>

#include "tests/random_message.h"

namespace tessera {

// As proto/protocol.proto numbers them.
inline constexpr std::uint16_t kind_scene_update = 4, kind_tile_results = 17, kind_scene_edit = 25;

/// The message of that kind with this body, and payload. Throws ProtocolError.
inline Message decode_body(std::uint16_t kind, std::span<const std::byte> body,
                           std::span<const std::byte> payload = {}) {
    const auto head = encode(FrameHeader{.kind = kind,
                                         .message_bytes = std::uint32_t(body.size()),
                                         .payload_bytes = std::uint32_t(payload.size())});
    Bytes frame(head.begin(), head.end());
    frame.insert(frame.end(), body.begin(), body.end());
    frame.insert(frame.end(), payload.begin(), payload.end());
    return decode_frame(frame);
}

}  // namespace tessera
