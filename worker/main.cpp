// tessera-worker: renders tiles for a server.

#include <fmt/format.h>
#include <unistd.h>

#include <CLI/CLI.hpp>
#include <csignal>
#include <cstdlib>
#include <limits>
#include <thread>

#include "common/check.h"
#include "common/log.h"
#include "common/process.h"
#include "worker/worker.h"

namespace {

using namespace tessera;

struct Options {
    std::string server;
    unsigned threads = std::max(std::thread::hardware_concurrency(), 1u);
    std::string keys;
    std::string name;
    std::string plugins;
    unsigned attempts = 0;
    std::uint16_t relay_port = 0;
    std::string blob_cache;
    std::uint64_t blob_cache_size = WorkerConfig{}.blob_cache_bytes;
    bool no_relay = false;
    std::string log = "info";
    pid_t parent = 0;
};

std::string default_name() {
    char host[256] = "worker";
    gethostname(host, sizeof host - 1);
    return fmt::format("{}/{}", host, getpid());
}

void declare(CLI::App& app, Options& options) {
    app.set_version_flag("--version", TESSERA_VERSION);
    app.add_option("--server", options.server, "Where tessera-server listens, HOST:PORT")
        ->required();
    app.add_option(
        "--keys", options.keys,
        "Folder `worker` that `tessera keys` made, for a server that speaks TLS (default: "
        "TESSERA_KEYS)");
    app.add_option("--threads", options.threads, "Render threads")
        ->check(CLI::Range(1u, 4096u))
        ->capture_default_str();
    app.add_option("--name", options.name,
                   "How the server's status calls this worker (default: host/process)");
    app.add_option("--attempts", options.attempts,
                   "Attempts to connect in a row before giving up (0: never gives up)")
        ->capture_default_str();
    app.add_option("--relay-port", options.relay_port,
                   "Port where other workers get meshes and textures that this one has, by the "
                   "same keys (0: any free one)")
        ->capture_default_str();
    app.add_flag("--no-relay", options.no_relay,
                 "Gets everything from the server, and has nothing for other workers");
    app.add_option("--blob-cache", options.blob_cache,
                   "Keeps meshes and textures in this folder, so that after a restart they need "
                   "not be sent again; several workers may share it")
        ->type_name("FOLDER");
    app.add_option("--blob-cache-size", options.blob_cache_size,
                   "Most bytes there; those not used for longest go first")
        ->transform(CLI::AsSizeValue(false))
        ->check(CLI::Range(std::uint64_t(1), std::numeric_limits<std::uint64_t>::max()))
        ->default_str("4G");
    app.add_option("--plugins", options.plugins,
                   "Folder of shader plug-ins: shared objects that define what "
                   "worker/tessera_shader.h says")
        ->type_name("FOLDER");
    app.add_option("--log", options.log, "Least level that is logged")
        ->check(CLI::IsMember({"trace", "debug", "info", "warning", "error", "off"}))
        ->capture_default_str();
    app.add_option("--exit-with-parent", options.parent,
                   "End when the process that started this one ends, and has this number")
        ->type_name("PID");
    app.footer(
        "Without keys the environment variable TESSERA_TOKEN holds the server's token, if it asks "
        "for one.");
}

std::shared_ptr<const ShaderTable> shaders_of(const std::string& folder) {
    if (folder.empty()) return built_in_shaders();
    const auto table = std::make_shared<ShaderTable>();
    for (const std::string& complaint : table->load(folder)) spdlog::warn("{}", complaint);
    return table;
}

WorkerConfig config_of(const Options& options) {
    WorkerConfig config{.server = parse_address(options.server),
                        .threads = options.threads,
                        .name = options.name.empty() ? default_name() : options.name,
                        .credentials = load_credentials(options.keys),
                        .shaders = shaders_of(options.plugins),
                        .relays = !options.no_relay,
                        .relay_port = options.relay_port,
                        .blob_cache = options.blob_cache,
                        .blob_cache_bytes = options.blob_cache_size,
                        .attempts = std::nullopt};
    if (options.attempts > 0) config.attempts = options.attempts;
    return config;
}

/// A worker that is asked to stop has this long for what it has begun; others do the rest.
constexpr auto leave_deadline = std::chrono::seconds(5);

/// Serves until a signal ends it or the worker gives up, which throws.
void serve(const WorkerConfig& config) {
    asio::io_context io(1);
    Worker worker(config);
    asio::signal_set signals(io, SIGINT, SIGTERM);
    asio::steady_timer patience(io);
    signals.async_wait([&](const boost::system::error_code& error, int) {
        if (error) return;
        spdlog::info("finishes the tiles it has been handed, then stops");
        signals.clear();  // a second signal ends the process at once
        if (!worker.leave()) return io.stop();
        patience.expires_after(leave_deadline);
        patience.async_wait([&](const boost::system::error_code&) { io.stop(); });
    });
    std::exception_ptr failure;
    asio::co_spawn(io, worker.run(), [&](std::exception_ptr error) {
        failure = error;
        io.stop();
    });
    io.run();
    if (failure) std::rethrow_exception(failure);
}

}  // namespace

int main(int argc, char** argv) {
    CLI::App app("Renders tiles for a tessera-server.", "tessera-worker");
    Options options;
    declare(app, options);
    CLI11_PARSE(app, argc, argv);
    if (options.parent != 0) end_with_parent(options.parent);
    start_log("tessera-worker", options.log);
    try {
        serve(config_of(options));
        return EXIT_SUCCESS;
    } catch (const UserError& error) {
        spdlog::error("{}", error.what());
    } catch (const std::exception& error) {
        spdlog::error("unexpected: {}", error.what());
    }
    return EXIT_FAILURE;
}
