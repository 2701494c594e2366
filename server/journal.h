// The journal: open scenes on disk, so that they outlive the server. One SQLite database in a
// folder, with a write-ahead log (Gray and Reuter, "Transaction Processing", 1993); SQLite is seen
// by journal.cpp alone. What is written is scene_log's business.
//
// Meshes and textures are kept by content, each once. Everything that is read back is checked
// against its SHA-256. What viewers look at is not kept: they say it again when they come back.
#pragma once

#include <filesystem>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "common/scene_sync.h"

namespace tessera {

/// What was to be written is not: the disk is full or broken. `what()` tells the viewer.
struct JournalError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

/// A scene that leads from one version, the last that was written, to another.
struct SceneChange {
    std::string scene;
    std::shared_ptr<const SceneVersion> before;  ///< null: a new scene, or one that begins anew
    std::shared_ptr<const SceneVersion> after;
    BlobStore blobs;  ///< those that `after` names
};

class Journal {
public:
    /// Opens the journal in `folder`, or makes one. Throws UserError, naming the file and what to
    /// do, when another server has it, when it is damaged, foreign or of a newer release.
    explicit Journal(const std::filesystem::path& folder);
    /// Leaves one file, with nothing in the write-ahead log.
    ~Journal();

    /// All scenes in their newest versions, oldest scene first; comes before the first commit.
    /// Throws UserError when the journal is damaged.
    std::vector<ReadyScene> restore();

    /// Writes all of the changes or none; they are on disk when it returns. May take as long as
    /// the disk. Throws JournalError.
    void commit(std::span<const SceneChange> changes);

private:
    struct State;
    std::unique_ptr<State> state_;
};

}  // namespace tessera
