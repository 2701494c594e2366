#include "common/contained_load.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "common/check.h"
#include "common/generator.h"
#include "common/scene_sync.h"
#include "common/text_reader.h"

extern char** environ;

namespace tessera {
namespace {

/// Everything but what is none of the child's business: tokens and keys.
std::vector<char*> childs_environment() {
    std::vector<char*> out;
    for (char** entry = environ; *entry; ++entry)
        if (!std::string_view(*entry).starts_with("TESSERA_")) out.push_back(*entry);
    out.push_back(nullptr);
    return out;
}

/// A child that loads, and the pipe from it. Gone with this object.
class LoadingChild {
public:
    LoadingChild(const std::filesystem::path& program, std::vector<std::string> arguments) {
        int ends[2];
        if (pipe2(ends, O_CLOEXEC) != 0) throw UserError("cannot make a pipe for a scene's reader");
        from_child_ = ends[0];
        std::vector<char*> argv;
        for (std::string& argument : arguments) argv.push_back(argument.data());
        argv.push_back(nullptr);
        posix_spawn_file_actions_t actions;
        posix_spawn_file_actions_init(&actions);
        posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
        posix_spawn_file_actions_adddup2(&actions, ends[1], STDOUT_FILENO);
        posix_spawn_file_actions_addclosefrom_np(&actions, STDERR_FILENO + 1);
        const int error = posix_spawn(&pid_, program.c_str(), &actions, nullptr, argv.data(),
                                      childs_environment().data());
        posix_spawn_file_actions_destroy(&actions);
        close(ends[1]);
        if (error == 0) return;
        close(from_child_);
        throw UserError(fmt::format("cannot start a scene's reader: {}", std::strerror(error)));
    }
    ~LoadingChild() {
        close(from_child_);
        if (pid_ == 0) return;
        kill(pid_, SIGKILL);
        end();
    }
    LoadingChild(const LoadingChild&) = delete;
    LoadingChild& operator=(const LoadingChild&) = delete;

    /// The next message, or none when the child has closed the pipe. Throws ProtocolError.
    std::optional<Message> hear() {
        std::array<std::byte, frame_header_bytes> head;
        if (!read_all(head)) return std::nullopt;
        const FrameHeader header = decode_header(head, {});
        const std::size_t size = std::size_t(header.message_bytes) + header.payload_bytes;
        const auto block = std::make_shared_for_overwrite<std::byte[]>(size);
        const std::span body(block.get(), size);
        if (!read_all(body)) return std::nullopt;
        return decode(header, body.first(header.message_bytes),
                      {block, body.subspan(header.message_bytes)});
    }

    /// Waits for the end of the child; returns its wait status.
    int end() {
        const pid_t pid = std::exchange(pid_, 0);
        int status = 0;
        while (waitpid(pid, &status, 0) < 0 && errno == EINTR) {
        }
        return status;
    }

private:
    bool read_all(std::span<std::byte> bytes) {
        while (!bytes.empty()) {
            const ssize_t got = read(from_child_, bytes.data(), bytes.size());
            if (got < 0 && errno == EINTR) continue;
            if (got <= 0) return false;
            bytes = bytes.subspan(std::size_t(got));
        }
        return true;
    }

    int from_child_ = -1;
    pid_t pid_ = 0;
};

std::string describe_end(int status, const LoadLimits& limits) {
    if (!WIFSIGNALED(status))
        return fmt::format("its reader ended with status {}", WEXITSTATUS(status));
    const int signal = WTERMSIG(status);
    if (signal == SIGXCPU || signal == SIGALRM)
        return fmt::format("takes more than {} s to read", limits.seconds);
    return fmt::format("its reader crashed ({}); the file is broken in a way that nobody expected",
                       strsignal(signal));
}

/// What the child says, up to the scene, its own complaint (a UserError) or its end (nothing).
std::optional<LoadedScene> hear_scene(LoadingChild& child, const LoadLimits& limits) {
    SceneReceiver receiver({.scenes = 1, .blob_bytes = limits.memory_bytes});
    while (const std::optional<Message> message = child.hear()) {
        if (const auto* update = message->get<SceneUpdate>())
            receiver.update(*update);
        else if (const auto* chunk = message->get<BlobChunk>())
            receiver.add(*chunk, message->payload.bytes);
        else if (const auto* failure = message->get<Failure>())
            throw UserError(failure->reason);
        else if (const auto* done = message->get<SceneReady>())
            if (std::optional<ReadyScene> ready = receiver.take_ready())
                return LoadedScene{.bundle = {ready->scene->scene, ready->blobs},
                                   .notes = done->left_out};
    }
    return std::nullopt;
}

/// What needs no file.
std::optional<LoadedScene> generated(const std::string& name, const std::string& environment) {
    double radiance = 0;
    if (!environment.empty() && !parse_number(environment, radiance)) return std::nullopt;
    std::optional<SceneBundle> bundle = generate_scene(name);
    if (!bundle) return std::nullopt;
    if (!environment.empty()) bundle->scene.environment.radiance = vec3(float(radiance));
    return LoadedScene{.bundle = std::move(*bundle), .notes = {}};
}

}  // namespace

LoadedScene load_contained(const std::string& file_or_name, const std::string& environment,
                           const LoadLimits& limits, const std::filesystem::path& program) {
    if (std::optional<LoadedScene> scene = generated(file_or_name, environment)) return *scene;
    LoadingChild child(program,
                       {reader_name, file_or_name, environment, std::to_string(limits.memory_bytes),
                        std::to_string(limits.seconds)});
    try {
        if (std::optional<LoadedScene> loaded = hear_scene(child, limits)) return *loaded;
    } catch (const ProtocolError& error) {
        throw UserError(
            fmt::format("{}: its reader says nonsense: it {}", file_or_name, error.what()));
    }
    throw UserError(fmt::format("{}: {}", file_or_name, describe_end(child.end(), limits)));
}

}  // namespace tessera
