// Laws of the journal: whatever is committed is there when it is opened again, also from files as a
// killed server leaves them; whatever is done to the files is noticed; a full disk changes nothing.

#include "server/journal.h"

#include <fmt/format.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/resource.h>

#include <random>

#include "common/check.h"
#include "server/scene_log.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

SceneBundle small_scene(float size) {
    SceneBundle bundle;
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {size, 0, 0}, {0, size, 0}};
    mesh.triangles = {{0, 1, 2}};
    bundle.scene.objects.push_back({.name = "o", .mesh = add_mesh(bundle, mesh), .materials = {0}});
    bundle.scene.materials.emplace_back();
    for (int i = 0; i < 20; ++i)
        bundle.scene.instances.push_back({.name = fmt::format("instance {}", i)});
    return bundle;
}

/// A server's scenes as they change, each change on its way into a journal.
struct Scenes {
    std::map<std::string, ReadyScene> now;
    std::mt19937 random{1};

    SceneChange add(const std::string& name) {
        const SceneBundle bundle = small_scene(float(now.size() + 1));
        now[name] = {.name = name,
                     .scene = std::make_shared<const SceneVersion>(SceneVersion{1, bundle.scene}),
                     .blobs = bundle.blobs};
        return {.scene = name, .before = {}, .after = now[name].scene, .blobs = bundle.blobs};
    }
    SceneChange edit(const std::string& name) {
        ReadyScene& scene = now.at(name);
        SceneVersion next = *scene.scene;
        ++next.version;
        Instance& moved = next.scene.instances[random() % next.scene.instances.size()];
        moved.world_from_object[3].x = float(random() % 1000);
        const auto before = scene.scene;
        scene.scene = std::make_shared<const SceneVersion>(std::move(next));
        return {.scene = name, .before = before, .after = scene.scene, .blobs = scene.blobs};
    }
    /// Each scene's edits in a batch lead from the last version written to the newest.
    SceneChange edits(const std::string& name, int count) {
        SceneChange change = edit(name);
        for (int i = 1; i < count; ++i) change.after = edit(name).after;
        return change;
    }
};

void commit(Journal& journal, const std::vector<SceneChange>& changes) { journal.commit(changes); }

void expect_restored(const std::filesystem::path& folder, const Scenes& scenes) {
    Journal journal(folder);
    const std::vector<ReadyScene> restored = journal.restore();
    ASSERT_EQ(restored.size(), scenes.now.size());
    for (const ReadyScene& scene : restored) {
        const ReadyScene& expected = scenes.now.at(scene.name);
        EXPECT_EQ(*scene.scene, *expected.scene);
        for (const BlobId& id : blobs_of(scene.scene->scene))
            EXPECT_EQ(*scene.blobs.find(id), *expected.blobs.find(id));
    }
}

/// The files as they would be if the server were killed now.
std::filesystem::path killed_now(const TempDir& dir, const std::string& journal) {
    const auto copy = dir.file(journal + " as it was");
    std::filesystem::remove_all(copy);
    std::filesystem::copy(dir.file(journal), copy);
    return copy;
}

TEST(Journal, whatever_is_committed_is_there_after_a_kill) {
    const TempDir dir;
    Scenes scenes;
    Journal journal(dir.file("j"));
    EXPECT_TRUE(journal.restore().empty());
    commit(journal, {scenes.add("a"), scenes.add("b, with a \" and a \n")});
    expect_restored(killed_now(dir, "j"), scenes);
    for (int round = 0; round < 60; ++round) {
        std::vector<SceneChange> changes = {scenes.edits("a", 1 + round % 5)};
        if (round % 3 == 0) changes.push_back(scenes.edit("b, with a \" and a \n"));
        if (round % 20 == 0) changes.push_back(scenes.add(fmt::format("c{}", round)));
        journal.commit(changes);
        if (round % 10 == 9) expect_restored(killed_now(dir, "j"), scenes);
    }
}

TEST(Journal, goes_on_after_it_was_opened_again) {
    const TempDir dir;
    Scenes scenes;
    for (int life = 0; life < 4; ++life) {
        Journal journal(dir.file("j"));
        journal.restore();
        commit(journal, {life == 0 ? scenes.add("a") : scenes.edits("a", 3)});
    }
    expect_restored(dir.file("j"), scenes);
    EXPECT_FALSE(std::filesystem::exists(dir.file("j") / "journal.sqlite-wal"));
}

