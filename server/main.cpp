// tessera-server: the master of a cluster.

#include <fmt/format.h>
#include <malloc.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdlib>
#include <filesystem>
#include <set>

#include "common/check.h"
#include "common/contained_load.h"
#include "common/log.h"
#include "common/process.h"
#include "server/server.h"

namespace tessera {
namespace {

struct Options {
    std::vector<std::string> scenes;
    bool reload = false;
    ServerConfig config;
    LoadLimits load;
    std::string log_level = "info";
    pid_t parent = 0;
};

/// Buffers of a frame come and go with every frame: their pages are kept, because getting them from
/// the system anew takes longer than filling them. 32 MiB is the most that malloc allows here.
void keep_memory() {
    mallopt(M_MMAP_THRESHOLD, 32 << 20);
    mallopt(M_TRIM_THRESHOLD, 512 << 20);
    mallopt(M_ARENA_MAX, 1);
}

void load(Server& server, const std::string& file_or_name, const std::string& name,
          const LoadLimits& limits) {
    const auto reader = std::filesystem::read_symlink("/proc/self/exe").parent_path() / reader_name;
    const LoadedScene loaded = load_contained(file_or_name, {}, limits, reader);
    for (const std::string& note : loaded.notes) spdlog::info("{}: {}", name, note);
    server.add_scene(name, loaded.bundle);
}

void load_all(Server& server, const Options& options) {
    std::set<std::string> names;
    for (const std::string& scene : options.scenes) {
        const std::string name = std::filesystem::path(scene).filename().string();
        if (!names.insert(name).second)
            throw UserError(fmt::format("two scenes are called '{}'", name));
        // What the journal brought back goes before what files hold.
        if (!server.holds_scene(name) || options.reload) load(server, scene, name, options.load);
    }
}

void run(const Options& options) {
    keep_memory();
    asio::io_context io(1);
    Server server(io, options.config);
    load_all(server, options);

    asio::signal_set signals(io, SIGINT, SIGTERM);
    signals.async_wait([&](const boost::system::error_code&, int) { server.stop(); });
    server.start();
    // The one line on standard output: scripts read it to learn the port.
    fmt::print("listening on {}\n", server.address());
    std::fflush(stdout);
    io.run();
}

/// What peers may ask for at most.
void add_limits(CLI::App& app, Limits& limits, LoadLimits& load) {
    const auto add = [&](const char* name, auto& value, const char* help) {
        using Value = std::remove_reference_t<decltype(value)>;
        return app.add_option(name, value, help)
            ->transform(CLI::AsSizeValue(false))
            ->check(CLI::Range(Value(1), std::numeric_limits<Value>::max()))
            ->group("Limits (512, 64M, 4G...)")
            ->capture_default_str();
    };
    add("--max-sessions", limits.sessions, "workers and viewers together");
    add("--max-handshakes", limits.handshakes, "connections at a time that are not let in yet");
    add("--max-requests", limits.requests, "requests of one viewer in a second");
    add("--max-frames", limits.frames, "frames of one viewer at a time, and views");
    add("--max-message", limits.message_bytes, "bytes of one message")
        ->check(CLI::Range(1u, max_message_bytes));
    add("--max-picture", limits.picture_pixels, "pixels of a picture")
        ->check(CLI::Range(std::uint64_t(1), max_image_pixels));
    add("--max-texture", limits.texture_bytes, "bytes of a texture");
    add("--max-scene", limits.scene_bytes, "bytes of a scene's meshes and textures");
    add("--max-session", limits.session_bytes,
        "bytes of one viewer's own scenes and of pictures on their way to it");
    add("--max-load-memory", load.memory_bytes, "bytes that reading a scene file may take");
    add("--max-load-seconds", load.seconds, "CPU time that reading a scene file may take");
}

}  // namespace
}  // namespace tessera

int main(int argc, char** argv) {
    using namespace tessera;
    Options options;
    CLI::App app(
        "Tessera's server: owns scenes and frames, spreads the work over workers.\n"
        "Peers prove themselves with keys that `tessera keys` makes or, on loopback, with the "
        "token\n"
        "in the environment variable TESSERA_TOKEN.");
    app.add_option("scenes", options.scenes, "scene files, or names of generated scenes, to hold");
    app.add_option("--listen", options.config.listen, "address to listen on; port 0: any free one")
        ->type_name("HOST:PORT")
        ->capture_default_str();
    app.add_option("--keys", options.config.keys,
                   "folder `server` that `tessera keys` made: peers speak TLS and have its tokens; "
                   "needed to listen beyond loopback")
        ->envname("TESSERA_KEYS");
    auto* journal =
        app.add_option("--journal", options.config.journal,
                       "keep open scenes and their edits in this folder: a server that is started "
                       "with it again has them as they were, and does not read their files")
            ->type_name("FOLDER");
    app.add_flag("--reload", options.reload,
                 "read the scenes named here from their files, though the journal has them")
        ->needs(journal);
    app.add_option("--metrics", options.config.metrics,
                   "address of /metrics for Prometheus, /healthz and /readyz?workers=N; anybody "
                   "who reaches it can read them")
        ->type_name("HOST:PORT");
    app.add_option("--relays", options.config.relays,
                   "whether workers get meshes and textures from one another: auto (when that is "
                   "faster), on, off")
        ->transform(CLI::CheckedTransformer(std::map<std::string, RelayMode>{
            {"auto", RelayMode::automatic}, {"on", RelayMode::on}, {"off", RelayMode::off}}))
        ->type_name("MODE");
    app.add_option("--trace", options.config.trace,
                   "file for the timeline of the frame that finished last, for chrome://tracing or "
                   "Perfetto")
        ->type_name("FILE");
    app.add_option("--log", options.log_level, "how much to log")
        ->check(CLI::IsMember({"trace", "debug", "info", "warning", "error", "off"}))
        ->capture_default_str();
    app.add_option("--exit-with-parent", options.parent,
                   "end when the process that started this one ends, and has this number")
        ->type_name("PID");
    add_limits(app, options.config.limits, options.load);
    CLI11_PARSE(app, argc, argv);
    if (options.parent != 0) end_with_parent(options.parent);
    if (const char* token = std::getenv("TESSERA_TOKEN")) options.config.token = token;
    try {
        start_log("server", options.log_level);
        run(options);
    } catch (const UserError& error) {
        fmt::print(stderr, "tessera-server: {}\n", error.what());
        return 1;
    } catch (const std::exception& error) {
        fmt::print(stderr, "tessera-server: {}\n", error.what());
        return 1;
    }
}
