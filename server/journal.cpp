#include "server/journal.h"

#include <fmt/format.h>
#include <sqlite3.h>

#include <algorithm>
#include <cstring>
#include <map>
#include <set>
#include <utility>

#include "common/check.h"
#include "server/scene_log.h"

namespace tessera {
namespace {

/// Marks the file as ours ("TSRJ") and tells how it is to be read.
constexpr int application = 0x5453524a;
constexpr int format = 1;
/// Blobs are cut into rows of so many bytes: SQLite takes less than 1 GB in one.
constexpr std::size_t part_bytes = 64 << 20;

struct SqliteError : std::runtime_error {
    int code;
    SqliteError(int c, const std::string& what) : std::runtime_error(what), code(c) {}
};

std::span<const std::byte> bytes_of(const std::string& text) {
    return std::as_bytes(std::span(text));
}

/// One prepared statement, run once per `run` or read row by row.
class Statement {
public:
    Statement(sqlite3* database, const char* sql) : database_(database) {
        check(sqlite3_prepare_v2(database, sql, -1, &statement_, nullptr));
    }
    ~Statement() { sqlite3_finalize(statement_); }
    Statement(const Statement&) = delete;
    Statement& operator=(const Statement&) = delete;

    /// The bytes must stay until the row has been made.
    Statement& bind(int place, std::span<const std::byte> bytes) {
        // A null pointer would bind NULL, not an empty value.
        const void* data = bytes.empty() ? "" : static_cast<const void*>(bytes.data());
        check(sqlite3_bind_blob64(statement_, place, data, bytes.size(), SQLITE_STATIC));
        return *this;
    }
    Statement& bind(int place, std::uint64_t number) {
        check(sqlite3_bind_int64(statement_, place, sqlite3_int64(number)));
        return *this;
    }
    /// Whether there is a (next) row.
    bool step() {
        const int code = sqlite3_step(statement_);
        if (code == SQLITE_ROW) return true;
        if (code != SQLITE_DONE) check(code);
        return false;
    }
    void run() {
        step();
        check(sqlite3_reset(statement_));
    }
    std::uint64_t number(int column) const {
        return std::uint64_t(sqlite3_column_int64(statement_, column));
    }
    /// Valid until the next step.
    std::span<const std::byte> bytes(int column) const {
        const void* data = sqlite3_column_blob(statement_, column);
        return {static_cast<const std::byte*>(data),
                std::size_t(sqlite3_column_bytes(statement_, column))};
    }

private:
    void check(int code) const {
        if (code != SQLITE_OK) throw SqliteError(code, sqlite3_errmsg(database_));
    }

    sqlite3* database_;
    sqlite3_stmt* statement_ = nullptr;
};

BlobId digest_of(std::span<const std::byte> stored) {
    BlobId id;
    if (stored.size() != id.digest.size()) throw std::runtime_error("a digest is cut off");
    std::memcpy(id.digest.data(), stored.data(), stored.size());
    return id;
}

void make_folder(const std::filesystem::path& folder) {
    std::error_code error;
    // Scenes may be confidential.
    if (std::filesystem::create_directories(folder, error))
        std::filesystem::permissions(folder, std::filesystem::perms::owner_all, error);
    if (error)
        throw UserError(
            fmt::format("--journal {}: cannot make this folder: {}; choose one that this user may "
                        "write",
                        folder.string(), error.message()));
}

}  // namespace

struct Journal::State {
    /// A scene as the file holds it.
    struct Kept {
        std::uint64_t id = 0;
        std::uint64_t version = 0;
        LogSize size;
        std::set<BlobId> blobs;  ///< that its versions since the snapshot name
    };
    using Scenes = std::map<std::string, Kept>;

    std::string file;
    sqlite3* database = nullptr;
    Scenes scenes;

    explicit State(const std::filesystem::path& folder)
        : file((folder / "journal.sqlite").string()) {}
    ~State() {
        if (!database) return;
        sqlite3_exec(database, "PRAGMA wal_checkpoint(TRUNCATE)", nullptr, nullptr, nullptr);
        sqlite3_close(database);
    }

    void exec(const char* sql) { Statement(database, sql).run(); }
    std::uint64_t number(const char* sql) {
        Statement query(database, sql);
        return query.step() ? query.number(0) : 0;
    }

    // ---- Opening ----

    void open() {
        const int code = sqlite3_open_v2(
            file.c_str(), &database,
            SQLITE_OPEN_READWRITE | SQLITE_OPEN_CREATE | SQLITE_OPEN_NOMUTEX, nullptr);
        if (code != SQLITE_OK) throw SqliteError(code, sqlite3_errmsg(database));
        sqlite3_extended_result_codes(database, 0);
        // The lock is held until we close. The write-ahead log's index is then in our memory, so
        // that the folder may be on a network's file system, too.
        exec("PRAGMA locking_mode = EXCLUSIVE");
        const bool fresh = number("SELECT count(*) FROM sqlite_schema") == 0 &&
                           number("PRAGMA application_id") == 0;
        if (!fresh) check_format();
        exec("PRAGMA journal_mode = WAL");
        // Nothing may be written elsewhere, and there is little to sort.
        exec("PRAGMA temp_store = MEMORY");
        // Every commit waits until it is on the disk.
        exec("PRAGMA synchronous = FULL");
        exec("BEGIN EXCLUSIVE");
        if (fresh) make_tables();
        exec("COMMIT");
    }

