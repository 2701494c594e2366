// Laws of the blobs on disk: whatever is put, asked for and damaged in whatever order, what comes
// back is nothing or has the hash asked for, and the folder stays under its limit.

#include "worker/blob_cache.h"

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/resource.h>

#include <random>
#include <thread>

#include "common/log.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;

struct Blob {
    Bytes bytes;
    BlobId id;
};

Blob blob_of(std::size_t size, std::uint32_t seed) {
    std::mt19937 random(seed);
    Bytes bytes(size);
    for (std::byte& b : bytes) b = std::byte(random());
    const BlobId id = blob_id(bytes);
    return {std::move(bytes), id};
}

std::vector<Blob> some_blobs(int count, std::size_t largest) {
    std::vector<Blob> blobs;
    for (int i = 0; i < count; ++i)
        blobs.push_back(blob_of(i * largest / std::size_t(count - 1), std::uint32_t(i)));
    return blobs;
}

/// Where the blob is if it is in the folder.
fs::path file_of(const TempDir& folder, const Blob& blob) {
    return folder.file(full_name(blob.id) + ".blob");
}

std::uint64_t bytes_in(const fs::path& folder) {
    std::uint64_t sum = 0;
    for (const auto& file : fs::directory_iterator(folder)) sum += file.file_size();
    return sum;
}

void overwrite(const fs::path& path, const Bytes& bytes) {
    std::ofstream(path, std::ios::binary)
        .write(reinterpret_cast<const char*>(bytes.data()), std::streamsize(bytes.size()));
}

TEST(BlobCache, gives_back_what_was_put_or_nothing_and_stays_under_its_limit) {
    constexpr std::uint64_t limit = 20000;
    const std::vector<Blob> blobs = some_blobs(20, 5000);
    const TempDir folder;
    std::mt19937 random(1);
    std::set<BlobId> damaged;
    int found = 0;
    spdlog::set_level(spdlog::level::off);  // of hundreds of damaged files
    for (int worker = 0; worker < 200; ++worker) {
        BlobCache cache(folder.file(""), limit);
        for (int i = 0; i < 10; ++i) {
            const Blob& blob = blobs[random() % blobs.size()];
            const fs::path file = file_of(folder, blob);
            switch (random() % 4) {
                case 0:
                    if (fs::exists(file) && !blob.bytes.empty()) {
                        Bytes other = blob.bytes;
                        other[0] ^= std::byte(1 + random() % 255);
                        // What grows behind the cache's back is beyond it.
                        if (random() % 2 == 0) other.resize(random() % other.size());
                        other.resize(std::min<std::size_t>(other.size(), fs::file_size(file)));
                        overwrite(file, other);
                        damaged.insert(blob.id);
                    }
                    break;
                case 1:
                    fs::remove(file);
                    damaged.erase(blob.id);
                    break;
                case 2:
                    if (!fs::exists(file)) damaged.erase(blob.id);
                    EXPECT_TRUE(cache.put(blob.id, blob.bytes));
                    EXPECT_TRUE(fs::exists(file));
                    EXPECT_LE(bytes_in(folder.file("")), limit);
                    break;
                default: {
                    const bool whole = fs::exists(file) && !damaged.contains(blob.id);
                    const auto bytes = cache.find(blob.id);
                    ASSERT_EQ(bytes != nullptr, whole);
                    EXPECT_EQ(fs::exists(file), whole) << "what is damaged is removed";
                    if (bytes) {
                        EXPECT_EQ(*bytes, blob.bytes);
                        ++found;
                    }
                    damaged.erase(blob.id);
                }
            }
        }
    }
    EXPECT_GT(found, 100);
    spdlog::set_level(spdlog::level::info);
}

TEST(BlobCache, what_was_not_used_for_longest_goes_first) {
    const TempDir folder;
    BlobCache cache(folder.file("cache"), 400);
    std::vector<Blob> blobs;
    for (std::uint32_t i = 0; i < 5; ++i) blobs.push_back(blob_of(100, i));
    for (int i = 0; i < 4; ++i) cache.put(blobs[i].id, blobs[i].bytes);
    EXPECT_TRUE(cache.find(blobs[0].id));
    cache.put(blobs[1].id, blobs[1].bytes);
    cache.put(blobs[4].id, blobs[4].bytes);
    for (int i = 0; i < 5; ++i) EXPECT_EQ(cache.find(blobs[i].id) != nullptr, i != 2) << i;
}

