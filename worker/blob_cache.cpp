#include "worker/blob_cache.h"

#include <fcntl.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <string>
#include <utility>
#include <vector>

#include "common/log.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;

constexpr const char* suffix = ".blob";

/// A blob's file, or one that is being written, or was when a worker was killed: it has a second
/// suffix.
bool is_ours(const std::string& name) {
    constexpr std::size_t digits = 64;
    return name.find_first_not_of("0123456789abcdef") == digits &&
           name.compare(digits, std::strlen(suffix), suffix) == 0;
}

std::error_code last_error() { return {errno, std::generic_category()}; }

/// Marks the file as used now; returns whether it is there. By a finer clock than the kernel's own,
/// which gives files the same time that are used within a few milliseconds.
bool mark_used(const fs::path& path) {
    std::error_code error;
    fs::last_write_time(path, fs::file_time_type::clock::now(), error);
    return !error;
}

/// Nothing when it cannot be read to the end, or is larger than anything that is kept.
std::shared_ptr<const Bytes> read_file(const fs::path& path, std::uint64_t most_bytes) {
    std::error_code error;
    const std::uint64_t size = fs::is_regular_file(path, error) ? fs::file_size(path, error) : 0;
    if (error || size > most_bytes) return nullptr;
    const auto bytes = std::make_shared<Bytes>(size);
    std::ifstream file(path, std::ios::binary);
    file.read(reinterpret_cast<char*>(bytes->data()), std::streamsize(size));
    return file ? bytes : nullptr;
}

/// Writes beside, then renames. Should a power cut leave a file unfinished under its final name, it
/// has another hash: nothing need wait for the disk here.
std::error_code write_file(const fs::path& path, std::span<const std::byte> bytes) {
    std::string beside = path.string() + ".XXXXXX";
    const int fd = mkostemp(beside.data(), O_CLOEXEC);
    if (fd < 0) return last_error();
    std::error_code error;
    while (!bytes.empty() && !error) {
        const ssize_t written = ::write(fd, bytes.data(), bytes.size());
        if (written >= 0)
            bytes = bytes.subspan(std::size_t(written));
        else if (errno != EINTR)
            error = last_error();
    }
    if (close(fd) != 0 && !error) error = last_error();
    if (!error) {
        mark_used(beside);
        fs::rename(beside, path, error);
    }
    if (error) unlink(beside.c_str());
    return error;
}

struct KeptFile {
    fs::file_time_type used;
    std::uint64_t bytes = 0;
    fs::path path;

    auto operator<=>(const KeptFile&) const = default;
};

/// Those of ours in the folder, used longest ago first.
std::vector<KeptFile> kept_files(const fs::path& folder) {
    std::vector<KeptFile> files;
    std::error_code error;
    for (fs::directory_iterator it(folder, error), end; !error && it != end; it.increment(error)) {
        if (!is_ours(it->path().filename().string())) continue;
        std::error_code gone;
        const KeptFile file{it->last_write_time(gone), it->file_size(gone), it->path()};
        if (!gone) files.push_back(file);
    }
    std::sort(files.begin(), files.end());
    return files;
}

}  // namespace

BlobCache::BlobCache(fs::path folder, std::uint64_t most_bytes)
    : folder_(std::move(folder)), most_bytes_(most_bytes) {
    std::error_code error;
    if (fs::create_directories(folder_, error))
        fs::permissions(folder_, fs::perms::owner_all, error);
    if (access(folder_.c_str(), R_OK | W_OK | X_OK) != 0) warn_of(last_error());
}

void BlobCache::warn_of(const std::error_code& error) const {
    spdlog::warn("cannot keep meshes and textures in {}: {}", folder_.string(), error.message());
}

fs::path BlobCache::path_of(const BlobId& id) const { return folder_ / (full_name(id) + suffix); }

std::shared_ptr<const Bytes> BlobCache::find(const BlobId& id) const {
    const fs::path path = path_of(id);
    std::error_code error;
    if (!fs::exists(path, error)) return nullptr;
    auto bytes = read_file(path, most_bytes_);
    if (bytes && blob_id(*bytes) == id) {
        mark_used(path);
        return bytes;
    }
    // Not if another worker, which took it for the one used longest ago, was faster.
    if (fs::remove(path, error) || error)
        spdlog::warn("{} is damaged and was removed{}", path.string(),
                     error ? ", or should be: " + error.message() : "");
    return nullptr;
}

bool BlobCache::put(const BlobId& id, std::span<const std::byte> bytes) {
    const fs::path path = path_of(id);
    if (bytes.size() > most_bytes_ || mark_used(path)) return true;
    if (bytes.size() > room_) make_room(bytes.size());
    if (const std::error_code error = write_file(path, bytes)) {
        warn_of(error);
        return false;
    }
    room_ -= bytes.size();
    return true;
}

/// An eighth of the folder at least, so that it is looked through now and then only, and others who
/// share it do not fill it unnoticed.
void BlobCache::make_room(std::uint64_t bytes) {
    room_ = std::max(bytes, most_bytes_ / 8);
    const std::vector<KeptFile> files = kept_files(folder_);
    std::uint64_t total = 0;
    for (const KeptFile& file : files) total += file.bytes;
    for (const KeptFile& file : files) {
        if (total <= most_bytes_ - room_) return;
        std::error_code ignored;
        fs::remove(file.path, ignored);
        total -= file.bytes;
    }
}

}  // namespace tessera
