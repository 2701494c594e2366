// Laws of the message codec: decode(encode(m)) == m for every kind; no damage done to a frame does
// more than a ProtocolError; what decodes respects the limits.

#include "common/messages.h"

#include <gtest/gtest.h>

#include <functional>
#include <limits>

#include "common/check.h"
#include "common/message_codec.h"
#include "tests/random_message.h"

namespace tessera {
namespace {

void expect_equal(const Message& a, const Message& b) {
    EXPECT_TRUE(a.body == b.body);
    EXPECT_TRUE(std::ranges::equal(a.payload.bytes, b.payload.bytes));
}

std::uint16_t kind_of(const Message& message) {
    const Bytes bytes = flattened(encode(message));
    return decode_header(std::span(bytes).first<frame_header_bytes>(), {}).kind;
}

TEST(Messages, decoding_inverts_encoding_for_every_kind) {
    RandomMessage random(1);
    for (int round = 0; round < 200; ++round)
        for (std::size_t kind = 0; kind < RandomMessage::kinds; ++kind) {
            SCOPED_TRACE(kind);
            const Message message = random.make(kind);
            expect_equal(decode_frame(flattened(encode(message))), message);
        }
}

TEST(Messages, kinds_have_the_published_numbers) {
    RandomMessage random(2);
    for (std::size_t kind = 0; kind < RandomMessage::kinds; ++kind)
        EXPECT_EQ(kind_of(random.make(kind)), kind + 1);
    EXPECT_EQ(kind_of({Hello{}, {}}), 1);
    EXPECT_EQ(kind_of({BlobChunk{}, {}}), 6);
    EXPECT_EQ(kind_of({TileTasks{}, {}}), 16);
    EXPECT_EQ(kind_of({TileResults{}, {}}), 17);
    EXPECT_EQ(kind_of({Pong{}, {}}), 22);
    EXPECT_EQ(kind_of({EditResult{}, {}}), 26);
    EXPECT_EQ(kind_of({Leave{}, {}}), 30);
    EXPECT_EQ(kind_of({SumsChunk{}, {}}), 32);
}

TEST(Messages, every_truncation_is_refused) {
    RandomMessage random(3);
    for (std::size_t kind = 0; kind < RandomMessage::kinds; ++kind) {
        const Bytes whole = flattened(encode(random.make(kind)));
        for (std::size_t size = 0; size < whole.size(); ++size)
            EXPECT_THROW(decode_frame(std::span(whole).first(size)), ProtocolError);
    }
}

/// As `decode_frame`, for bytes that may be anything.
std::optional<Message> try_decode(const Bytes& bytes) {
    try {
        return decode_frame(bytes);
    } catch (const ProtocolError&) {
        return std::nullopt;
    }
}

TEST(Messages, truncated_bodies_are_refused_or_valid) {
    RandomMessage random(4);
    for (std::size_t kind = 0; kind < RandomMessage::kinds; ++kind) {
        const EncodedMessage whole = encode(random.make(kind));
        const auto body = std::span(whole.head).subspan(frame_header_bytes);
        for (std::size_t size = 0; size < body.size(); ++size) {
            const FrameHeader header{.kind = std::uint16_t(kind + 1),
                                     .message_bytes = std::uint32_t(size)};
            const auto head = encode(header);
            Bytes frame(head.begin(), head.end());
            frame.insert(frame.end(), body.begin(), body.begin() + std::ptrdiff_t(size));
            if (const auto message = try_decode(frame))
                expect_equal(decode_frame(flattened(encode(*message))), *message);
        }
    }
}

TEST(Messages, damaged_bits_are_refused_or_valid) {
    RandomMessage random(5);
    std::mt19937 damage(6);
    int accepted = 0;
    for (int round = 0; round < 2000; ++round) {
        Bytes frame = flattened(encode(random.make(damage() % RandomMessage::kinds)));
        for (unsigned flips = 1 + damage() % 4; flips > 0; --flips)
            frame[damage() % frame.size()] ^= std::byte(1u << damage() % 8);
        const auto message = try_decode(frame);
        if (!message) continue;
        ++accepted;
        EXPECT_NO_THROW(decode_frame(flattened(encode(*message))));
    }
    EXPECT_GT(accepted, 0);
}

TEST(Messages, noise_of_any_kind_is_refused_or_valid) {
    std::mt19937 random(7);
    for (int round = 0; round < 20000; ++round) {
        Bytes noise(random() % 64);
        for (std::byte& b : noise) b = std::byte(random());
        const FrameHeader header{.kind = std::uint16_t(random() % 32),
                                 .message_bytes = std::uint32_t(noise.size())};
        const auto head = encode(header);
        noise.insert(noise.begin(), head.begin(), head.end());
        try_decode(noise);
    }
}

/// A good message of type T spoilt by `spoil` is refused.
template <class T>
void expect_refused(const std::function<void(T&)>& spoil) {
    RandomMessage random(8);
    std::size_t kind = 0;
    Message message = random.make(kind);
    while (!message.get<T>()) message = random.make(++kind);
    ASSERT_NO_THROW(decode_frame(flattened(encode(message))));
    spoil(std::get<T>(message.body));
    EXPECT_THROW(decode_frame(flattened(encode(message))), ProtocolError);
}

TEST(Messages, pictures_out_of_range_are_refused) {
    for (const ImageSize size : {ImageSize{0, 1}, {1, 0}, {-1, 5}, {16385, 1}, {16384, 4097}})
        expect_refused<FrameRequest>([&](FrameRequest& m) { m.spec.size = size; });
    for (const float fov : {0.0f, 180.0f, -5.0f, std::numeric_limits<float>::quiet_NaN()})
        expect_refused<FrameBegin>([&](FrameBegin& m) { m.spec.camera.fov_y = fov; });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.camera.eye.x = infinity; });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.camera.up.y = std::nanf(""); });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.settings.passes = 0; });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.settings.passes = max_passes + 1; });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.settings.interleave = 0; });
    expect_refused<FrameRequest>([](FrameRequest& m) { m.request = 0; });
    expect_refused<FrameRequest>([](FrameRequest& m) { m.time_limit = -1; });
    expect_refused<FrameRequest>([](FrameRequest& m) { m.error_limit = infinity; });
}