TEST(BlobCache, what_others_left_in_the_folder_counts_if_it_is_ours) {
    const TempDir folder;
    const Blob blob = blob_of(300, 1);
    const std::string unfinished = full_name(blob.id) + ".blob.aB3xYz";  // its worker was killed
    folder.write(unfinished, std::string(300, 'x'));
    folder.write("film.blob", std::string(1000, 'x'));
    BlobCache cache(folder.file(""), 400);
    EXPECT_TRUE(cache.put(blob.id, blob.bytes));
    EXPECT_TRUE(fs::exists(folder.file("film.blob")));
    EXPECT_FALSE(fs::exists(folder.file(unfinished)));
}

TEST(BlobCache, a_blob_larger_than_the_folder_may_be_is_not_kept) {
    const TempDir folder;
    const Blob small = blob_of(100, 1), large = blob_of(401, 2);
    BlobCache cache(folder.file(""), 400);
    EXPECT_TRUE(cache.put(small.id, small.bytes));
    EXPECT_TRUE(cache.put(large.id, large.bytes));
    EXPECT_FALSE(cache.find(large.id));
    EXPECT_TRUE(cache.find(small.id));
}

TEST(BlobCache, a_damaged_file_is_named) {
    const TempDir folder;
    const Blob blob = blob_of(300, 1);
    BlobCache cache(folder.file(""), 400);
    cache.put(blob.id, blob.bytes);
    fs::resize_file(file_of(folder, blob), 299);
    testing::internal::CaptureStdout();
    EXPECT_FALSE(cache.find(blob.id));
    const std::string log = testing::internal::GetCapturedStdout();
    EXPECT_NE(log.find(file_of(folder, blob).string()), std::string::npos) << log;
}

TEST(BlobCache, nobody_else_can_read_it) {
    const TempDir folder;
    const Blob blob = blob_of(300, 1);
    BlobCache cache(folder.file("a/cache"), 400);
    cache.put(blob.id, blob.bytes);
    constexpr fs::perms others = fs::perms::group_all | fs::perms::others_all;
    EXPECT_EQ(fs::status(folder.file("a/cache")).permissions() & others, fs::perms::none);
    for (const auto& file : fs::directory_iterator(folder.file("a/cache")))
        EXPECT_EQ(file.status().permissions() & others, fs::perms::none);
}

TEST(BlobCache, a_disk_that_takes_nothing_is_no_disaster) {
    const TempDir folder;
    const Blob blob = blob_of(3000, 1);
    BlobCache nowhere(folder.write("file", "") / "cache", 4000);
    EXPECT_FALSE(nowhere.put(blob.id, blob.bytes));
    EXPECT_FALSE(nowhere.find(blob.id));

    BlobCache cache(folder.file("cache"), 4000);
    signal(SIGXFSZ, SIG_IGN);
    rlimit before{};
    getrlimit(RLIMIT_FSIZE, &before);
    const rlimit full{2000, before.rlim_max};
    setrlimit(RLIMIT_FSIZE, &full);
    EXPECT_FALSE(cache.put(blob.id, blob.bytes));
    EXPECT_FALSE(cache.find(blob.id));
    EXPECT_TRUE(fs::is_empty(folder.file("cache")));
    setrlimit(RLIMIT_FSIZE, &before);
    EXPECT_TRUE(cache.put(blob.id, blob.bytes));
    EXPECT_TRUE(cache.find(blob.id));
}

TEST(BlobCache, workers_share_a_folder) {
    const TempDir folder;
    const std::vector<Blob> blobs = some_blobs(10, 2000);
    const auto work = [&](std::uint32_t seed) {
        BlobCache cache(folder.file("cache"), 6000);
        std::mt19937 random(seed);
        for (int i = 0; i < 500; ++i) {
            const Blob& blob = blobs[random() % blobs.size()];
            if (random() % 2 == 0) cache.put(blob.id, blob.bytes);
            const auto bytes = cache.find(blob.id);
            EXPECT_TRUE(!bytes || *bytes == blob.bytes);
        }
    };
    std::vector<std::jthread> workers;
    for (std::uint32_t seed = 0; seed < 4; ++seed) workers.emplace_back(work, seed);
    workers.clear();
    for (const Blob& blob : blobs) {
        BlobCache cache(folder.file("cache"), 6000);
        EXPECT_TRUE(cache.put(blob.id, blob.bytes));
        EXPECT_EQ(*cache.find(blob.id), blob.bytes);
    }
}

}  // namespace
}  // namespace tessera
