// What a server grants its peers at most, so that none takes it from the others. What is beyond is
// refused with a sentence that names the limit and the option of tessera-server that raises it.
// Pure.
#pragma once

#include <chrono>
#include <cstdint>
#include <string>

#include "common/framing.h"
#include "common/message_codec.h"
#include "common/scene.h"
#include "common/tile.h"

namespace tessera {

struct Limits {
    std::size_t sessions = 1024;    ///< --max-sessions: workers and viewers together
    std::size_t handshakes = 64;    ///< --max-handshakes: connections before they are let in
    std::uint32_t requests = 1000;  ///< --max-requests: of one viewer in a second
    std::size_t frames = 16;        ///< --max-frames: of one viewer at a time; and views
    std::uint32_t message_bytes = max_message_bytes;       ///< --max-message: one from a peer
    std::uint64_t picture_pixels = max_image_pixels;       ///< --max-picture
    std::uint64_t texture_bytes = std::uint64_t(2) << 30;  ///< --max-texture
    std::uint64_t scene_bytes = std::uint64_t(16) << 30;   ///< --max-scene: its meshes and textures
    /// --max-session: scenes that a viewer has brought, and pictures on their way to it
    std::uint64_t session_bytes = std::uint64_t(16) << 30;
};

/// A sentence for whom it concerns, or empty when there is no objection.
std::string objection_to_size(const Limits& limits, ImageSize size);
std::string objection_to_scene(const Limits& limits, const SceneBundle& bundle);
std::string objection_to_memory(const Limits& limits, std::uint64_t session_bytes);

/// About what the server needs to add up a frame.
std::uint64_t memory_of(const FrameSpec& spec);

/// Counts what happens in a second.
class Rate {
public:
    using Time = std::chrono::steady_clock::time_point;

    /// Counts one more; false when it is more than `most` in the second that has begun.
    bool count(Time now, std::uint32_t most);

private:
    Time begin_{};
    std::uint32_t count_ = 0;
};

}  // namespace tessera
