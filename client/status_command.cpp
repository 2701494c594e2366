// tessera status: what a server holds and who works for it.

#include <fmt/format.h>
#include <unistd.h>

#include <chrono>
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
    bool watch = false;
    double interval = 1;  ///< seconds
};

void print_json(const Status& status) {
    nlohmann::json json = {{"build", status.build},
                           {"uptime_seconds", status.uptime_seconds},
                           {"viewers", status.viewers},
                           {"frames_in_flight", status.frames_in_flight},
                           {"frames_done", status.frames_done},
                           {"memory_bytes", status.memory_bytes},
                           {"worker_bytes", status.worker_bytes},
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
                                   {"round_trip_seconds", worker.round_trip_seconds},
                                   {"prefetch", worker.prefetch},
                                   {"task_seconds", worker.task_seconds},
                                   {"memory_bytes", worker.memory_bytes},
                                   {"overdue", worker.overdue},
                                   {"busy_seconds", worker.busy_seconds},
                                   {"relayed_bytes", worker.relayed_bytes},
                                   {"sent_bytes", worker.sent_bytes}});
    fmt::print("{}\n", json.dump(2));
}

WorkerStatus find_worker(const Status& status, std::uint64_t peer) {
    for (const WorkerStatus& worker : status.workers)
        if (worker.peer == peer) return worker;
    return {};
}

/// `before`: an earlier status, for rates; null: rates since the server started.
void print_table(const Status& status, const Status* before) {
    const double seconds = status.uptime_seconds - (before ? before->uptime_seconds : 0);
    const std::uint64_t frames = status.frames_done - (before ? before->frames_done : 0);
    fmt::print(
        "tessera-server {}, up {:.0f} s, {:.0f} MB, {} viewers, {} frames in flight, {} done, "
        "{:.1f} a second\n",
        status.build, status.uptime_seconds, double(status.memory_bytes) / 1e6, status.viewers,
        status.frames_in_flight, status.frames_done, double(frames) / seconds);
    for (const SceneStatus& scene : status.scenes)
        fmt::print("scene   {:<24} version {}, {} instances, {:.1f} MB\n", scene.name,
                   scene.version, scene.instances, double(scene.bytes) / 1e6);
    if (status.workers.empty()) {
        fmt::print("no workers: start `tessera-worker --server HOST:PORT`\n");
        return;
    }
    fmt::print("{:<24} {:<21} {:>7} {:>6} {:>9} {:>9} {:>8} {:>8} {:>12} {:>8} {:>8} {:>10}\n",
               "worker", "address", "threads", "busy", "tiles/s", "Mrays/s", "tile ms", "trip ms",
               "leases/most", "MB", "sent MB", "relayed MB");
    for (const WorkerStatus& worker : status.workers) {
        const WorkerStatus earlier = before ? find_worker(*before, worker.peer) : WorkerStatus{};
        fmt::print(
            "{:<24} {:<21} {:>7} {:>5.0f}% {:>9.1f} {:>9.2f} {:>8.2f} {:>8.2f} {:>12} {:>8.0f} "
            "{:>8.1f} {:>10.1f}{}\n",
            worker.name, worker.address, worker.threads,
            100 * (worker.busy_seconds - earlier.busy_seconds) / (seconds * worker.threads),
            double(worker.tiles - earlier.tiles) / seconds,
            1e-6 * double(worker.rays - earlier.rays) / seconds, 1e3 * worker.task_seconds,
            1e3 * worker.round_trip_seconds, fmt::format("{}/{}", worker.leases, worker.prefetch),
            double(worker.memory_bytes) / 1e6, double(worker.sent_bytes) / 1e6,
            double(worker.relayed_bytes) / 1e6, worker.overdue ? "  overdue" : "");
    }
}

/// Draws the table anew again and again, until the user interrupts.
void watch(RenderClient& client, const StatusOptions& options) {
    using Clock = std::chrono::steady_clock;
    const auto interval = std::chrono::duration_cast<Clock::duration>(
        std::chrono::duration<double>(options.interval));
    Status before = client.status();
    for (;;) {
        client.wait_until(Clock::now() + interval);
        const Status now = client.status();
        if (isatty(STDOUT_FILENO)) fmt::print("\x1b[H\x1b[J");
        options.json ? print_json(now) : print_table(now, &before);
        std::fflush(stdout);
        before = now;
    }
}

void run(const StatusOptions& options) {
    Interrupt interrupt;
    RenderClient client({.address = options.server,
                         .credentials = load_credentials(options.keys),
                         .tick = [&] { interrupt.check(); }});
    if (options.watch) watch(client, options);
    const Status status = client.status();
    options.json ? print_json(status) : print_table(status, nullptr);
}

}  // namespace

void add_status_command(CLI::App& app) {
    auto options = std::make_shared<StatusOptions>();
    CLI::App* command = app.add_subcommand("status", "Show a server's workers, scenes and frames");
    command->add_option("--server", options->server, "HOST:PORT")->required();
    add_keys_option(command, options->keys);
    command->add_flag("--json", options->json, "print JSON");
    command->add_flag("--watch", options->watch, "go on until interrupted");
    command->add_option("--interval", options->interval, "seconds between two looks")
        ->check(CLI::Range(0.1, 3600.0))
        ->capture_default_str();
    command->callback([options] { run(*options); });
}

}  // namespace tessera