    void check_format() {
        const std::uint64_t version = number("PRAGMA user_version");
        if (number("PRAGMA application_id") != application)
            throw UserError(
                fmt::format("{} is a database, but no journal of tessera-server; give another "
                            "folder for --journal",
                            file));
        if (version != format)
            throw UserError(
                fmt::format("{} has format {}, and this release reads format {}; install the "
                            "release that wrote it, or give another folder for --journal",
                            file, version, format));
    }

    void make_tables() {
        exec("CREATE TABLE scene (id INTEGER PRIMARY KEY, name BLOB UNIQUE NOT NULL)");
        exec(
            "CREATE TABLE record (scene INTEGER NOT NULL, version INTEGER NOT NULL, "
            "digest BLOB NOT NULL, bytes BLOB NOT NULL, PRIMARY KEY (scene, version))");
        exec(
            "CREATE TABLE blob (digest BLOB NOT NULL, part INTEGER NOT NULL, "
            "bytes BLOB NOT NULL, PRIMARY KEY (digest, part))");
        exec(fmt::format("PRAGMA application_id = {}", application).c_str());
        exec(fmt::format("PRAGMA user_version = {}", format).c_str());
    }

    [[noreturn]] void refuse(const SqliteError& error) const {
        const char* advice = "is it a file that this user may write?";
        if (error.code == SQLITE_BUSY)
            advice = "another server has it open; give each server a folder of its own";
        if (error.code == SQLITE_NOTADB)
            advice = "it is no journal; give another folder for --journal";
        if (error.code == SQLITE_CORRUPT) refuse_damaged(error.what());
        throw UserError(fmt::format("{}: {}: {}", file, error.what(), advice));
    }
    [[noreturn]] void refuse_damaged(const std::string& reason) const {
        throw UserError(fmt::format(
            "{} is damaged: {}; put a copy from a backup in its place, or move the folder away to "
            "begin with no scenes",
            file, reason));
    }

    // ---- Reading ----

    /// Records that are whole may still be too few: the tables must agree with their indices.
    void check_tables() {
        Statement query(database, "PRAGMA integrity_check(1)");
        query.step();
        const auto result = query.bytes(0);
        const std::string text(reinterpret_cast<const char*>(result.data()), result.size());
        if (text != "ok") throw std::runtime_error(text);
    }

    std::vector<ReadyScene> restore() {
        check_tables();
        std::vector<ReadyScene> out;
        Statement query(database, "SELECT id, name FROM scene ORDER BY id");
        while (query.step()) {
            const auto stored = query.bytes(1);
            const std::string name(reinterpret_cast<const char*>(stored.data()), stored.size());
            out.push_back(restore_scene(name, query.number(0)));
        }
        try {
            drop_unused_blobs();
        } catch (const SqliteError&) {
            // A full disk is no reason not to start; they go another time.
        }
        return out;
    }

    ReadyScene restore_scene(const std::string& name, std::uint64_t id) {
        Kept& kept = scenes[name];
        kept.id = id;
        SceneVersion scene;
        Statement query(database,
                        "SELECT digest, bytes FROM record WHERE scene = ? ORDER BY version");
        query.bind(1, id);
        while (query.step()) {
            const auto record = query.bytes(1);
            if (blob_id(record) != digest_of(query.bytes(0)))
                throw std::runtime_error(
                    fmt::format("a record of scene '{}' has changed on the disk", name));
            scene = apply_record(name, scene, record);
            count(kept.size, record.size());
        }
        kept.version = scene.version;
        ReadyScene out{.name = name, .scene = {}, .blobs = {}};
        for (const BlobId& blob : blobs_of(scene.scene)) {
            kept.blobs.insert(blob);
            out.blobs.insert(read_blob(blob));
        }
        out.scene = std::make_shared<const SceneVersion>(std::move(scene));
        return out;
    }

    /// A scene's first record is its snapshot.
    static void count(LogSize& size, std::uint64_t bytes) {
        if (size.snapshot_bytes == 0) {
            size.snapshot_bytes = bytes;
        } else {
            size.delta_bytes += bytes;
            ++size.deltas;
        }
    }

