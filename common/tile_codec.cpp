#include "common/tile_codec.h"

#include <algorithm>
#include <array>
#include <bit>
#include <cstring>
#include <optional>

#ifdef __SSE__
#include <xmmintrin.h>
#endif

#include "common/check.h"

namespace tessera {
namespace {

static_assert(std::endian::native == std::endian::little, "packed tiles are little-endian");

constexpr unsigned plain = 32;  ///< bits per pixel of a channel without a palette
constexpr unsigned most_palette_bits = 4;
/// More is not read again before other things have taken its place in the caches.
constexpr std::size_t cached_bytes = 8 << 20;

/// A pixel's floats as bits, because NaNs and zeros of either sign are kept as they are.
template <int floats>
using Entry = std::array<std::uint32_t, std::size_t(floats)>;

std::size_t index_bytes(std::size_t pixels, unsigned bits) { return (pixels * bits + 7) / 8; }

std::size_t coded_bytes(std::size_t pixels, int floats, unsigned bits) {
    const std::size_t entries = bits == plain ? pixels : std::size_t(1) << bits;
    return 4 * std::size_t(floats) * entries + (bits == plain ? 0 : index_bytes(pixels, bits));
}

template <class T>
void append(Bytes& out, std::span<const T> values) {
    const auto bytes = std::as_bytes(values);
    out.insert(out.end(), bytes.begin(), bytes.end());
}

template <int floats>
Entry<floats> pixel_at(const void* values, std::size_t i) {
    Entry<floats> out;
    std::memcpy(&out, static_cast<const std::byte*>(values) + i * sizeof out, sizeof out);
    return out;
}

/// The different pixels of a channel, if they are few, and which one each is.
template <int floats>
struct Palette {
    std::array<Entry<floats>, 1u << most_palette_bits> entries{};
    std::size_t count = 0;
    std::vector<std::uint8_t> indices;

    static std::optional<Palette> of(std::span<const float> values) {
        Palette out;
        const std::size_t pixels = values.size() / floats;
        out.indices.resize(pixels);
        std::size_t last = 0;
        for (std::size_t i = 0; i < pixels; ++i) {
            const auto pixel = pixel_at<floats>(values.data(), i);
            // Neighbours are mostly alike.
            if (out.count == 0 || out.entries[last] != pixel) {
                last = 0;
                while (last < out.count && out.entries[last] != pixel) ++last;
                if (last == out.entries.size()) return {};
                out.entries[last] = pixel;
                out.count = std::max(out.count, last + 1);
            }
            out.indices[i] = std::uint8_t(last);
        }
        return out;
    }

