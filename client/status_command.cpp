// tessera status: what a server holds and who works for it.

#include <fmt/format.h>

#include <nlohmann/json.hpp>

#include "client/commands.h"
#include "client/interrupt.h"
#include "client/render_client.h"

namespace tessera {
namespace {

struct StatusOptions {
    std::string server;
    std::string keys;
    bool json = false;
};

void print_json(const Status& status) {
    nlohmann::json json = {{"build", status.build},
                           {"uptime_seconds", status.uptime_seconds},
                           {"viewers", status.viewers},
                           {"frames_in_flight", status.frames_in_flight},
                           {"frames_done", status.frames_done},
                           {"scenes", nlohmann::json::array()},
                           {"workers", nlohmann::json::array()}};
    for (const SceneStatus& scene : status.scenes)
        json["scenes"].push_back({{"name", scene.name},
                                  {"version", scene.version},
                                  {"instances", scene.instances},
                                  {"bytes", scene.bytes}});
    for (const WorkerStatus& worker : status.workers)
        json["workers"].push_back({{"name", worker.name},
                                   {"address", worker.address},
                                   {"threads", worker.threads},
                                   {"leases", worker.leases},
                                   {"tiles", worker.tiles},
                                   {"rays", worker.rays},
                                   {"round_trip_seconds", worker.round_trip_seconds}});
    fmt::print("{}\n", json.dump(2));
}

void print_table(const Status& status) {
    fmt::print("tessera-server {}, up {:.0f} s, {} viewers, {} frames in flight, {} done\n",
               status.build, status.uptime_seconds, status.viewers, status.frames_in_flight,
               status.frames_done);
    for (const SceneStatus& scene : status.scenes)
        fmt::print("scene   {:<24} version {}, {} instances, {:.1f} MB\n", scene.name,
                   scene.version, scene.instances, double(scene.bytes) / 1e6);
    if (status.workers.empty())
        fmt::print("no workers: start `tessera-worker --server HOST:PORT`\n");
    for (const WorkerStatus& worker : status.workers)
        fmt::print(
            "worker  {:<24} {:<21} {:>3} threads  {:>3} leases  {:>9} tiles  {:>6.2f} ms away\n",
            worker.name, worker.address, worker.threads, worker.leases, worker.tiles,
            1e3 * worker.round_trip_seconds);
}

void run(const StatusOptions& options) {
    Interrupt interrupt;
    RenderClient client({.address = options.server,
                         .credentials = load_credentials(options.keys),
                         .tick = [&] { interrupt.check(); }});
    const Status status = client.status();
    options.json ? print_json(status) : print_table(status);
}

}  // namespace

void add_status_command(CLI::App& app) {
    auto options = std::make_shared<StatusOptions>();
    CLI::App* command = app.add_subcommand("status", "Show a server's workers, scenes and frames");
    command->add_option("--server", options->server, "HOST:PORT")->required();
    add_keys_option(command, options->keys);
    command->add_flag("--json", options->json, "print JSON");
    command->callback([options] { run(*options); });
}

}  // namespace tessera