TEST(Journal, a_scene_may_begin_anew_and_old_meshes_go) {
    const TempDir dir;
    Scenes scenes;
    {
        Journal journal(dir.file("j"));
        commit(journal, {scenes.add("a")});
        SceneVersion next{.version = 2, .scene = {}};
        const SceneBundle other = small_scene(7);
        next.scene = other.scene;
        scenes.now["a"].scene = std::make_shared<const SceneVersion>(next);
        scenes.now["a"].blobs = other.blobs;
        commit(
            journal,
            {{.scene = "a", .before = {}, .after = scenes.now["a"].scene, .blobs = other.blobs}});
    }
    expect_restored(dir.file("j"), scenes);
    expect_restored(dir.file("j"), scenes);
}

TEST(Journal, does_not_grow_without_end) {
    const TempDir dir;
    Scenes scenes;
    {
        Journal journal(dir.file("j"));
        commit(journal, {scenes.add("a")});
        for (int i = 0; i < 600; ++i) commit(journal, {scenes.edit("a")});
    }
    EXPECT_LT(std::filesystem::file_size(dir.file("j") / "journal.sqlite"), 200000u);
    expect_restored(dir.file("j"), scenes);
}

TEST(Journal, meshes_that_come_and_go_take_no_room_for_ever) {
    const TempDir dir;
    Scenes scenes;
    constexpr int edits = 200;
    constexpr std::size_t vertices = 500;
    {
        Journal journal(dir.file("j"));
        commit(journal, {scenes.add("a")});
        for (int i = 0; i < edits; ++i) {
            SceneChange change = scenes.edits("a", 50);
            Mesh mesh;
            mesh.positions.resize(vertices, vec3(float(i)));
            mesh.triangles = {{0, 1, 2}};
            SceneBundle bundle;
            SceneVersion after = *change.after;
            add_mesh(bundle, mesh);
            after.scene.meshes = bundle.scene.meshes;
            scenes.now["a"].scene = std::make_shared<const SceneVersion>(after);
            scenes.now["a"].blobs = bundle.blobs;
            change.after = scenes.now["a"].scene;
            change.blobs = bundle.blobs;
            commit(journal, {change});
        }
    }
    EXPECT_LT(std::filesystem::file_size(dir.file("j") / "journal.sqlite"),
              edits * vertices * sizeof(vec3) / 2);
    expect_restored(dir.file("j"), scenes);
}

TEST(Journal, one_server_each) {
    const TempDir dir;
    const Journal journal(dir.file("j"));
    const std::string message = user_error([&] { Journal second(dir.file("j")); });
    EXPECT_NE(message.find("another server"), std::string::npos) << message;
    EXPECT_NE(message.find("journal.sqlite"), std::string::npos) << message;
}

TEST(Journal, files_of_others_are_refused_and_left_alone) {
    const TempDir dir;
    std::filesystem::create_directory(dir.file("j"));
    const std::string text(5000, 'x');
    dir.write("j/journal.sqlite", text);
    const std::string message = user_error([&] { Journal journal(dir.file("j")); });
    EXPECT_NE(message.find("no journal"), std::string::npos) << message;
    std::ifstream in(dir.file("j/journal.sqlite"));
    EXPECT_EQ(std::string(std::istreambuf_iterator<char>(in), {}), text);
}

/// Puts a big-endian number into the database's header (SQLite's file format, 1.3).
void patch(const std::filesystem::path& folder, long offset, std::uint32_t value) {
    std::fstream file(folder / "journal.sqlite", std::ios::in | std::ios::out | std::ios::binary);
    file.seekp(offset);
    for (int shift = 24; shift >= 0; shift -= 8) file.put(char(value >> shift));
}

TEST(Journal, other_applications_and_newer_formats_are_named) {
    const TempDir dir;
    { Journal journal(dir.file("j")); }
    patch(dir.file("j"), 60, 99);
    std::string message = user_error([&] { Journal journal(dir.file("j")); });
    EXPECT_NE(message.find("format 99"), std::string::npos) << message;
    patch(dir.file("j"), 60, 1);
    patch(dir.file("j"), 68, 12345);
    message = user_error([&] { Journal journal(dir.file("j")); });
    EXPECT_NE(message.find("no journal of tessera-server"), std::string::npos) << message;
}

