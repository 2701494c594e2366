#include "common/jpeg.h"

#include <fmt/format.h>
#include <turbojpeg.h>

#include <memory>
#include <stdexcept>

#include "common/check.h"

namespace tessera {
namespace {

using Handle = std::unique_ptr<void, decltype(&tjDestroy)>;

const unsigned char* raw(std::span<const std::byte> bytes) {
    return reinterpret_cast<const unsigned char*>(bytes.data());
}

}  // namespace

Bytes encode_jpeg(std::span<const std::uint8_t> rgb, ImageSize size, int quality) {
    CHECK_EQ(rgb.size(), 3 * size.pixels());
    const Handle compressor(tjInitCompress(), tjDestroy);
    Bytes file(tjBufSize(size.width, size.height, TJSAMP_444));
    auto* out = reinterpret_cast<unsigned char*>(file.data());
    unsigned long bytes = file.size();
    const int failed =
        tjCompress2(compressor.get(), rgb.data(), size.width, 0, size.height, TJPF_RGB, &out,
                    &bytes, TJSAMP_444, quality, TJFLAG_NOREALLOC | TJFLAG_FASTDCT);
    CHECK_EQ(failed, 0);
    file.resize(bytes);
    return file;
}

std::vector<std::uint8_t> decode_jpeg(std::span<const std::byte> file, ImageSize size) {
    const Handle decompressor(tjInitDecompress(), tjDestroy);
    ImageSize found;
    int subsampling = 0, colours = 0;
    if (tjDecompressHeader3(decompressor.get(), raw(file), file.size(), &found.width, &found.height,
                            &subsampling, &colours) != 0)
        throw std::runtime_error(tjGetErrorStr2(decompressor.get()));
    if (found != size)
        throw std::runtime_error(fmt::format("JPEG of {} x {} pixels, must be {} x {}", found.width,
                                             found.height, size.width, size.height));
    std::vector<std::uint8_t> rgb(3 * size.pixels());
    if (tjDecompress2(decompressor.get(), raw(file), file.size(), rgb.data(), size.width, 0,
                      size.height, TJPF_RGB, TJFLAG_FASTDCT) != 0)
        throw std::runtime_error(tjGetErrorStr2(decompressor.get()));
    return rgb;
}

}  // namespace tessera
