// Pictures, in memory and as files, decode to as many pixels as they say, or are refused.

#include "common/image_io.h"
#include "tests/fuzz/fuzz_loader.h"

namespace {

tessera::LoadedScene load_picture(const std::filesystem::path& file) {
    const tessera::Texture texture = tessera::read_texture(file);
    CHECK_EQ(texture.rgba.size(), std::size_t(4) * texture.width * texture.height);
    const tessera::Image image = tessera::read_image(file);
    CHECK_EQ(image.data.size(), 3 * image.size.pixels());
    return {};
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    using namespace tessera;
    try {
        decode_picture(std::as_bytes(std::span(bytes, size)), "picture.tga");
    } catch (const UserError&) {
    }
    fuzz_loader(load_picture, "fuzz.tga", bytes, size);
    return 0;
}
