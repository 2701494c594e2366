// The .obj may name itself as its material library, which puts the .mtl reader under fuzzing too.

#include "tests/fuzz/fuzz_loader.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    tessera::fuzz_loader(tessera::load_obj, "fuzz.obj", bytes, size);
    return 0;
}
