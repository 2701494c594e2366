#include "common/image_io.h"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>
#include <fmt/format.h>

#include <algorithm>
#include <array>

#include "common/check.h"

namespace tessera {
namespace {

using OIIO::ImageInput;
using OIIO::ImageOutput;
using OIIO::ImageSpec;
using OIIO::TypeDesc;

/// Larger pictures are refused before anything is allocated: a header is easily forged.
constexpr std::int64_t max_pixels = std::int64_t(1) << 28;

[[noreturn]] void cannot(const char* verb, const std::string& origin, std::string reason) {
    while (!reason.empty() && reason.back() == '\n') reason.pop_back();
    throw UserError(fmt::format("{}: cannot {} this picture: {}", origin, verb,
                                reason.empty() ? "unknown format" : reason));
}

/// The pixels of the first picture as T, all channels interleaved.
template <class T>
std::vector<T> read_pixels(ImageInput& in, TypeDesc type, const std::string& origin) {
    const ImageSpec spec = in.spec();
    if (spec.width < 1 || spec.height < 1 || spec.depth > 1 || spec.nchannels < 1 ||
        spec.nchannels > 64 || std::int64_t(spec.width) * spec.height > max_pixels)
        cannot(
            "use", origin,
            fmt::format("{}x{} pixels with {} channels", spec.width, spec.height, spec.nchannels));
    std::vector<T> pixels(std::size_t(spec.width) * spec.height * spec.nchannels);
    if (!in.read_image(0, 0, 0, spec.nchannels, type, pixels.data()))
        cannot("read", origin, in.geterror());
    return pixels;
}

/// Colours as they are stored, not multiplied by alpha.
ImageSpec straight_alpha() {
    ImageSpec config;
    config.attribute("oiio:UnassociatedAlpha", 1);
    return config;
}

Texture texture_from(ImageInput& in, const std::string& origin) {
    const auto pixels = read_pixels<std::uint8_t>(in, TypeDesc::UINT8, origin);
    const int channels = in.spec().nchannels;
    Texture texture{.width = std::uint32_t(in.spec().width),
                    .height = std::uint32_t(in.spec().height),
                    .rgba = {}};
    texture.rgba.reserve(pixels.size() / channels * 4);
    for (std::size_t p = 0; p < pixels.size(); p += channels) {
        const bool grey = channels < 3;
        for (int c = 0; c < 3; ++c) texture.rgba.push_back(pixels[p + (grey ? 0 : c)]);
        const bool alpha = channels == 2 || channels >= 4;
        texture.rgba.push_back(alpha ? pixels[p + (grey ? 1 : 3)] : 255);
    }
    return texture;
}

/// A file name by which OpenImageIO finds the format of encoded bytes.
std::string name_for(std::span<const std::byte> encoded, const std::string& origin) {
    const auto starts = [&](std::initializer_list<int> magic) {
        return encoded.size() >= magic.size() &&
               std::equal(magic.begin(), magic.end(), encoded.begin(),
                          [](int a, std::byte b) { return a == int(b); });
    };
    if (starts({0x89, 'P', 'N', 'G'})) return "picture.png";
    if (starts({0xff, 0xd8})) return "picture.jpg";
    return origin;
}

void write_pixels(const std::filesystem::path& file, const ImageSpec& spec, TypeDesc type,
                  const void* pixels) {
    check_writable_format(file);
    const auto out = ImageOutput::create(file.string());
    if (!out->open(file.string(), spec)) cannot("write", file.string(), out->geterror());
    if (!out->write_image(type, pixels) || !out->close())
        cannot("write", file.string(), out->geterror());
}

std::string lower_extension(const std::filesystem::path& file) {
    std::string extension = file.extension().string();
    for (char& c : extension) c = char(std::tolower(static_cast<unsigned char>(c)));
    return extension;
}

Image three_channels(const Image& image) {
    if (image.channels == 3) return image;
    Image out(image.size, 3);
    for (std::size_t i = 0; i < out.data.size(); ++i) out.data[i] = image.data[i / 3];
    return out;
}

}  // namespace

Image read_image(const std::filesystem::path& file) {
    const auto in = ImageInput::open(file.string());
    if (!in) cannot("read", file.string(), OIIO::geterror());
    const auto pixels = read_pixels<float>(*in, TypeDesc::FLOAT, file.string());
    const ImageSpec& spec = in->spec();
    const bool srgb = spec.format == TypeDesc::UINT8 || spec.format == TypeDesc::UINT16;
    Image image({spec.width, spec.height}, 3);
    for (std::size_t p = 0; p < image.size.pixels(); ++p)
        for (int c = 0; c < 3; ++c) {
            const float v = pixels[p * spec.nchannels + (spec.nchannels < 3 ? 0 : c)];
            image.data[3 * p + c] = srgb ? linear_from_srgb(v) : v;
        }
    return image;
}

bool keeps_linear(const std::filesystem::path& file) {
    constexpr std::array linear{".exr", ".hdr", ".pfm", ".tif", ".tiff"};
    return std::find(linear.begin(), linear.end(), lower_extension(file)) != linear.end();
}

void check_writable_format(const std::filesystem::path& file) {
    if (!file.has_extension() || !ImageOutput::create(file.string())) {
        OIIO::geterror();  // else OpenImageIO prints it at exit
        throw UserError(
            fmt::format("{}: no picture format has this name; use .exr or .png", file.string()));
    }
}

void write_image(const Image& image, const std::filesystem::path& file) {
    CHECK(image.channels == 1 || image.channels == 3);
    if (!keeps_linear(file))
        return write_srgb8(to_srgb8(three_channels(image), {}), image.size, file);
    write_pixels(file,
                 ImageSpec(image.size.width, image.size.height, image.channels, TypeDesc::FLOAT),
                 TypeDesc::FLOAT, image.data.data());
}

void write_srgb8(std::span<const std::uint8_t> rgb, ImageSize size,
                 const std::filesystem::path& file) {
    CHECK_EQ(rgb.size(), 3 * size.pixels());
    ImageSpec spec(size.width, size.height, 3, TypeDesc::UINT8);
    spec.attribute("oiio:ColorSpace", "sRGB");
    write_pixels(file, spec, TypeDesc::UINT8, rgb.data());
}

Texture decode_picture(std::span<const std::byte> encoded, const std::string& origin) {
    OIIO::Filesystem::IOMemReader memory(encoded.data(), encoded.size());
    const ImageSpec config = straight_alpha();
    const std::string name = name_for(encoded, origin);
    // Told of the memory twice: create() must not look for a file, open() forgets it.
    const auto in = ImageInput::create(name, false, &config, &memory);
    ImageSpec spec;
    if (!in) cannot("read", origin, OIIO::geterror());
    if (!in->set_ioproxy(&memory) || !in->open(name, spec, config))
        cannot("read", origin, in->geterror());
    return texture_from(*in, origin);
}

Texture read_texture(const std::filesystem::path& file) {
    const ImageSpec config = straight_alpha();
    const auto in = ImageInput::open(file.string(), &config);
    if (!in) cannot("read", file.string(), OIIO::geterror());
    return texture_from(*in, file.string());
}

Bytes encode_png(const Texture& texture) {
    ImageSpec spec(int(texture.width), int(texture.height), 4, TypeDesc::UINT8);
    spec.alpha_channel = 3;
    spec.attribute("oiio:UnassociatedAlpha", 1);
    std::vector<unsigned char> bytes;
    OIIO::Filesystem::IOVecOutput memory(bytes);
    const auto out = ImageOutput::create("picture.png", &memory);
    CHECK(out && out->open("picture.png", spec));
    CHECK(out->write_image(TypeDesc::UINT8, texture.rgba.data()) && out->close());
    const auto* begin = reinterpret_cast<const std::byte*>(bytes.data());
    return {begin, begin + bytes.size()};
}

}  // namespace tessera
