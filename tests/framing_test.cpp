// Laws of frame headers: decoding inverts encoding, and whatever else decodes is in its limits.

#include "common/framing.h"

#include <gtest/gtest.h>

#include <random>

#include "common/messages.h"

namespace tessera {
namespace {

TEST(Framing, decoding_inverts_encoding) {
    std::mt19937 random(1);
    for (int i = 0; i < 1000; ++i) {
        const FrameHeader header{
            .kind = std::uint16_t(random()),
            .message_bytes = std::uint32_t(random() % (max_message_bytes + 1)),
            .payload_bytes = std::uint32_t(random() % (max_payload_bytes + 1))};
        EXPECT_EQ(decode_header(encode(header), {}), header);
    }
}

TEST(Framing, layout_is_the_documented_one) {
    const auto bytes = encode(FrameHeader{.kind = 0x0201, .message_bytes = 3, .payload_bytes = 4});
    const std::array<int, frame_header_bytes> expected{'T', 'S', 'R', '1', 1, 2, 0, 0,
                                                       3,   0,   0,   0,   4, 0, 0, 0};
    for (std::size_t i = 0; i < bytes.size(); ++i) EXPECT_EQ(int(bytes[i]), expected[i]) << i;
}

TEST(Framing, other_protocols_and_reserved_bits_are_refused) {
    const auto good = encode(FrameHeader{.kind = 1, .message_bytes = 2, .payload_bytes = 3});
    for (const std::size_t i : {0, 1, 2, 3, 6, 7})
        for (int bit = 0; bit < 8; ++bit) {
            auto bad = good;
            bad[i] ^= std::byte(1 << bit);
            EXPECT_THROW(decode_header(bad, {}), ProtocolError) << "byte " << i << " bit " << bit;
        }
}

TEST(Framing, limits_are_inclusive) {
    const FrameLimits limits{.message_bytes = 100, .payload_bytes = 10};
    const auto header = [](std::uint32_t message, std::uint32_t payload) {
        return encode(FrameHeader{.kind = 1, .message_bytes = message, .payload_bytes = payload});
    };
    EXPECT_NO_THROW(decode_header(header(100, 10), limits));
    EXPECT_THROW(decode_header(header(101, 10), limits), ProtocolError);
    EXPECT_THROW(decode_header(header(100, 11), limits), ProtocolError);
    EXPECT_THROW(decode_header(header(0xffffffff, 0), limits), ProtocolError);
    EXPECT_THROW(decode_header(header(0, 0xffffffff), {}), ProtocolError);
}

}  // namespace
}  // namespace tessera
