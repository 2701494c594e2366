#include "server/limits.h"

#include <fmt/format.h>

namespace tessera {
namespace {

std::uint64_t megabytes(std::uint64_t bytes) { return (bytes + (1 << 20) - 1) >> 20; }

}  // namespace

std::string objection_to_size(const Limits& limits, ImageSize size) {
    if (size.pixels() <= limits.picture_pixels) return {};
    return fmt::format(
        "a picture of {}x{} pixels is too large: this server makes up to {} pixels "
        "(--max-picture)",
        size.width, size.height, limits.picture_pixels);
}

std::string objection_to_scene(const Limits& limits, const SceneBundle& bundle) {
    if (bundle.blobs.bytes() > limits.scene_bytes)
        return fmt::format(
            "its meshes and textures have {} MB: this server takes scenes of up to "
            "{} MB (--max-scene)",
            megabytes(bundle.blobs.bytes()), megabytes(limits.scene_bytes));
    for (const BlobId& id : bundle.scene.textures) {
        const auto blob = bundle.blobs.find(id);
        if (blob && blob->size() > limits.texture_bytes)
            return fmt::format(
                "a texture has {} MB: this server takes textures of up to {} MB (--max-texture)",
                megabytes(blob->size()), megabytes(limits.texture_bytes));
    }
    return {};
}

std::string objection_to_memory(const Limits& limits, std::uint64_t session_bytes) {
    if (session_bytes <= limits.session_bytes) return {};
    return fmt::format(
        "this viewer's scenes and pictures would take {} MB: this server grants a "
        "session {} MB (--max-session)",
        megabytes(session_bytes), megabytes(limits.session_bytes));
}

std::uint64_t memory_of(const FrameSpec& spec) {
    // Two runs of passes in flight, and their sum, mean and squares.
    const int floats = 2 * floats_per_pixel(tile_channels(spec)) + 12;
    return spec.size.pixels() * std::uint64_t(floats) * sizeof(float);
}

bool Rate::count(Time now, std::uint32_t most) {
    if (now - begin_ >= std::chrono::seconds(1)) {
        begin_ = now;
        count_ = 0;
    }
    return ++count_ <= most;
}

}  // namespace tessera
