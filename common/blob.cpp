#include "common/blob.h"

#include <openssl/sha.h>

#include <algorithm>
#include <set>

namespace tessera {

BlobId blob_id(std::span<const std::byte> bytes) {
    BlobId id;
    SHA256(reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size(), id.digest.data());
    return id;
}

std::string full_name(const BlobId& id) {
    static constexpr char digits[] = "0123456789abcdef";
    std::string out;
    for (const std::uint8_t byte : id.digest) {
        out += digits[byte >> 4];
        out += digits[byte & 15];
    }
    return out;
}

std::string short_name(const BlobId& id) { return full_name(id).substr(0, 12); }

BlobId BlobStore::insert(Bytes bytes) {
    const BlobId id = blob_id(bytes);
    blobs_.try_emplace(id, std::make_shared<const Bytes>(std::move(bytes)));
    return id;
}

void BlobStore::insert(const BlobId& id, std::shared_ptr<const Bytes> blob) {
    blobs_.try_emplace(id, std::move(blob));
}

std::shared_ptr<const Bytes> BlobStore::find(const BlobId& id) const {
    const auto it = blobs_.find(id);
    return it == blobs_.end() ? nullptr : it->second;
}

void BlobStore::merge(const BlobStore& other) {
    blobs_.insert(other.blobs_.begin(), other.blobs_.end());
}

std::uint64_t BlobStore::bytes() const {
    std::uint64_t sum = 0;
    for (const auto& [id, blob] : blobs_) sum += blob->size();
    return sum;
}

void BlobStore::keep_only(std::span<const BlobId> wanted) {
    const std::set<BlobId> keep(wanted.begin(), wanted.end());
    std::erase_if(blobs_, [&](const auto& entry) { return !keep.contains(entry.first); });
}

}  // namespace tessera