TEST(Journal, a_folder_that_cannot_be_made_is_named) {
    const TempDir dir;
    dir.write("file", "");
    const std::string message = user_error([&] { Journal journal(dir.file("file/j")); });
    EXPECT_NE(message.find("file/j"), std::string::npos) << message;
}

TEST(Journal, no_damage_goes_unnoticed) {
    const TempDir dir;
    Scenes scenes;
    {
        Journal journal(dir.file("j"));
        commit(journal, {scenes.add("a"), scenes.add("b")});
        for (int i = 0; i < 20; ++i) commit(journal, {scenes.edit("a")});
    }
    std::mt19937 random(2);
    const auto size = std::filesystem::file_size(dir.file("j") / "journal.sqlite");
    int refused = 0;
    for (int round = 0; round < 150; ++round) {
        const auto copy = killed_now(dir, "j");
        {
            std::fstream file(copy / "journal.sqlite",
                              std::ios::in | std::ios::out | std::ios::binary);
            file.seekp(std::streamoff(random() % size));
            file.put(char(random()));
        }
        try {
            expect_restored(copy, scenes);
        } catch (const UserError& error) {
            ++refused;
            EXPECT_NE(std::string(error.what()).find("journal.sqlite"), std::string::npos);
        }
    }
    EXPECT_GT(refused, 10);  // the rest hit bytes that nobody reads
}

TEST(Journal, a_full_disk_is_reported_and_nothing_is_lost) {
    const TempDir dir;
    Scenes scenes;
    Journal journal(dir.file("j"));
    commit(journal, {scenes.add("a")});
    // Files may not grow beyond what they are: as good as no room on the disk.
    rlimit before{};
    ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
    signal(SIGXFSZ, SIG_IGN);
    const rlimit small{.rlim_cur = std::filesystem::file_size(dir.file("j") / "journal.sqlite-wal"),
                       .rlim_max = before.rlim_max};
    ASSERT_EQ(setrlimit(RLIMIT_FSIZE, &small), 0);
    auto kept = scenes.now;
    std::string message;
    try {
        for (;; kept = scenes.now) commit(journal, {scenes.edit("a")});
    } catch (const JournalError& error) {
        message = error.what();
    }
    setrlimit(RLIMIT_FSIZE, &before);
    EXPECT_NE(message.find("make room"), std::string::npos) << message;
    scenes.now = kept;
    expect_restored(killed_now(dir, "j"), scenes);
    // With room it goes on.
    commit(journal, {scenes.edit("a")});
    expect_restored(killed_now(dir, "j"), scenes);
}

TEST(SceneLog, records_are_of_their_scene_and_version_only) {
    const SceneVersion first{1, small_scene(1).scene};
    SceneVersion second = first;
    second.version = 2;
    second.scene.instances.pop_back();
    const Bytes snapshot = encode_record("a", diff({}, first));
    const Bytes delta = encode_record("a", diff(first, second));
    EXPECT_EQ(apply_record("a", apply_record("a", {}, snapshot), delta), second);
    EXPECT_THROW(apply_record("b", {}, snapshot), std::runtime_error);
    EXPECT_THROW(apply_record("a", {}, delta), std::runtime_error);
    for (std::size_t size = 0; size < delta.size(); ++size)
        EXPECT_THROW(apply_record("a", first, std::span(delta).first(size)), std::runtime_error);
}

TEST(SceneLog, snapshots_come_when_deltas_outweigh_them) {
    EXPECT_FALSE(snapshot_is_due({.snapshot_bytes = 1 << 20, .delta_bytes = 1000}, 1000));
    EXPECT_TRUE(snapshot_is_due({.snapshot_bytes = 1 << 20, .delta_bytes = 1 << 20}, 1));
    EXPECT_FALSE(snapshot_is_due({.snapshot_bytes = 10, .delta_bytes = 1000, .deltas = 10}, 100));
    EXPECT_TRUE(snapshot_is_due({.snapshot_bytes = 1 << 30, .delta_bytes = 0, .deltas = 500}, 1));
}

}  // namespace
}  // namespace tessera
