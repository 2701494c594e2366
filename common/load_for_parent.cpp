// The child's part of contained_load.h, apart so that a parent need not link what reads files.

#include <fmt/format.h>
#include <signal.h>
#include <sys/prctl.h>
#include <unistd.h>

#include <cstdlib>
#include <cstring>
#include <new>

#include "common/contained_load.h"
#include "common/sandbox.h"
#include "common/scene_sync.h"

namespace tessera {
namespace {

void write_all(int out, std::span<const std::byte> bytes) {
    while (!bytes.empty()) {
        const ssize_t written = write(out, bytes.data(), bytes.size());
        if (written < 0) _exit(EXIT_FAILURE);  // nobody listens any more
        bytes = bytes.subspan(std::size_t(written));
    }
}

void say(int out, Message message) {
    const EncodedMessage encoded = encode(std::move(message));
    write_all(out, encoded.head);
    write_all(out, encoded.payload.bytes);
}

void say(int out, const LoadedScene& loaded) {
    const Scene& scene = loaded.bundle.scene;
    say(out, {SceneUpdate{.scene = {}, .delta = diff({}, {.version = 1, .scene = scene})}, {}});
    for (const BlobId& id : blobs_of(scene))
        for (Message& chunk : chunks_of(id, loaded.bundle.blobs.find(id)))
            say(out, std::move(chunk));
    say(out, {SceneReady{.scene = {}, .version = 1, .modelled = {}, .left_out = loaded.notes}, {}});
}

LoadedScene load_both(const std::string& file_or_name, const std::string& environment) {
    LoadedScene loaded = load_scene(file_or_name);
    if (!environment.empty()) set_environment(loaded.bundle, environment);
    return loaded;
}

}  // namespace

std::optional<int> load_for_parent(int argc, char** argv) {
    if (argc != 5 || std::strcmp(argv[0], reader_name) != 0) return std::nullopt;
    const LoadLimits limits{.memory_bytes = std::strtoull(argv[3], nullptr, 10),
                            .seconds = unsigned(std::strtoul(argv[4], nullptr, 10))};
    prctl(PR_SET_PDEATHSIG, SIGKILL);
    signal(SIGINT, SIG_IGN);  // Ctrl-C is the parent's to answer
    bound_resources(limits.memory_bytes, limits.seconds);
    if (!renounce_network_and_programs())
        fmt::print(stderr, "{}: the system cannot keep scene files from the network\n", argv[1]);
    try {
        say(STDOUT_FILENO, load_both(argv[1], argv[2]));
    } catch (const std::bad_alloc&) {
        say(STDOUT_FILENO, {Failure{0, fmt::format("{}: needs more than {} MB of memory to read",
                                                   argv[1], limits.memory_bytes >> 20)},
                            {}});
    } catch (const std::exception& error) {
        say(STDOUT_FILENO, {Failure{0, error.what()}, {}});
    }
    _exit(EXIT_SUCCESS);  // libraries that met a broken file need not tidy up
}

}  // namespace tessera
