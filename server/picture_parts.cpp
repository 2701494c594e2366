#include "server/picture_parts.h"

#include <algorithm>
#include <utility>

#include "common/false_colour.h"
#include "common/jpeg.h"

namespace tessera {
namespace {

template <class Vector>
PicturePart make_part(std::uint64_t request, Channel channel, PictureFormat format, ImageSize size,
                      int components, Vector values) {
    const auto owner = std::make_shared<const Vector>(std::move(values));
    const std::span<const std::byte> bytes = std::as_bytes(std::span(*owner));
    return {.whole = {.request = request,
                      .channel = channel,
                      .format = format,
                      .width = std::uint32_t(size.width),
                      .height = std::uint32_t(size.height),
                      .components = std::uint32_t(components),
                      .offset = 0,
                      .total = bytes.size()},
            .pixels = {owner, bytes}};
}

PicturePart linear_part(std::uint64_t request, Channel channel, Image image) {
    return make_part(request, channel, PictureFormat::linear_float, image.size, image.channels,
                     std::move(image.data));
}

/// A few rows at a time, which stay in the cache.
RawVector<std::uint8_t> srgb8_of(const FrameSums& sums, ImageSize size, const ToneMap& tone_map) {
    constexpr int band = 16;
    const ToneTable table(tone_map);
    const std::size_t row = 3 * std::size_t(size.width);
    RawVector<std::uint8_t> out(std::size_t(size.height) * row);
    for (int y = 0; y < size.height; y += band)
        sums.srgb8_rows(table, y, std::min(y + band, size.height), &out[std::size_t(y) * row]);
    return out;
}

}  // namespace

std::vector<PicturePart> parts_of(const FinishedFrame& frame) {
    const FrameRequest& request = frame.request;
    std::vector<PicturePart> parts;
    const ImageSize size = request.spec.size;
    if (request.format == PictureFormat::srgb8)
        parts.push_back(make_part(request.request, Channel::radiance, request.format, size, 3,
                                  srgb8_of(*frame.sums, size, request.tone_map)));
    else
        parts.push_back(linear_part(request.request, Channel::radiance, frame.sums->picture()));
    for (int c = 1; c < channel_count; ++c)
        if (request.spec.extra.has(Channel(c)))
            parts.push_back(
                linear_part(request.request, Channel(c), frame.sums->channel(Channel(c))));
    return parts;
}

PicturePart part_of(const LivePicture& picture, int jpeg_quality) {
    const View& view = picture.view;
    const Image& image = *picture.image;
    PictureFormat format = view.format;
    if (format == PictureFormat::automatic)
        format = picture.about.settled ? PictureFormat::srgb8 : PictureFormat::jpeg;
    if (format == PictureFormat::linear_float) return linear_part(view.request, view.shown, image);
    std::vector<std::uint8_t> bytes = to_rgb8(image, view.shown, view.tone_map);
    if (format == PictureFormat::srgb8)
        return make_part(view.request, view.shown, format, image.size, 3, std::move(bytes));
    return make_part(view.request, view.shown, format, image.size, 3,
                     encode_jpeg(bytes, image.size, jpeg_quality));
}

Message chunk_of(const PicturePart& part, std::size_t offset) {
    Message message;
    PictureChunk chunk = part.whole;
    chunk.offset = offset;
    message.body = chunk;
    message.payload = {part.pixels.owner,
                       part.pixels.bytes.subspan(
                           offset, std::min<std::size_t>(chunk_bytes, chunk.total - offset))};
    return message;
}

}  // namespace tessera
