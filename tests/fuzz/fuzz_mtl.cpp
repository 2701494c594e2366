// The materials of an .obj that uses them.

#include "tests/fuzz/fuzz_loader.h"

namespace {

tessera::LoadedScene load_with(const std::filesystem::path& mtl) {
    const std::filesystem::path obj = mtl.parent_path() / "fuzz.obj";
    std::ofstream(obj) << "mtllib fuzz.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n"
                          "usemtl a\nf 1/1 2/1 3/1\nusemtl b\nf 2/1 3/1 1/1\n";
    return tessera::load_obj(obj);
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    tessera::fuzz_loader(load_with, "fuzz.mtl", bytes, size);
    return 0;
}