TEST(Messages, unknown_enumerators_are_refused) {
    expect_refused<Hello>([](Hello& m) { m.role = Role(2); });
    expect_refused<Hello>([](Hello& m) { m.role = Role(255); });
    expect_refused<FrameRequest>([](FrameRequest& m) { m.format = PictureFormat(7); });
    expect_refused<FrameBegin>([](FrameBegin& m) { m.spec.settings.tracer = TracerKind(2); });
    expect_refused<PictureChunk>([](PictureChunk& m) { m.channel = Channel(channel_count); });
}

TEST(Messages, tasks_and_chunks_out_of_range_are_refused) {
    for (const TileTask bad : {TileTask{.pass_count = 0}, TileTask{.pass_count = 0xffffffff},
                               TileTask{.tile = max_tiles}, TileTask{.first_pass = max_passes}}) {
        expect_refused<TileTasks>([&](TileTasks& m) { m.tasks.push_back(bad); });
        expect_refused<TileResults>([&](TileResults& m) { m.tiles.push_back({.task = bad}); });
    }
    expect_refused<TileTasks>([](TileTasks& m) { m.tasks.resize(max_tiles_together + 1); });
    expect_refused<TileResults>([](TileResults& m) { m.tiles.resize(max_tiles_together + 1); });
    expect_refused<TileResults>(
        [](TileResults& m) { m.tiles.push_back({.task = {}, .seconds = -infinity}); });
    expect_refused<TileResults>(
        [](TileResults& m) { m.tiles.push_back({.task = {}, .pixel_bytes = 1}); });
    expect_refused<TileResults>(
        [](TileResults& m) { m.tiles.push_back({.task = {}, .pixel_bytes = ~0u}); });
    for (const std::vector<LightEstimate>& bad :
         {std::vector<LightEstimate>{{2, 1}, {2, 1}}, std::vector<LightEstimate>{{2, NAN}}})
        expect_refused<TileResults>(
            [&](TileResults& m) { m.tiles.push_back({.task = {}, .lights = bad}); });
    expect_refused<BlobChunk>([](BlobChunk& m) { m.offset = m.total; });
    expect_refused<BlobChunk>([](BlobChunk& m) { m.offset = ~std::uint64_t(0); });
    expect_refused<PictureChunk>([](PictureChunk& m) { m.total += 1; });
    expect_refused<PictureChunk>([](PictureChunk& m) { m.offset = m.total; });
    expect_refused<SceneUpdate>(
        [](SceneUpdate& m) { m.delta.next_version = m.delta.base_version; });
    expect_refused<Hello>([](Hello& m) { m.name = "two\nlines"; });
    expect_refused<Hello>([](Hello& m) { m.token.assign(257, 'x'); });
}

