// Pictures come back from files as they were, within what the format keeps.

#include "common/image_io.h"

#include <gtest/gtest.h>

#include "common/text_reader.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

Image ramp() {
    Image image({16, 9}, 3);
    for (std::size_t i = 0; i < image.data.size(); ++i)
        image.data[i] = float(i) / float(image.data.size() - 1);
    return image;
}

TEST(ImageIo, linear_formats_keep_floats) {
    const TempDir dir;
    Image image = ramp();
    image.data[5] = 1234.5f;
    for (const char* name : {"a.exr", "a.tif"}) {
        write_image(image, dir.file(name));
        EXPECT_EQ(read_image(dir.file(name)), image) << name;
    }
}

TEST(ImageIo, eight_bits_are_srgb) {
    const TempDir dir;
    write_image(ramp(), dir.file("a.png"));
    const Image back = read_image(dir.file("a.png"));
    ASSERT_EQ(back.size, ramp().size);
    for (std::size_t i = 0; i < back.data.size(); ++i)
        EXPECT_NEAR(srgb_from_linear(back.data[i]), srgb_from_linear(ramp().data[i]), 0.51f / 255);
    // What was read is written as the same bytes.
    write_image(back, dir.file("b.png"));
    EXPECT_EQ(read_image(dir.file("b.png")), back);
}

TEST(ImageIo, one_channel_becomes_grey) {
    const TempDir dir;
    Image depth({4, 4}, 1);
    depth.data[7] = 0.5f;
    for (const char* name : {"a.exr", "a.png"}) {
        write_image(depth, dir.file(name));
        const Image back = read_image(dir.file(name));
        EXPECT_EQ(back.channels, 3);
        EXPECT_NEAR(back.pixel(3, 1)[2], 0.5f, 0.01f) << name;
    }
}

TEST(ImageIo, png_in_memory_keeps_colour_under_any_alpha) {
    Texture texture{.width = 5, .height = 3, .rgba = {}};
    for (int i = 0; i < 60; ++i) texture.rgba.push_back(std::uint8_t(i * 37));
    EXPECT_EQ(decode_picture(encode_png(texture), "test"), texture);
}

TEST(ImageIo, formats_are_told_by_extension) {
    EXPECT_TRUE(keeps_linear("a.exr") && keeps_linear("dir/a.PFM") && keeps_linear("a.hdr"));
    EXPECT_FALSE(keeps_linear("a.png") || keeps_linear("exr"));
    EXPECT_NO_THROW(check_writable_format("a.jpg"));
    for (const char* name : {"a.xyz", "a", ""})
        EXPECT_NE(user_error([&] { check_writable_format(name); }).find("no picture format"),
                  std::string::npos);
}

TEST(ImageIo, errors_name_the_file) {
    const TempDir dir;
    EXPECT_NE(user_error([&] { read_image(dir.file("gone.exr")); }).find("gone.exr"),
              std::string::npos);
    dir.write("broken.png", "this is no picture");
    EXPECT_NE(user_error([&] { read_texture(dir.file("broken.png")); }).find("broken.png"),
              std::string::npos);
    const Bytes none;
    EXPECT_NE(user_error([&] { decode_picture(none, "image 3"); }).find("image 3"),
              std::string::npos);
    EXPECT_NE(
        user_error([&] { write_image(ramp(), dir.file("no") / "dir" / "a.exr"); }).find("a.exr"),
        std::string::npos);
}

/// The bytes of a file with every `from` replaced by `to`, of the same length.
std::string with(std::string bytes, const std::string& from, const std::string& to) {
    for (std::size_t at; (at = bytes.find(from)) != std::string::npos;)
        bytes.replace(at, from.size(), to);
    return bytes;
}

TEST(ImageIo, a_small_file_that_claims_to_be_huge_is_refused) {
    const TempDir dir;
    const ImageSize size{0x1234, 1};
    write_image(Image(size, 3), dir.file("small.exr"));
    // 100,000 x 100,000: in EXR the windows' last pixels, in PNG width and height.
    const std::string exr =
        with(read_file(dir.file("small.exr")), std::string("\x33\x12\0\0\0\0\0\0", 8),
             std::string("\x9f\x86\x01\0\x9f\x86\x01\0", 8));
    using namespace std::string_literals;
    const std::string png =
        "\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\x01\x86\xa0\0\x01\x86\xa0\x08\x02\0\0\0"s
        "\x27\x30\x9c\x9f\0\0\0\x04IDAT\0\0\0\0\0\0\0\0"s;
    for (const auto& bomb : {std::pair("bomb.exr", exr), std::pair("bomb.png", png)}) {
        const auto& name = bomb.first;  // clang 14 captures no structured bindings
        const auto& bytes = bomb.second;
        const auto file = dir.write(name, bytes);
        for (const std::string& complaint :
             {user_error([&] { read_image(file); }), user_error([&] { read_texture(file); }),
              user_error([&] { decode_picture(std::as_bytes(std::span(bytes)), name); })}) {
            EXPECT_NE(complaint.find(name), std::string::npos) << complaint;
            // OpenEXR itself complains before: there are no lines.
            if (name == std::string("bomb.png")) {
                EXPECT_NE(complaint.find("100000x100000 pixels"), std::string::npos) << complaint;
            }
        }
    }
}

TEST(ImageIo, formats_are_told_by_content) {
    const TempDir dir;
    const Image image = ramp();
    for (const char* name :
         {"a.exr", "a.hdr", "a.tif", "a.png", "a.jpg", "a.bmp", "a.tga", "a.ppm"}) {
        write_image(image, dir.file(name));
        EXPECT_EQ(read_image(dir.file(name)).size, image.size) << name;
    }
    std::filesystem::rename(dir.file("a.png"), dir.file("b.jpg"));
    EXPECT_EQ(read_image(dir.file("b.jpg")).size, image.size);
    dir.write("a.psd", "8BPS and more");
    EXPECT_NE(user_error([&] { read_image(dir.file("a.psd")); }).find("unknown format"),
              std::string::npos);
}

}  // namespace
}  // namespace tessera
