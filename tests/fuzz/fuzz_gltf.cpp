#include "tests/fuzz/fuzz_loader.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    tessera::fuzz_loader(tessera::load_gltf, "fuzz.gltf", bytes, size);
    return 0;
}
