// A frame header of any bytes is refused, or respects the limits and encodes to the same bytes.

#include <algorithm>
#include <cstdint>
#include <span>

#include "common/check.h"
#include "common/framing.h"
#include "common/messages.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    using namespace tessera;
    if (size < frame_header_bytes) return 0;
    const auto bytes = std::as_bytes(std::span(data, size)).first<frame_header_bytes>();
    try {
        const FrameHeader header = decode_header(bytes, {});
        CHECK(header.message_bytes <= max_message_bytes);
        CHECK(header.payload_bytes <= max_payload_bytes);
        CHECK(std::ranges::equal(encode(header), bytes));
    } catch (const ProtocolError&) {
    }
    return 0;
}
