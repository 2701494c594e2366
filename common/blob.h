// Content-addressed large data. Meshes and textures leave the scene as blobs, named by the SHA-256
// of their bytes, so that each is sent to a peer once and a scene version costs only what changed.
#pragma once

#include <array>
#include <compare>
#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <vector>

namespace tessera {

using Bytes = std::vector<std::byte>;

/// The SHA-256 of a blob's bytes.
struct BlobId {
    std::array<std::uint8_t, 32> digest{};

    auto operator<=>(const BlobId&) const = default;
};

BlobId blob_id(std::span<const std::byte> bytes);

/// All 64 hexadecimal digits.
std::string full_name(const BlobId& id);

/// The first 12 of them, for logs.
std::string short_name(const BlobId& id);

/// Blobs by id. Copies share the bytes.
class BlobStore {
public:
    /// Keeps `bytes` and returns its id; a blob already held is kept once.
    BlobId insert(Bytes bytes);
    /// The same for a blob whose id is known.
    void insert(const BlobId& id, std::shared_ptr<const Bytes> blob);
    /// Null when the blob is not held.
    std::shared_ptr<const Bytes> find(const BlobId& id) const;
    bool contains(const BlobId& id) const { return blobs_.contains(id); }
    /// Adds all blobs of `other`.
    void merge(const BlobStore& other);
    std::size_t size() const { return blobs_.size(); }
    /// Bytes of all blobs together.
    std::uint64_t bytes() const;
    /// Drops every blob that is not in `wanted`.
    void keep_only(std::span<const BlobId> wanted);

private:
    std::map<BlobId, std::shared_ptr<const Bytes>> blobs_;
};

}  // namespace tessera
