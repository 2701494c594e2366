// The body of any SceneEdit is refused, or leaves a small scene valid and its names unique: making
// them unique once more changes nothing.

#include "common/check.h"
#include "tests/fuzz/fuzz_message.h"
#include "tests/fuzz/small_scene.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    using namespace tessera;
    static const Scene scene = small_scene();
    try {
        const Message message = decode_body(kind_scene_edit, std::as_bytes(std::span(data, size)));
        EditedScene edited = apply_edits(scene, std::get<SceneEdit>(message.body).operations);
        validate(edited.scene);
        const std::vector<Instance> before = edited.scene.instances;
        make_names_unique(edited.scene);
        for (std::size_t i = 0; i < before.size(); ++i)
            CHECK_EQ(before[i].name, edited.scene.instances[i].name);
    } catch (const ProtocolError&) {
    }
    return 0;
}
