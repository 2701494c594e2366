// Picture files <-> images, through OpenImageIO.
#pragma once

#include <filesystem>

#include "common/image.h"
#include "common/mesh.h"
#include "common/tone_map.h"

namespace tessera {

/// Reads any format OpenImageIO knows as linear RGB floats: 8- and 16-bit integer files are taken
/// as sRGB. Throws UserError naming the file.
Image read_image(const std::filesystem::path& file);

/// Whether the file's format (by extension) keeps linear floats (.exr, .hdr, .pfm, .tif).
bool keeps_linear(const std::filesystem::path& file);

/// Throws UserError when no writer knows the extension; for checking before hours of rendering.
void check_writable_format(const std::filesystem::path& file);

/// Writes linear floats; 1 or 3 channels. Throws UserError.
void write_image(const Image& image, const std::filesystem::path& file);
/// Writes 8-bit sRGB pixels, three bytes each. Throws UserError.
void write_srgb8(std::span<const std::uint8_t> rgb, ImageSize size,
                 const std::filesystem::path& file);

/// An 8-bit RGBA texture from an encoded picture (PNG, JPEG...) in memory or in a file. Throws
/// UserError; `origin` names the source in the message.
Texture decode_picture(std::span<const std::byte> encoded, const std::string& origin);
Texture read_texture(const std::filesystem::path& file);
/// The texture's pixels as a PNG file in memory: decode_picture() gives them back as they were.
Bytes encode_png(const Texture& texture);

}  // namespace tessera
