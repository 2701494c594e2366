// tessera-server: the master of a cluster.

#include <fmt/format.h>
#include <malloc.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdlib>
#include <filesystem>

#include "common/check.h"
#include "common/log.h"
#include "common/process.h"
#include "common/scene_io.h"
#include "server/server.h"

namespace tessera {
namespace {

struct Options {
    std::vector<std::string> scenes;
    ServerConfig config;
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

void load(Server& server, const std::string& file_or_name) {
    const LoadedScene loaded = load_scene(file_or_name);
    const std::string name = std::filesystem::path(file_or_name).filename().string();
    for (const std::string& note : loaded.notes) spdlog::info("{}: {}", name, note);
    server.add_scene(name, loaded.bundle);
}

void run(const Options& options) {
    keep_memory();
    asio::io_context io(1);
    Server server(io, options.config);
    for (const std::string& scene : options.scenes) load(server, scene);

    asio::signal_set signals(io, SIGINT, SIGTERM);
    signals.async_wait([&](const boost::system::error_code&, int) { server.stop(); });
    server.start();
    // The one line on standard output: scripts read it to learn the port.
    fmt::print("listening on {}\n", server.address());
    std::fflush(stdout);
    io.run();
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
    app.add_option(
           "--metrics", options.config.metrics,
           "address at which Prometheus finds metrics; anybody who reaches it can read them")
        ->type_name("HOST:PORT");
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
