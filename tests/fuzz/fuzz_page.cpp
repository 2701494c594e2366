// What any page says to the gateway is refused, or becomes views and edits that the server's
// decoder takes.

#include <nlohmann/json.hpp>

#include "client/edit_json.h"
#include "client/page_json.h"
#include "common/check.h"
#include "tests/fuzz/small_scene.h"
#include "tests/random_message.h"

namespace {

using namespace tessera;

void send(Message message) { decode_frame(flattened(encode(std::move(message)))); }

void hear(const nlohmann::json& message, const Scene& scene) {
    View view{.request = 1, .spec = {}, .tone_map = {}};
    if (message.contains("view")) {
        read_view(message.at("view"), view);
        send({view, {}});
    } else if (message.contains("pick")) {
        read_pick(message);
    } else if (message.contains("edit")) {
        const EditOperation operation = operation_of_json(message.at("edit"), scene);
        send({SceneEdit{.request = 1, .scene = "s", .operations = {operation}}, {}});
    }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
    static const Scene scene = small_scene();
    try {
        hear(nlohmann::json::parse(data, data + size), scene);
    } catch (const nlohmann::json::exception&) {
    } catch (const PageError&) {
    } catch (const UserError&) {
    }
    return 0;
}
