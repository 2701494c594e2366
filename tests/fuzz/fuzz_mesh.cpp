// Blobs come from peers: any bytes decode to a value that encodes to the same bytes, or throw.

#include <stdexcept>

#include "common/check.h"
#include "common/mesh.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    using namespace tessera;
    const std::span<const std::byte> bytes(reinterpret_cast<const std::byte*>(data), size);
    try {
        CHECK(encode(decode_mesh(bytes)) == Bytes(bytes.begin(), bytes.end()));
    } catch (const std::runtime_error&) {
    }
    try {
        const Texture texture = decode_texture(bytes);
        CHECK(decode_texture(encode(texture)) == texture);
    } catch (const std::runtime_error&) {
    }
    return 0;
}