    Bytes read_blob(const BlobId& id) {
        Statement query(database, "SELECT bytes FROM blob WHERE digest = ? ORDER BY part");
        query.bind(1, std::as_bytes(std::span(id.digest)));
        Bytes bytes;
        while (query.step()) {
            const auto part = query.bytes(0);
            bytes.insert(bytes.end(), part.begin(), part.end());
        }
        if (blob_id(bytes) != id)
            throw std::runtime_error(
                fmt::format("mesh or texture {} has changed on the disk", short_name(id)));
        return bytes;
    }

    static bool is_named(const Scenes& by, const BlobId& id) {
        return std::ranges::any_of(by, [&](const auto& s) { return s.second.blobs.contains(id); });
    }

    /// Those of versions that are no longer kept.
    std::vector<BlobId> unused_blobs() {
        std::vector<BlobId> unused;
        Statement query(database, "SELECT DISTINCT digest FROM blob");
        while (query.step())
            if (const BlobId id = digest_of(query.bytes(0)); !is_named(scenes, id))
                unused.push_back(id);
        return unused;
    }
    void drop_unused_blobs() {
        for (const BlobId& id : unused_blobs()) drop_blob(id);
    }
    void drop_blob(const BlobId& id) {
        Statement drop(database, "DELETE FROM blob WHERE digest = ?");
        drop.bind(1, std::as_bytes(std::span(id.digest))).run();
    }

    // ---- Writing ----

    void commit(std::span<const SceneChange> changes) {
        Scenes scenes_then = scenes;
        exec("BEGIN IMMEDIATE");
        for (const SceneChange& change : changes) write_change(change, scenes_then);
        exec("COMMIT");
        scenes = std::move(scenes_then);
    }

    void write_blob(const BlobId& id, const Bytes& blob) {
        Statement insert(database, "INSERT INTO blob (digest, part, bytes) VALUES (?, ?, ?)");
        for (std::size_t part = 0; part * part_bytes < blob.size(); ++part) {
            const std::size_t size = std::min(part_bytes, blob.size() - part * part_bytes);
            insert.bind(1, std::as_bytes(std::span(id.digest)))
                .bind(2, part)
                .bind(3, std::span(blob).subspan(part * part_bytes, size))
                .run();
        }
    }

    void write_change(const SceneChange& change, Scenes& kept_scenes) {
        const auto [found, added] = kept_scenes.try_emplace(change.scene);
        Kept& kept = found->second;
        if (added) kept.id = add_scene(change.scene);
        const std::vector<BlobId> named = blobs_of(change.after->scene);
        for (const BlobId& id : named) {
            if (!is_named(kept_scenes, id)) write_blob(id, *change.blobs.find(id));
            kept.blobs.insert(id);
        }
        Bytes record;
        bool snapshot = !change.before;
        if (!snapshot) {
            CHECK_EQ(kept.version, change.before->version);
            record = encode_record(change.scene, diff(*change.before, *change.after));
            snapshot = snapshot_is_due(kept.size, record.size());
        }
        if (snapshot) {
            record = encode_record(change.scene, diff(SceneVersion{}, *change.after));
            Statement(database, "DELETE FROM record WHERE scene = ?").bind(1, kept.id).run();
            kept.size = {};
            for (const BlobId& id : std::exchange(kept.blobs, {named.begin(), named.end()}))
                if (!is_named(kept_scenes, id)) drop_blob(id);
        }
        count(kept.size, record.size());
        kept.version = change.after->version;
        const BlobId digest = blob_id(record);
        Statement(database,
                  "INSERT INTO record (scene, version, digest, bytes) VALUES (?, ?, ?, ?)")
            .bind(1, kept.id)
            .bind(2, kept.version)
            .bind(3, std::as_bytes(std::span(digest.digest)))
            .bind(4, record)
            .run();
    }

    std::uint64_t add_scene(const std::string& name) {
        Statement(database, "INSERT INTO scene (name) VALUES (?)").bind(1, bytes_of(name)).run();
        return std::uint64_t(sqlite3_last_insert_rowid(database));
    }

    void roll_back() {
        if (sqlite3_get_autocommit(database) == 0)
            sqlite3_exec(database, "ROLLBACK", nullptr, nullptr, nullptr);
    }
};

Journal::Journal(const std::filesystem::path& folder) : state_(std::make_unique<State>(folder)) {
    make_folder(folder);
    try {
        state_->open();
    } catch (const SqliteError& error) {
        state_->refuse(error);
    }
}

Journal::~Journal() = default;

std::vector<ReadyScene> Journal::restore() {
    try {
        return state_->restore();
    } catch (const std::runtime_error& error) {
        state_->refuse_damaged(error.what());
    }
}

void Journal::commit(std::span<const SceneChange> changes) {
    try {
        state_->commit(changes);
    } catch (const SqliteError& error) {
        state_->roll_back();
        throw JournalError(
            fmt::format("nothing is changed, because the server's journal {} cannot be written "
                        "({}): make room there and try again",
                        state_->file, error.what()));
    } catch (const std::exception& error) {
        state_->roll_back();
        throw JournalError(error.what());
    }
}

}  // namespace tessera
