#include "server/picture_parts.h"

#include <bit>
#include <utility>

#include "common/jpeg.h"

namespace tessera {
namespace {

template <class T>
PicturePart make_part(std::uint64_t request, Channel channel, PictureFormat format, ImageSize size,
                      int components, std::vector<T> values) {
    const auto owner = std::make_shared<const std::vector<T>>(std::move(values));
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

std::uint8_t byte_of(float v) { return std::uint8_t(255 * std::clamp(v, 0.0f, 1.0f) + 0.5f); }

std::vector<std::uint8_t> normal_colours(const Image& normals) {
    std::vector<std::uint8_t> out;
    for (const float n : normals.data) out.push_back(byte_of(0.5f * n + 0.5f));
    return out;
}

std::vector<std::uint8_t> depth_greys(const Image& depths) {
    std::vector<std::uint8_t> out;
    for (const float d : depths.data) out.insert(out.end(), 3, byte_of(1 / (1 + d)));
    return out;
}

/// The hash's own bits.
std::vector<std::uint8_t> surface_colours(const Image& surfaces) {
    std::vector<std::uint8_t> out;
    for (const float s : surfaces.data)
        for (int shift = 0; shift < 24; shift += 8)
            out.push_back(std::uint8_t(std::bit_cast<std::uint32_t>(s) >> shift));
    return out;
}

std::vector<std::uint8_t> rgb8(const LivePicture& picture) {
    switch (picture.view.shown) {
        case Channel::normal:
            return normal_colours(*picture.image);
        case Channel::depth:
            return depth_greys(*picture.image);
        case Channel::surface:
            return surface_colours(*picture.image);
        default:
            return to_srgb8(*picture.image, picture.view.tone_map);
    }
}

}  // namespace

std::vector<PicturePart> parts_of(const FinishedFrame& frame) {
    const FrameRequest& request = frame.request;
    std::vector<PicturePart> parts;
    Image picture = frame.sums->picture();
    if (request.format == PictureFormat::srgb8)
        parts.push_back(make_part(request.request, Channel::radiance, request.format,
                                  request.spec.size, 3, to_srgb8(picture, request.tone_map)));
    else
        parts.push_back(linear_part(request.request, Channel::radiance, std::move(picture)));
    for (int c = 1; c < channel_count; ++c)
        if (request.spec.extra.has(Channel(c)))
            parts.push_back(
                linear_part(request.request, Channel(c), frame.sums->channel(Channel(c))));
    return parts;
}

PicturePart part_of(const LivePicture& picture) {
    const View& view = picture.view;
    const Image& image = *picture.image;
    PictureFormat format = view.format;
    if (format == PictureFormat::automatic)
        format = picture.about.settled ? PictureFormat::srgb8 : PictureFormat::jpeg;
    if (format == PictureFormat::linear_float) return linear_part(view.request, view.shown, image);
    std::vector<std::uint8_t> bytes = rgb8(picture);
    if (format == PictureFormat::srgb8)
        return make_part(view.request, view.shown, format, image.size, 3, std::move(bytes));
    return make_part(view.request, view.shown, format, image.size, 3,
                     encode_jpeg(bytes, image.size));
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
