// Scene files read by a child process are what they are when read here, and whatever happens to the
// child is a complaint that names the file.

#include "common/contained_load.h"

#include <gtest/gtest.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>

#include "common/check.h"
#include "common/image_io.h"
#include "common/sandbox.h"
#include "tests/scene_checks.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

const std::filesystem::path program = std::filesystem::path(TESSERA_PROGRAMS) / reader_name;

LoadedScene load(const std::string& file, const std::string& environment = {}) {
    return load_contained(file, environment, {}, program);
}

/// A program that does this instead of loading.
std::filesystem::path script(const TempDir& dir, const std::string& what) {
    const auto file = dir.write("script", "#!/bin/sh\n" + what + "\n");
    std::filesystem::permissions(file, std::filesystem::perms::owner_all);
    return file;
}

TEST(ContainedLoad, is_what_loading_is) {
    const TempDir dir;
    write_srgb8(std::vector<std::uint8_t>(3 * 6, 77), {3, 2}, dir.file("wood.png"));
    dir.write("a.mtl", "newmtl wood\nmap_Kd wood.png\n");
    const std::string file = dir.write("a.obj",
                                       "mtllib a.mtl\nusemtl wood\nv 0 0 0\nv 1 0 0\nv 0 1 0\n"
                                       "vt 0 0\nf 1/1 2/1 3/1\nf 1/1 1/1 2/1\n");
    write_image(Image({4, 2}, 3), dir.file("sky.exr"));
    LoadedScene here = load_scene(file);
    ASSERT_FALSE(here.notes.empty());
    set_environment(here.bundle, dir.file("sky.exr"));
    const LoadedScene there = load(file, dir.file("sky.exr"));
    EXPECT_TRUE(there.bundle.scene == here.bundle.scene);
    EXPECT_EQ(there.notes, here.notes);
    EXPECT_EQ(there.bundle.blobs.size(), here.bundle.blobs.size());
    for (const BlobId& id : blobs_of(here.bundle.scene))
        EXPECT_EQ(*there.bundle.blobs.find(id), *here.bundle.blobs.find(id));
}

TEST(ContainedLoad, generated_scenes_need_no_child) {
    const LoadedScene scene = load_contained("cornell", "0.5", {}, "/no/such/program");
    EXPECT_EQ(scene.bundle.scene.environment.radiance, vec3(0.5f));
}

TEST(ContainedLoad, complaints_are_those_of_loading) {
    const TempDir dir;
    const std::string broken = dir.write("broken.obj", "v 1 2\nf 1 2 99\n");
    for (const std::string& file : {broken, dir.file("gone.ply").string(), std::string("nobody")})
        EXPECT_EQ(user_error([&] { load(file); }), user_error([&] { load_scene(file); }));
}

TEST(ContainedLoad, what_happens_to_the_child_names_the_file) {
    const TempDir dir;
    const auto complaint = [&](const std::string& behaviour) {
        const auto instead = script(dir, behaviour);
        return user_error([&] { load_contained("a.ply", {}, {}, instead); });
    };
    EXPECT_NE(complaint("kill -SEGV $$").find("a.ply: its reader crashed (Segmentation fault)"),
              std::string::npos);
    EXPECT_NE(complaint("kill -XCPU $$").find("a.ply: takes more than 600 s"), std::string::npos);
    EXPECT_NE(complaint("exit 3").find("a.ply: its reader ended with status 3"), std::string::npos);
    EXPECT_NE(complaint("echo nonsense, and enough of it").find("a.ply: its reader says nonsense"),
              std::string::npos);
    EXPECT_NE(user_error([] { load_contained("a.ply", {}, {}, "/no/such/program"); }), "");
}

TEST(SandboxDeathTest, there_is_no_network_and_no_other_program) {
    const auto forbidden = [](auto call) { return call() < 0 && errno == EPERM; };
    EXPECT_EXIT(
        {
            const bool done = renounce_network_and_programs();
            const bool alone = forbidden([] { return socket(AF_INET, SOCK_STREAM, 0); }) &&
                               forbidden([] { return execl("/bin/true", "true", nullptr); }) &&
                               close(dup(STDERR_FILENO)) == 0;
            _exit(done && alone ? 7 : 1);
        },
        testing::ExitedWithCode(7), "");
}

TEST(SandboxDeathTest, memory_has_an_end) {
    if (!address_space_can_be_bounded) GTEST_SKIP() << "the sanitizer needs all address space";
    EXPECT_EXIT(
        {
            bound_resources(std::uint64_t(1) << 30, 60);
            _exit(std::malloc(std::size_t(1) << 30) == nullptr ? 7 : 1);
        },
        testing::ExitedWithCode(7), "");
}

}  // namespace
}  // namespace tessera
