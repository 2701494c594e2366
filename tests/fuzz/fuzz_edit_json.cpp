// Files of timed edits are edits of the scene, or a UserError.

#include "client/edit_json.h"
#include "tests/fuzz/fuzz_loader.h"
#include "tests/fuzz/small_scene.h"

namespace {

tessera::LoadedScene load_edits(const std::filesystem::path& file) {
    tessera::SceneBundle bundle = tessera::small_bundle();
    for (const tessera::TimedEdit& edit : tessera::load_timed_edits(file, bundle.scene))
        bundle.scene = tessera::apply_edits(std::move(bundle.scene), edit.operations).scene;
    return {.bundle = std::move(bundle), .notes = {}};
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* bytes, std::size_t size) {
    tessera::fuzz_loader(load_edits, "fuzz.json", bytes, size);
    return 0;
}