    unsigned bits() const { return count <= 1 ? 0 : count <= 2 ? 1 : count <= 4 ? 2 : 4; }
};

template <int floats>
void pack_channel(std::span<const float> values, Bytes& out) {
    const auto palette = Palette<floats>::of(values);
    if (!palette) {
        out.push_back(std::byte(plain));
        return append(out, values);
    }
    const unsigned bits = palette->bits();
    out.push_back(std::byte(bits));
    append(out, std::span(palette->entries).first(std::size_t(1) << bits));
    if (bits == 0) return;
    const std::size_t begin = out.size();
    out.resize(begin + index_bytes(palette->indices.size(), bits));
    for (std::size_t i = 0; i < palette->indices.size(); ++i)
        out[begin + i * bits / 8] |= std::byte(palette->indices[i] << (i * bits % 8));
}

/// Four lanes, as GCC and Clang have them.
using Float4 = float __attribute__((vector_size(16)));
using Int4 = std::int32_t __attribute__((vector_size(16)));

/// What a sum over one value is.
float sum_of(float value) { return value * 0 == 0 ? 0 + value : 0; }
Float4 sum_of(Float4 value) {
    const Int4 finite = value * 0 == Float4{};
    return Float4(Int4(0 + value) & finite);
}

/// Without the caches where the machine can. `to` is where four floats may begin.
void store_far(float* to, Float4 value) {
#ifdef __SSE__
    _mm_stream_ps(to, value);
#else
    std::memcpy(to, &value, sizeof value);
#endif
}

/// A channel of a picture, and how a tile's pixels get there.
struct Plane {
    float* data;
    std::size_t width;  ///< in pixels
    bool past_caches;   ///< which do not hold all channels
    bool sums;          ///< is to be sum_of() the values
};

/// Puts a row's floats into `to`. Past the caches only by whole cache lines: memory takes longer
/// for parts.
void put_row(const std::byte* from, std::size_t floats, const Plane& plane, float* to) {
    const bool whole_lines = (std::bit_cast<std::uintptr_t>(to) | 4 * floats) % 64 == 0;
    const bool past_caches = plane.past_caches && whole_lines;
    std::size_t i = 0;
    for (; i + 4 <= floats; i += 4) {
        Float4 v;
        std::memcpy(&v, from + 4 * i, sizeof v);
        if (plane.sums) v = sum_of(v);
        if (past_caches)
            store_far(to + i, v);
        else
            std::memcpy(to + i, &v, sizeof v);
    }
    for (; i < floats; ++i) {
        std::memcpy(to + i, from + 4 * i, sizeof(float));
        if (plane.sums) to[i] = sum_of(to[i]);
    }
}

template <int floats>
void unpack_channel(unsigned bits, const std::byte* coded, const Rect& rect, const Plane& plane) {
    constexpr std::size_t pixel_bytes = sizeof(Entry<floats>);
    const std::byte* indices = coded + (pixel_bytes << (bits % plain));
    const auto across = std::size_t(rect.width());
    std::size_t i = 0;
    for (int y = rect.y0; y < rect.y1; ++y) {
        float* to = plane.data +
                    std::size_t(floats) * (std::size_t(y) * plane.width + std::size_t(rect.x0));
        if (bits == plain) {
            put_row(coded + i * pixel_bytes, floats * across, plane, to);
            i += across;
            continue;
        }
        for (std::size_t x = 0; x < across; ++x, ++i) {
            const std::size_t index =
                bits == 0
                    ? 0
                    : std::size_t(indices[i * bits / 8]) >> (i * bits % 8) & ((1u << bits) - 1);
            std::memcpy(to + std::size_t(floats) * x, coded + index * pixel_bytes, pixel_bytes);
        }
        if (plane.sums)
            std::transform(to, to + floats * across, to, [](float v) { return sum_of(v); });
    }
}

/// Calls f(channel, bits, first coded byte) for each channel, as long as the bytes are a tile's.
/// Returns whether they are.
template <class F>
bool for_each_channel(ChannelSet channels, std::size_t pixels, std::span<const std::byte> packed,
                      F f) {
    for (int c = 0; c < channel_count; ++c) {
        if (!channels.has(Channel(c))) continue;
        if (packed.empty()) return false;
        const auto bits = unsigned(packed[0]);
        if (bits != 0 && bits != 1 && bits != 2 && bits != 4 && bits != plain) return false;
        packed = packed.subspan(1);
        const std::size_t size = coded_bytes(pixels, floats_per_pixel(Channel(c)), bits);
        if (packed.size() < size) return false;
        f(Channel(c), bits, packed.data());
        packed = packed.subspan(size);
    }
    return packed.empty();
}

}  // namespace

Bytes pack_tile(ChannelSet channels, std::size_t pixels, std::span<const float> data) {
    CHECK_EQ(data.size(), pixels * std::size_t(floats_per_pixel(channels)));
    Bytes out;
    out.reserve(data.size_bytes() + channel_count);
    for (int c = 0; c < channel_count; ++c) {
        if (!channels.has(Channel(c))) continue;
        const auto values = data.first(pixels * std::size_t(floats_per_pixel(Channel(c))));
        data = data.subspan(values.size());
        floats_per_pixel(Channel(c)) == 1 ? pack_channel<1>(values, out)
                                          : pack_channel<3>(values, out);
    }
    return out;
}

bool is_packed_tile(ChannelSet channels, std::size_t pixels, std::span<const std::byte> packed) {
    return for_each_channel(channels, pixels, packed, [](Channel, unsigned, const std::byte*) {});
}

void unpack_tile(ChannelSet channels, std::span<const std::byte> packed, const Rect& rect,
                 ImageSize picture, std::span<float> planes, Unpacked how) {
    CHECK_EQ(planes.size(), picture.pixels() * std::size_t(floats_per_pixel(channels)));
    Plane plane{.data = planes.data(),
                .width = std::size_t(picture.width),
                .past_caches = planes.size_bytes() > cached_bytes,
                .sums = false};
    const auto put = [&](Channel c, unsigned bits, const std::byte* coded) {
        plane.sums = c == Channel::radiance && how == Unpacked::radiance_is_a_sum;
        floats_per_pixel(c) == 1 ? unpack_channel<1>(bits, coded, rect, plane)
                                 : unpack_channel<3>(bits, coded, rect, plane);
        plane.data += picture.pixels() * std::size_t(floats_per_pixel(c));
    };
    CHECK(for_each_channel(channels, rect.pixels(), packed, put));
}

void finish_unpacking() {
#ifdef __SSE__
    _mm_sfence();
#endif
}

}  // namespace tessera
