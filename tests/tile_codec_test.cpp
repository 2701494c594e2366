// Laws of packed tiles: what comes out are the bits that went in, whatever they are; few different
// pixels take few bytes; nothing but a tile of the right size and channels is taken for one.

#include "common/tile_codec.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <limits>
#include <random>

namespace tessera {
namespace {

using Bits = std::vector<std::uint32_t>;

Bits bits_of(std::span<const float> values) {
    Bits out;
    for (const float v : values) out.push_back(std::bit_cast<std::uint32_t>(v));
    return out;
}

/// Channels in which `variety` different pixels occur.
std::vector<float> random_tile(std::mt19937& random, ChannelSet channels, std::size_t pixels,
                               unsigned variety) {
    constexpr float odd[] = {0, -0.0f, std::numeric_limits<float>::quiet_NaN(), 1e-42f,
                             std::numeric_limits<float>::infinity()};
    std::vector<float> data;
    for (int c = 0; c < channel_count; ++c) {
        if (!channels.has(Channel(c))) continue;
        const auto floats = std::size_t(floats_per_pixel(Channel(c)));
        std::vector<float> values(variety * floats);
        for (float& v : values)
            v = random() % 4 ? std::bit_cast<float>(std::uint32_t(random())) : odd[random() % 5];
        for (std::size_t i = 0; i < pixels; ++i) {
            const auto from = values.begin() + std::ptrdiff_t(random() % variety * floats);
            data.insert(data.end(), from, from + std::ptrdiff_t(floats));
        }
    }
    return data;
}

TEST(TileCodec, unpacking_inverts_packing_to_the_bit) {
    std::mt19937 random(1);
    for (int round = 0; round < 3000; ++round) {
        const ChannelSet channels{std::uint32_t(random() % (1u << channel_count))};
        const ImageSize picture{1 + int(random() % 40), 1 + int(random() % 40)};
        const Rect rect = tile_rect(picture, std::uint32_t(random() % tile_count(picture)));
        const std::vector<float> data =
            random_tile(random, channels, rect.pixels(), 1 + unsigned(random() % 20));
        const Bytes packed = pack_tile(channels, rect.pixels(), data);
        ASSERT_TRUE(is_packed_tile(channels, rect.pixels(), packed));

        // Around the tile nothing changes.
        const auto floats = std::size_t(floats_per_pixel(channels));
        std::vector<float> planes(picture.pixels() * floats, 7);
        unpack_tile(channels, packed, rect, picture, planes);
        std::vector<float> expected(planes.size(), 7);
        std::size_t plane = 0, from = 0;
        for (int c = 0; c < channel_count; ++c) {
            if (!channels.has(Channel(c))) continue;
            const auto n = std::size_t(floats_per_pixel(Channel(c)));
            for (int y = rect.y0; y < rect.y1; ++y)
                for (std::size_t i = 0; i < n * std::size_t(rect.width()); ++i)
                    expected[plane + n * std::size_t(y * picture.width + rect.x0) + i] =
                        data[from++];
            plane += n * picture.pixels();
        }
        ASSERT_EQ(bits_of(planes), bits_of(expected));
    }
}

TEST(TileCodec, large_pictures_and_sums_get_the_same_values) {
    std::mt19937 random(4);
    const ChannelSet channels = ChannelSet{}.with(Channel::radiance).with(Channel::depth);
    for (const ImageSize picture : {ImageSize{1024, 1024}, ImageSize{1003, 1021}, {64, 64}}) {
        std::vector<float> planes(picture.pixels() * 4), sums(planes.size());
        for (const std::uint32_t tile : {0u, 5u, tile_count(picture) - 1}) {
            const Rect rect = tile_rect(picture, tile);
            const std::vector<float> data =
                random_tile(random, channels, rect.pixels(), 1 + unsigned(random() % 300));
            const Bytes packed = pack_tile(channels, rect.pixels(), data);
            unpack_tile(channels, packed, rect, picture, planes);
            unpack_tile(channels, packed, rect, picture, sums, Unpacked::radiance_is_a_sum);
            finish_unpacking();
            std::size_t from = 0;
            for (int y = rect.y0; y < rect.y1; ++y)
                for (int i = 3 * rect.x0; i < 3 * rect.x1; ++i, ++from) {
                    const std::size_t at = 3 * std::size_t(y * picture.width) + std::size_t(i);
                    const float sum = std::isfinite(data[from]) ? 0 + data[from] : 0;
                    ASSERT_EQ(bits_of({&planes[at], 1}), bits_of({&data[from], 1}));
                    ASSERT_EQ(bits_of({&sums[at], 1}), bits_of({&sum, 1}));
                }
            for (int y = rect.y0; y < rect.y1; ++y)
                for (int x = rect.x0; x < rect.x1; ++x, ++from) {
                    const std::size_t at =
                        3 * picture.pixels() + std::size_t(y * picture.width) + std::size_t(x);
                    ASSERT_EQ(bits_of({&planes[at], 1}), bits_of({&data[from], 1}));
                    ASSERT_EQ(bits_of({&sums[at], 1}), bits_of({&data[from], 1}));
                }
        }
    }
}

TEST(TileCodec, few_different_pixels_take_few_bytes) {
    std::mt19937 random(2);
    const auto bytes = [&](unsigned variety) {
        const ChannelSet normal = ChannelSet{}.with(Channel::normal);
        return pack_tile(normal, 256, random_tile(random, normal, 256, variety)).size();
    };
    EXPECT_EQ(bytes(1), 1u + 12);
    EXPECT_EQ(bytes(2), 1u + 2 * 12 + 32);
    EXPECT_EQ(bytes(4), 1u + 4 * 12 + 64);
    EXPECT_EQ(bytes(16), 1u + 16 * 12 + 128);
    EXPECT_EQ(bytes(100000), 1u + 256 * 12);
}

TEST(TileCodec, nothing_else_is_a_tile) {
    std::mt19937 random(3);
    const ChannelSet channels = ChannelSet{}.with(Channel::radiance).with(Channel::depth);
    for (int round = 0; round < 2000; ++round) {
        const Bytes packed =
            pack_tile(channels, 256, random_tile(random, channels, 256, 1 + random() % 20));
        Bytes other = packed;
        other.resize(random() % (packed.size() + 20));
        EXPECT_EQ(is_packed_tile(channels, 256, other), other == packed);
        EXPECT_FALSE(is_packed_tile(channels.with(Channel::normal), 256, packed));
        EXPECT_FALSE(is_packed_tile(ChannelSet{}.with(Channel::radiance), 256, packed));
        other = packed;
        other[0] = std::byte(random());
        // What is taken for one can be unpacked.
        std::vector<float> planes(256 * 4);
        if (is_packed_tile(channels, 256, other))
            unpack_tile(channels, other, {0, 0, 16, 16}, {16, 16}, planes);
    }
    EXPECT_TRUE(is_packed_tile({}, 256, {}));
}

}  // namespace
}  // namespace tessera
