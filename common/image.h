// Pixel buffers: float pictures with any number of channels, row by row from the top left.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

namespace tessera {

struct ImageSize {
    int width = 0;
    int height = 0;

    std::size_t pixels() const { return std::size_t(width) * std::size_t(height); }
    bool operator==(const ImageSize&) const = default;
};

/// A linear picture; `channels` floats per pixel, interleaved.
struct Image {
    ImageSize size;
    int channels = 3;
    std::vector<float> data;

    Image() = default;
    Image(ImageSize s, int channel_count)
        : size(s), channels(channel_count), data(s.pixels() * std::size_t(channel_count)) {}

    std::span<float> pixel(int x, int y) {
        return {data.data() + (std::size_t(y) * size.width + x) * channels, std::size_t(channels)};
    }
    std::span<const float> pixel(int x, int y) const {
        return {data.data() + (std::size_t(y) * size.width + x) * channels, std::size_t(channels)};
    }
    bool operator==(const Image&) const = default;
};

}  // namespace tessera
