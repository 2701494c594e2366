// The history of a scene as bytes: what the journal keeps and how a scene comes back from it. Pure.
//
// A record is a SceneUpdate as it travels between peers, so that there is one encoding and one
// decoder, which is fuzzed. The first record of a scene is a snapshot, the delta from version 0;
// the others are deltas, each from the version before. A new snapshot takes the place of all that
// came before it once the deltas outweigh it: the log is then within a constant of what it must
// hold, and writing snapshots costs no more than writing deltas (compare Rosenblum and Ousterhout,
// "The Design and Implementation of a Log-Structured File System", 1992, on cleaning).
#pragma once

#include <span>
#include <string>

#include "common/scene_delta.h"

namespace tessera {

/// Throws UserError when the scene is too large for a record.
Bytes encode_record(const std::string& scene, const SceneDelta& delta);

/// The scene that the records of its history lead to, one after the other, a snapshot first. Throws
/// std::runtime_error for what no server has written: other bytes, other scenes, other versions.
SceneVersion apply_record(const std::string& scene, const SceneVersion& base,
                          std::span<const std::byte> record);

/// The size of a scene's history.
struct LogSize {
    std::uint64_t snapshot_bytes = 0;
    std::uint64_t delta_bytes = 0;
    std::uint64_t deltas = 0;

    bool operator==(const LogSize&) const = default;
};

/// Whether a delta of so many bytes is better not added: a snapshot belongs there.
bool snapshot_is_due(const LogSize& log, std::uint64_t delta_bytes);

}  // namespace tessera
