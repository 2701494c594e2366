// Meshes and textures on disk, so that a worker that is started again need not have them sent
// again: a file for each, named by the SHA-256 of its bytes. The folder itself is all the state
// there is, and it may be shared, damaged or taken away at any time: a file counts only if its
// content has that hash, comes into being whole (written beside, then renamed) and goes when it was
// not used for longest (by its time of modification) and there is no room.
#pragma once

#include <cstdint>
#include <filesystem>
#include <memory>
#include <span>
#include <system_error>

#include "common/blob.h"

namespace tessera {

/// `find` and `put` may run at the same time, in any number of processes; each worker keeps the
/// folder under its own limit, beside what others are just writing.
class BlobCache {
public:
    /// Keeps at most so many bytes in `folder`, which is made if need be, readable by this user
    /// only. Warns when it cannot be written.
    BlobCache(std::filesystem::path folder, std::uint64_t most_bytes);

    /// The blob; null when it is not here. A file that is damaged is removed, with a warning.
    std::shared_ptr<const Bytes> find(const BlobId& id) const;

    /// Writes a blob, unless it is here or larger than the folder may be; those not used for
    /// longest go for it. One call at a time. Returns false, with a warning, when the disk does not
    /// take it.
    bool put(const BlobId& id, std::span<const std::byte> bytes);

private:
    std::filesystem::path path_of(const BlobId& id) const;
    void make_room(std::uint64_t bytes);
    void warn_of(const std::error_code& error) const;

    std::filesystem::path folder_;
    std::uint64_t most_bytes_;
    std::uint64_t room_ = 0;  ///< bytes that may be written before the folder is looked through
};

}  // namespace tessera
