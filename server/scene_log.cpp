#include "server/scene_log.h"

#include <fmt/format.h>

#include <algorithm>

#include "common/message_codec.h"

namespace tessera {
namespace {

/// Replaying a delta costs time in proportion to the scene, not to the delta.
constexpr std::uint64_t most_deltas = 500;
/// Snapshots of small scenes are not worth the trouble before their deltas fill some pages.
constexpr std::uint64_t least_delta_bytes = 64 << 10;

}  // namespace

Bytes encode_record(const std::string& scene, const SceneDelta& delta) {
    return encode(Message{SceneUpdate{.scene = scene, .delta = delta}, {}}).head;
}

SceneVersion apply_record(const std::string& scene, const SceneVersion& base,
                          std::span<const std::byte> record) {
    if (record.size() < frame_header_bytes) throw std::runtime_error("a record is cut off");
    const FrameHeader header = decode_header(record.first<frame_header_bytes>(), {});
    const auto body = record.subspan(frame_header_bytes);
    if (header.message_bytes != body.size()) throw std::runtime_error("a record is cut off");
    const Message message = decode(header, body, {});
    const auto* update = message.get<SceneUpdate>();
    if (!update || update->scene != scene)
        throw std::runtime_error(fmt::format("a record is none of scene '{}'", scene));
    return apply(base, update->delta);
}

bool snapshot_is_due(const LogSize& log, std::uint64_t delta_bytes) {
    return log.deltas >= most_deltas ||
           log.delta_bytes + delta_bytes > std::max(log.snapshot_bytes, least_delta_bytes);
}

}  // namespace tessera
