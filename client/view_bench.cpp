// tessera bench view: how long after a change of camera or scene its first picture is at the
// viewer, on the embedded cluster; and, for as long as is wanted, whether anything piles up.

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
#include <functional>
#include <iterator>
#include <map>
#include <nlohmann/json.hpp>

#include "client/camera_control.h"
#include "client/camera_options.h"
#include "client/commands.h"
#include "client/interrupt.h"
#include "client/local_cluster.h"
#include "client/render_client.h"
#include "common/check.h"
#include "common/clock.h"
#include "common/contained_load.h"
#include "common/process.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds mouse_interval{8};

struct ViewBenchOptions {
    std::string scene = "office";
    CameraOptions camera;
    LocalClusterConfig cluster;
    int changes = 100;
    double seconds = 0;
    std::string json;
};

/// Seconds, one value per change.
struct Latencies {
    std::vector<double> first;  ///< from the change to its first picture at the viewer
    std::vector<double> frame;  ///< of that, from the first tile handed out to the last one folded
    std::size_t waiting = 1;    ///< changes whose picture was still to come, at most

    void add(Clock::time_point changed, const ShownPicture& shown) {
        first.push_back(seconds_since(changed));
        frame.push_back(shown.about.first_seconds);
    }
    /// What all but the frame takes, change by change.
    std::vector<double> beyond() const {
        std::vector<double> out;
        std::ranges::transform(first, frame, std::back_inserter(out), std::minus());
        return out;
    }
    void add(const Latencies& other) {
        first.insert(first.end(), other.first.begin(), other.first.end());
        frame.insert(frame.end(), other.frame.begin(), other.frame.end());
        waiting = std::max(waiting, other.waiting);
    }
};

/// What all who take part hold: what piles up anywhere shows here.
struct Footprint {
    double at = 0;                                     ///< seconds
    std::uint64_t server = 0, worker = 0, viewer = 0;  ///< bytes resident; of the largest worker
    std::uint32_t frames = 0;                          ///< in flight
};

double quantile(std::vector<double> values, double q) {
    std::sort(values.begin(), values.end());
    return values.empty() ? 0 : values[std::size_t(q * double(values.size() - 1) + 0.5)];
}

class ViewBench {
public:
    ViewBench(const ViewBenchOptions& options, RenderClient& client, const Camera& camera)
        : options_(options), client_(client), camera_(camera) {
        view_.request = 1;
        view_.spec.scene = options.scene;
        view_.spec.size = options.camera.size;
        view_.spec.settings.passes = 1u << 20;
        view_.format = PictureFormat::srgb8;
    }

    /// The camera moves a little, each time from a picture that is being refined.
    Latencies camera() {
        return measure([&] { turn(); });
    }

    /// One object moves a little, each time from a picture that is being refined.
    Latencies object() {
        const Instance instance = client_.scene().scene.instances.back();
        return measure([&, instance] {
            const vec3 at(instance.world_from_object[3]);
            offset_ = 0.01f - offset_;
            version_ = client_.scene().version + 1;
            client_.send_edit(options_.scene, {moved(instance, at + vec3(offset_, 0, 0))});
        });
    }

    /// The camera moves all the time, as a hand moves a mouse.
    Latencies drag() {
        Latencies out;
        std::map<std::uint64_t, Clock::time_point> turned_at;
        auto next_turn = Clock::now();
        while (out.first.size() < std::size_t(options_.changes)) {
            if (Clock::now() >= next_turn) {
                next_turn = Clock::now() + mouse_interval;
                turn();
                turned_at[view_.stamp] = Clock::now();
            }
            client_.poll(std::chrono::milliseconds(1));
            const auto shown = client_.take_picture();
            if (!shown || !turned_at.contains(shown->about.stamp)) continue;
            out.waiting = std::max(out.waiting, turned_at.size());
            const auto turned = turned_at.find(shown->about.stamp);
            out.add(turned->second, *shown);
            turned_at.erase(turned_at.begin(), std::next(turned));
        }
        return out;
    }

private:
    /// To and fro, so that all frames are about as much work.
    void turn() {
        ++view_.stamp;
        view_.spec.camera = orbited(camera_, {0.02f * std::sin(0.7f * float(view_.stamp)), 0});
        client_.show(view_);
    }

    ShownPicture next() {
        for (;;) {
            if (auto picture = client_.take_picture()) return std::move(*picture);
            client_.poll(std::chrono::milliseconds(100));
        }
    }

    template <class Change>
    Latencies measure(const Change& change) {
        constexpr std::uint32_t passes_between = 4;
        Latencies out;
        turn();
        ShownPicture shown = next();
        for (int i = 0; i < options_.changes; ++i) {
            while (!is_newest(shown) || shown.about.passes < passes_between) shown = next();
            const auto start = Clock::now();
            change();
            do shown = next();
            while (!is_newest(shown));
            out.add(start, shown);
        }
        return out;
    }

    bool is_newest(const ShownPicture& shown) const {
        return shown.about.stamp == view_.stamp && shown.about.version >= version_;
    }

    const ViewBenchOptions& options_;
    RenderClient& client_;
    Camera camera_;
    View view_;
    std::uint64_t version_ = 0;
    float offset_ = 0;
};

