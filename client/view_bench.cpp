// tessera bench view: how long after a change of camera or scene its first picture is at the
// viewer, on the embedded cluster; and what a change of the scene costs.

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <fstream>
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

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::chrono::milliseconds mouse_interval{8};

struct ViewBenchOptions {
    std::string scene = "office";
    CameraOptions camera;
    LocalClusterConfig cluster;
    int changes = 100;
    std::string json;
};

/// Seconds, one value per change.
struct Latencies {
    std::vector<double> first;  ///< from the change to its first picture at the viewer
    std::vector<double> frame;  ///< of that, from the first tile handed out to the last one folded

    void add(Clock::time_point changed, const ShownPicture& shown) {
        first.push_back(seconds_since(changed));
        frame.push_back(shown.about.first_seconds);
    }
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
            out.add(turned_at.at(shown->about.stamp), *shown);
            turned_at.erase(shown->about.stamp);
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

nlohmann::json report(const std::string& scene, const char* name, const Latencies& latencies) {
    const double frame = quantile(latencies.frame, 0.5);
    const double median = quantile(latencies.first, 0.5), p99 = quantile(latencies.first, 0.99);
    fmt::print("{:<14} {:<8} {:>8.1f} {:>10.1f} {:>8.1f} {:>8.1f}\n", scene, name, 1e3 * frame,
               1e3 * median, 1e3 * p99, 1e3 * quantile(latencies.first, 1));
    return {{"scene", scene},
            {"change", name},
            {"frame_s", frame},
            {"latency_first_s",
             {{"p50", median},
              {"p95", quantile(latencies.first, 0.95)},
              {"p99", p99},
              {"max", quantile(latencies.first, 1)}}}};
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
    fmt::print("{:<14} {:<8} {:>8} {:>10} {:>8} {:>8}   milliseconds\n", "scene", "change", "frame",
               "to first", "p99", "max");
    nlohmann::json results = nlohmann::json::array();
    results.push_back(report(options.scene, "camera", bench.camera()));
    results.push_back(report(options.scene, "drag", bench.drag()));
    if (!loaded.bundle.scene.instances.empty())
        results.push_back(report(options.scene, "object", bench.object()));
    if (options.json.empty()) return;
    std::ofstream out(options.json);
    out << nlohmann::json{{"results", results}}.dump(2) << '\n';
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
    command->add_option("--workers", options->cluster.workers, "worker processes")
        ->check(CLI::Range(1, 64))
        ->capture_default_str();
    command->add_option("--threads", options->cluster.threads, "render threads of each worker")
        ->check(CLI::Range(1, 1024));
    command->add_option("--json", options->json, "file to write the results to");
    command->callback([options] { run(*options); });
}

}  // namespace tessera