TEST(Messages, moving_one_instance_costs_less_than_300_bytes) {
    SceneVersion before{.version = 1000000, .scene = {}};
    before.scene.instances.resize(100000, {.name = "a name of thirty-two characters!"});
    SceneVersion after = before;
    after.version += 1;
    after.scene.instances[70000].world_from_object[3] = {1, 2, 3, 1};
    EXPECT_LT(encode({SceneUpdate{"office.glb#1", diff(before, after)}, {}}).size(), 300u);
}

TEST(Messages, payloads_belong_to_their_kinds) {
    const auto bytes = std::make_shared<const Bytes>(8);
    EXPECT_THROW(decode_frame(flattened(encode({Ping{}, {bytes, *bytes}}))), ProtocolError);
    const FrameHeader odd{.kind = 17, .message_bytes = 0, .payload_bytes = 5};
    EXPECT_THROW(decode(odd, {}, {bytes, std::span(*bytes).first(5)}), ProtocolError);
    EXPECT_THROW(decode({.kind = 0}, {}, {}), ProtocolError);
    EXPECT_THROW(decode({.kind = RandomMessage::kinds + 1}, {}, {}), ProtocolError);
    EXPECT_THROW(decode({.kind = 33}, {}, {}), ProtocolError);
}

TEST(Messages, blobs_of_an_edit_fill_its_payload) {
    const auto arrives = [](std::vector<std::uint64_t> sizes, std::size_t payload) {
        const auto bytes = std::make_shared<Bytes>(payload);
        const EncodedMessage sent =
            encode({SceneEdit{1, "scene", {}, std::move(sizes)}, {bytes, *bytes}});
        const auto head = std::span(sent.head);
        const FrameHeader header = decode_header(head.first<frame_header_bytes>(), {});
        return decode(header, head.subspan(frame_header_bytes), sent.payload).payload.bytes.size();
    };
    EXPECT_EQ(arrives({}, 0), 0u);
    EXPECT_EQ(arrives({3, 0, 4}, 7), 7u);
    EXPECT_THROW(arrives({3, 5}, 7), ProtocolError);
    EXPECT_THROW(arrives({3}, 7), ProtocolError);
    EXPECT_THROW(arrives({~std::uint64_t(0), 8}, 7), ProtocolError);
}

TEST(Messages, a_payload_is_shared_and_not_copied) {
    const auto bytes = std::make_shared<const Bytes>(8);
    const BlobChunk chunk{.blob = {}, .offset = 0, .total = 8};
    EXPECT_EQ(encode({chunk, {bytes, *bytes}}).payload.bytes.data(), bytes->data());
}

TEST(Messages, errors_name_message_and_field) {
    Message message{FrameBegin{}, {}};
    try {
        decode_frame(flattened(encode(message)));
        FAIL();
    } catch (const ProtocolError& error) {
        EXPECT_STREQ(error.what(), "FrameBegin: width is 0, must be 1 to 16384");
    }
}

}  // namespace
}  // namespace tessera
