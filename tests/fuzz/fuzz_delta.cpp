// The body of any SceneUpdate is refused, or leads to a valid scene, to which the difference leads
// as well. Made from nothing or from a small scene, as its base version says.

#include "common/check.h"
#include "common/scene_sync.h"
#include "tests/fuzz/fuzz_message.h"
#include "tests/fuzz/small_scene.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    using namespace tessera;
    static const SceneVersion base{.version = 1, .scene = small_scene()};
    try {
        const Message message =
            decode_body(kind_scene_update, std::as_bytes(std::span(data, size)));
        const auto& update = std::get<SceneUpdate>(message.body);
        SceneReceiver receiver;
        receiver.hold(update.scene, base, {});
        receiver.update(update);
        const SceneVersion& next = *receiver.find(update.scene);
        validate(next.scene);
        const SceneDelta back = diff(base, next);

        CHECK_EQ(apply(base, back).scene.instances.size(), next.scene.instances.size());
    } catch (const ProtocolError&) {
    }
    return 0;
}