Footprint footprint(RenderClient& client, Clock::time_point start) {
    const Status status = client.status();
    Footprint out{.at = seconds_since(start),
                  .server = status.memory_bytes,
                  .viewer = resident_bytes(),
                  .frames = status.frames_in_flight};
    for (const WorkerStatus& worker : status.workers)
        out.worker = std::max(out.worker, worker.memory_bytes);
    return out;
}

/// By kind of change.
using Round = std::map<std::string, Latencies>;

void print_round(const Round& round) {
    for (const auto& [kind, latencies] : round)
        fmt::print("{:<8} {:>8} {:>8.1f} {:>10.1f} {:>8.1f} {:>8.1f} {:>15} {:>8}\n", kind,
                   latencies.first.size(), 1e3 * quantile(latencies.frame, 0.5),
                   1e3 * quantile(latencies.first, 0.5), 1e3 * quantile(latencies.first, 0.99),
                   1e3 * quantile(latencies.first, 1),
                   fmt::format("{:.1f} / {:.1f}", 1e3 * quantile(latencies.beyond(), 0.5),
                               1e3 * quantile(latencies.beyond(), 0.99)),
                   latencies.waiting);
}

void print(const Footprint& f) {
    fmt::print(
        "after {:.0f} s: server {:.1f} MB, worker {:.1f} MB, viewer {:.1f} MB, frames in flight "
        "{}\n",
        f.at, 1e-6 * double(f.server), 1e-6 * double(f.worker), 1e-6 * double(f.viewer), f.frames);
    std::fflush(stdout);
}

nlohmann::json json_of(const std::string& scene, const Round& round) {
    nlohmann::json results = nlohmann::json::array();
    for (const auto& [kind, latencies] : round)
        results.push_back({{"scene", scene},
                           {"change", kind},
                           {"changes", latencies.first.size()},
                           {"frame_s", quantile(latencies.frame, 0.5)},
                           {"latency_first_s",
                            {{"p50", quantile(latencies.first, 0.5)},
                             {"p95", quantile(latencies.first, 0.95)},
                             {"p99", quantile(latencies.first, 0.99)},
                             {"max", quantile(latencies.first, 1)}}},
                           {"beyond_frame_s",
                            {{"p50", quantile(latencies.beyond(), 0.5)},
                             {"p99", quantile(latencies.beyond(), 0.99)}}},
                           {"most_waiting", latencies.waiting}});
    return results;
}

nlohmann::json json_of(const Footprint& f) {
    return {{"at_s", f.at},
            {"server_bytes", f.server},
            {"worker_bytes", f.worker},
            {"viewer_bytes", f.viewer},
            {"frames_in_flight", f.frames}};
}

void run(const ViewBenchOptions& options) {
    const LoadedScene loaded = load_contained(options.scene);
    const Camera camera = chosen_camera(options.camera, loaded.bundle, [](const std::string&) {});
    Interrupt interrupt;
    LocalCluster cluster(options.cluster);
    RenderClient client(
        {.address = cluster.address(), .credentials = cluster.credentials(), .tick = [&] {
             interrupt.check();
             cluster.check_alive();
         }});
    client.upload_scene(options.scene, loaded.bundle);
    client.share_scene(options.scene);
    client.watch(options.scene);
    ViewBench bench(options, client, camera);

    // Round after round, each of all kinds of changes, and what is held after each.
    fmt::print("{}, milliseconds\n{:<8} {:>8} {:>8} {:>10} {:>8} {:>8} {:>15} {:>8}\n",
               options.scene, "change", "number", "frame", "to first", "p99", "max", "beyond, p99",
               "waiting");
    Round all;
    nlohmann::json rounds = nlohmann::json::array();
    const auto start = Clock::now();
    do {
        Round round{{"camera", bench.camera()}, {"drag", bench.drag()}};
        if (!loaded.bundle.scene.instances.empty()) round["object"] = bench.object();
        print_round(round);
        for (const auto& [kind, latencies] : round) all[kind].add(latencies);
        const Footprint held = footprint(client, start);
        print(held);
        rounds.push_back({{"results", json_of(options.scene, round)}, {"held", json_of(held)}});
    } while (seconds_since(start) < options.seconds);
    if (rounds.size() > 1) {
        fmt::print("all {} rounds\n", rounds.size());
        print_round(all);
    }
    if (options.json.empty()) return;
    std::ofstream out(options.json);
    out << nlohmann::json{{"results", json_of(options.scene, all)}, {"rounds", rounds}}.dump(2)
        << '\n';
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", options.json));
}

}  // namespace

void add_view_bench_command(CLI::App* bench) {
    auto options = std::make_shared<ViewBenchOptions>();
    CLI::App* command =
        bench->add_subcommand("view", "Time from a change to its first picture at a viewer");
    command->add_option("SCENE", options->scene, "a file, or the name of a generated scene")
        ->capture_default_str();
    add_camera_options(command, options->camera);
    command->add_option("--changes", options->changes, "of each kind")
        ->check(CLI::Range(2, 100000))
        ->capture_default_str();
    command
        ->add_option("--seconds", options->seconds,
                     "begin again until so long has passed, and tell each time what is held")
        ->check(CLI::Range(0.0, 1e6));
    command->add_option("--workers", options->cluster.workers, "worker processes")
        ->check(CLI::Range(1, 64))
        ->capture_default_str();
    command->add_option("--threads", options->cluster.threads, "render threads of each worker")
        ->check(CLI::Range(1, 1024));
    command->add_option("--json", options->json, "file to write the results to");
    command->callback([options] { run(*options); });
}

}  // namespace tessera
