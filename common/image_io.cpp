#include "common/image_io.h"

#include <OpenImageIO/filesystem.h>
#include <OpenImageIO/imageio.h>
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <fstream>
#include <string_view>

#include "common/check.h"

namespace tessera {
namespace {

using OIIO::ImageInput;
using OIIO::ImageOutput;
using OIIO::ImageSpec;
using OIIO::TypeDesc;

/// Larger pictures are refused before anything is allocated: a header is easily forged. 16384 x
/// 16384 pixels of 8-bit RGBA.
constexpr std::int64_t max_decoded_bytes = std::int64_t(1) << 30;

[[noreturn]] void cannot(const char* verb, const std::string& origin, std::string reason) {
    while (!reason.empty() && reason.back() == '\n') reason.pop_back();
    throw UserError(fmt::format("{}: cannot {} this picture: {}", origin, verb,
                                reason.empty() ? "unknown format" : reason));
}

/// Whether decoding allocates at most max_decoded_bytes, for the pixels as well as for what
/// OpenImageIO holds on the way: 256 rows at a time, or a row of tiles, of numbers as they are
/// stored.
bool is_bounded(const ImageSpec& spec, std::size_t number_bytes) {
    constexpr std::int64_t rows_at_a_time = 256;
    constexpr std::int64_t stored_bytes = 8;  // of the largest number, a double
    constexpr std::int64_t most_side = 1 << 20;
    const std::int64_t width = spec.width, height = spec.height, channels = spec.nchannels;
    if (width < 1 || height < 1 || spec.depth > 1 || channels < 1 || channels > 64) return false;
    if (width > most_side || height > most_side) return false;
    if (spec.tile_width > most_side || spec.tile_height > most_side) return false;
    const std::int64_t padded_width = width + spec.tile_width;
    const std::int64_t rows = std::max<std::int64_t>(rows_at_a_time, spec.tile_height);
    return width * height * channels * std::int64_t(number_bytes) <= max_decoded_bytes &&
           padded_width * rows * channels * stored_bytes <= max_decoded_bytes;
}

/// The pixels of the first picture as T, all channels interleaved.
template <class T>
std::vector<T> read_pixels(ImageInput& in, TypeDesc type, const std::string& origin) {
    const ImageSpec spec = in.spec();
    if (!is_bounded(spec, sizeof(T)))
        cannot("use", origin,
               fmt::format("{}x{} pixels with {} channels take more than {} MB, or none at all",
                           spec.width, spec.height, spec.nchannels, max_decoded_bytes >> 20));
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

std::string lower_extension(const std::filesystem::path& file) {
    std::string extension = file.extension().string();
    for (char& c : extension) c = char(std::tolower(static_cast<unsigned char>(c)));
    return extension;
}

/// Formats that scenes use, by their first bytes. OpenImageIO by itself would try its readers one
/// after the other, down to those for cameras and hospitals.
struct Format {
    const char* name;  ///< OpenImageIO's
    std::string_view magic;
};

using namespace std::string_view_literals;
constexpr Format formats[] = {
    {"png", "\x89PNG"sv}, {"jpeg", "\xff\xd8"sv}, {"openexr", "\x76\x2f\x31\x01"sv},
    {"hdr", "#?"sv},      {"tiff", "II*\0"sv},    {"tiff", "MM\0*"sv},
    {"bmp", "BM"sv},      {"gif", "GIF8"sv},      {"webp", "RIFF"sv},
    {"dds", "DDS "sv},    {"pnm", "P2"sv},        {"pnm", "P3"sv},
    {"pnm", "P5"sv},      {"pnm", "P6"sv},        {"pnm", "PF"sv},
    {"pnm", "Pf"sv},
};

/// Empty when the format is none of these.
std::string format_of(std::string_view first_bytes, const std::filesystem::path& name) {
    for (const Format& format : formats)
        if (first_bytes.starts_with(format.magic)) return format.name;
    return lower_extension(name) == ".tga" ? "targa" : "";  // the one that begins with nothing
}

std::unique_ptr<ImageInput> open_file(const std::filesystem::path& file, const ImageSpec& config) {
    std::array<char, 4> start{};
    std::ifstream in(file, std::ios::binary);
    if (!in) cannot("read", file.string(), "no such file, or not to be read");
    in.read(start.data(), start.size());
    const std::string format = format_of({start.data(), std::size_t(in.gcount())}, file);
    auto input = format.empty() ? nullptr : ImageInput::create(format);
    ImageSpec spec;
    if (!input) cannot("read", file.string(), OIIO::geterror());
    if (!input->open(file.string(), spec, config)) cannot("read", file.string(), input->geterror());
    return input;
}

void write_pixels(const std::filesystem::path& file, const ImageSpec& spec, TypeDesc type,
                  const void* pixels) {
    check_writable_format(file);
    const auto out = ImageOutput::create(file.string());
    if (!out->open(file.string(), spec)) cannot("write", file.string(), out->geterror());
    if (!out->write_image(type, pixels) || !out->close())
        cannot("write", file.string(), out->geterror());
}

Image three_channels(const Image& image) {
    if (image.channels == 3) return image;
    Image out(image.size, 3);
    for (std::size_t i = 0; i < out.data.size(); ++i) out.data[i] = image.data[i / 3];
    return out;
}

}  // namespace

Image read_image(const std::filesystem::path& file) {
    const auto in = open_file(file, {});
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
    const std::string format =
        format_of({reinterpret_cast<const char*>(encoded.data()), encoded.size()}, origin);
    // Told of the memory twice: create() must not look for a file, open() forgets it.
    const auto in = format.empty() ? nullptr : ImageInput::create(format, false, &config, &memory);
    ImageSpec spec;
    if (!in) cannot("read", origin, OIIO::geterror());
    if (!in->set_ioproxy(&memory) || !in->open("picture." + format, spec, config))
        cannot("read", origin, in->geterror());
    return texture_from(*in, origin);
}

Texture read_texture(const std::filesystem::path& file) {
    return texture_from(*open_file(file, straight_alpha()), file.string());
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
