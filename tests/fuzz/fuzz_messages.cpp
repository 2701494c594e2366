// The body of any frame is refused, or is a message that comes back the same from another trip.
// What is refused for the wrong reason (an allocation, an assertion) ends the process.
//
// Input: 1 byte kind, 2 bytes length of the payload, then message and payload. The frame header is
// made from them, so that the fuzzer need not guess lengths that agree.

#include <algorithm>
#include <cstdint>
#include <span>

#include "common/check.h"
#include "tests/random_message.h"

namespace {

using namespace tessera;

constexpr std::size_t prefix_bytes = 3;

Message decode_input(std::span<const std::byte> input) {
    const auto body = input.subspan(prefix_bytes);
    const std::size_t wanted = std::size_t(input[1]) | std::size_t(input[2]) << 8;
    const std::size_t payload = std::min(wanted, body.size());
    const FrameHeader header{.kind = std::uint16_t(input[0]),
                             .message_bytes = std::uint32_t(body.size() - payload),
                             .payload_bytes = std::uint32_t(payload)};
    const auto head = encode(header);
    Bytes frame(head.begin(), head.end());
    frame.insert(frame.end(), body.begin(), body.end());
    return decode_frame(frame);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    if (size < prefix_bytes) return 0;
    try {
        const Bytes encoded = flattened(encode(decode_input(std::as_bytes(std::span(data, size)))));
        // By bytes, because messages may hold NaNs, which equal nothing.
        CHECK(flattened(encode(decode_frame(encoded))) == encoded);
    } catch (const ProtocolError&) {
    }
    return 0;
}
