// tessera bench cluster: loads servers of several sizes, prints a table, writes JSON and CSV.

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <nlohmann/json.hpp>

#include "client/camera_options.h"
#include "client/cluster_bench.h"
#include "client/commands.h"
#include "client/edit_json.h"
#include "client/plot.h"
#include "client/progress_bar.h"
#include "client/restart_bench.h"
#include "common/animate.h"
#include "common/check.h"
#include "common/contained_load.h"
#include "common/scene_bounds.h"
#include "common/scene_io.h"

namespace tessera {
namespace {

struct ClusterOptions {
    std::string scene = "cornell";
    ClusterBenchConfig config;
    CameraOptions camera;
    std::vector<int> workers{1, 2};
    std::vector<int> viewers{1};
    double tile_ms = 0;
    double delay_ms = 0, jitter_ms = 0, mbit = 0;
    LinkConfig link;  ///< what of it is not in these
    std::optional<Integrator> integrator;
    std::optional<std::uint32_t> passes;
    int views = 4;
    std::string replay;
    double animate = 0;     ///< frames per second of the motion; 0: nothing moves
    float shape_error = 0;  ///< as edits_at() takes it
    std::string json, csv, svg;
    bool simulate = false;
    int server_kills = 0;
    double server_down = 0;
};

/// Steps to the side, each a fiftieth of the distance to what the camera looks at.
std::vector<Camera> walk(const Camera& camera, int views) {
    const vec3 step = 0.02f * glm::cross(camera.at - camera.eye, glm::normalize(camera.up));
    std::vector<Camera> path;
    for (int i = 0; i < views; ++i) {
        path.push_back(camera);
        path.back().eye += float(i) * step;
        path.back().at += float(i) * step;
    }
    return path;
}

/// Against synthetic workers that never wait; of real ones, against as many times the first row.
std::optional<double> efficiency(const ClusterBenchRow& row, const ClusterBenchRow& first) {
    if (row.ideal_tiles_per_s) return row.tiles_per_s / *row.ideal_tiles_per_s;
    if (row.config.synthetic || first.tiles_per_s == 0) return {};
    return row.tiles_per_s * first.config.workers / (first.tiles_per_s * row.config.workers);
}

void print_header(const ClusterOptions& options, const FrameSpec& spec) {
    fmt::print("{} at {}x{}, {} {} passes, {} workers of {} thread(s), {}\n", options.scene,
               spec.size.width, spec.size.height, spec.settings.passes,
               spec.settings.integrator == Integrator::igi ? "igi" : "path",
               options.config.synthetic ? "synthetic" : "real", options.config.threads,
               options.config.keys.empty() ? "plain" : "TLS");
    fmt::print("{:>7} {:>7} {:>8} {:>9} {:>6} {:>27} {:>27} {:>9} {:>8} {:>6}\n", "workers",
               "viewers", "frames/s", "tiles/s", "effic.", "first p50/p95/p99/max ms",
               "final p50/p95/p99/max ms", "CPU/tile", "MB/frame", "wrong");
}

void print_row(const ClusterBenchRow& row, std::optional<double> efficiency) {
    const auto times = [](const Percentiles& p) {
        return fmt::format("{:.1f}/{:.1f}/{:.1f}/{:.1f}", 1e3 * p.p50, 1e3 * p.p95, 1e3 * p.p99,
                           1e3 * p.max);
    };
    fmt::print("{:>7} {:>7} {:>8.2f} {:>9.0f} {:>6} {:>27} {:>27} {:>6.2f} us {:>8.2f} {:>6}\n",
               row.config.workers, row.config.viewers, row.frames_per_s, row.tiles_per_s,
               efficiency ? fmt::format("{:.3f}", *efficiency) : "-", times(row.first),
               times(row.final), 1e6 * row.server_cpu_s_per_tile,
               1e-6 * (row.bytes_from_workers + row.bytes_to_viewer), row.wrong_pixels);
    if (row.config.viewers > 1)
        fmt::print("        frames of each viewer: {:.2f} to {:.2f} of the mean\n", row.least_share,
                   row.most_share);
    if (row.early && row.late)
        fmt::print(
            "        server: {:.1f} MB and {} descriptors after {:.1f} s, {:.1f} MB and {} after "
            "{:.1f} s\n",
            1e-6 * double(row.early->memory_bytes), row.early->descriptors, row.early->at,
            1e-6 * double(row.late->memory_bytes), row.late->descriptors, row.late->at);
    for (const FaultReport& fault : row.faults)
        fmt::print("        {} after {:.2f} s: that frame {:.1f} ms later\n", fault.kind, fault.at,
                   1e3 * fault.recovery);
    std::fflush(stdout);
}

nlohmann::json json_of(const Percentiles& p) {
    return {{"p50", p.p50}, {"p95", p.p95}, {"p99", p.p99}, {"max", p.max}};
}

nlohmann::json json_of(const ClusterBenchRow& row, std::optional<double> efficiency) {
    nlohmann::json bytes = {{"to_viewer", row.bytes_to_viewer},
                            {"from_workers", row.bytes_from_workers}};
    if (row.bytes_to_workers) bytes["to_workers"] = *row.bytes_to_workers;
    nlohmann::json json = {{"workers", row.config.workers},
                           {"threads", row.config.threads},
                           {"synthetic", row.config.synthetic},
                           {"tile_seconds", row.config.tile_seconds},
                           {"viewers", row.config.viewers},
                           {"viewer_shares", {row.least_share, row.most_share}},
                           {"in_flight", row.config.in_flight},
                           {"width", row.config.spec.size.width},
                           {"height", row.config.spec.size.height},
                           {"seconds", row.seconds},
                           {"frames", row.frames},
                           {"frames_per_s", row.frames_per_s},
                           {"tiles_per_s", row.tiles_per_s},
                           {"efficiency", nullptr},
                           {"latency_first_s", json_of(row.first)},
                           {"latency_final_s", json_of(row.final)},
                           {"server_cpu_s_per_tile", row.server_cpu_s_per_tile},
                           {"bytes_per_frame", bytes},
                           {"recovery_s", nullptr},
                           {"faults", nlohmann::json::array()},
                           {"server", nlohmann::json::array()},
                           {"wrong_pixels", row.wrong_pixels},
                           {"interrupted", row.interrupted}};
    if (efficiency) json["efficiency"] = *efficiency;
    for (const auto& seen : {row.early, row.late})
        if (seen)
            json["server"].push_back({{"at_s", seen->at},
                                      {"memory_bytes", seen->memory_bytes},
                                      {"descriptors", seen->descriptors}});
    double longest = 0;
    for (const FaultReport& fault : row.faults) {
        longest = std::max(longest, fault.recovery);
        json["faults"].push_back(
            {{"kind", fault.kind}, {"at_s", fault.at}, {"recovery_s", fault.recovery}});
    }
    if (!row.faults.empty()) json["recovery_s"] = longest;
    return json;
}

void write(const std::string& file, const std::string& text) {
    if (file.empty()) return;
    std::ofstream out(file);
    out << text;
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", file));
}

std::string csv_of(const nlohmann::json& rows) {
    const std::vector<std::string> columns{"workers",      "viewers",    "frames_per_s",
                                           "tiles_per_s",  "efficiency", "server_cpu_s_per_tile",
                                           "wrong_pixels", "recovery_s"};
    std::string text = fmt::format("{}", fmt::join(columns, ","));
    for (const char* latency : {"latency_first_s", "latency_final_s"})
        for (const char* p : {"p50", "p95", "p99", "max"})
            text += fmt::format(",{}_{}", latency, p);
    for (const auto& row : rows) {
        text += '\n';
        for (const std::string& column : columns)
            text += (row[column].is_null() ? "" : row[column].dump()) + ',';
        for (const char* latency : {"latency_first_s", "latency_final_s"})
            for (const char* p : {"p50", "p95", "p99", "max"}) text += row[latency][p].dump() + ',';
        text.pop_back();
    }
    return text + '\n';
}

/// Tiles a second against workers, a series for each number of viewers.
std::string plot(const std::string& title, const std::vector<ClusterBenchRow>& rows) {
    std::map<int, PlotSeries> series;
    for (const ClusterBenchRow& row : rows) {
        PlotSeries& s = series[row.config.viewers];
        s.name = fmt::format("{} viewer(s)", row.config.viewers);
        s.points.push_back(
            {double(row.config.workers), row.tiles_per_s,
             fmt::format("{} workers: {:.0f} tiles/s", row.config.workers, row.tiles_per_s)});
    }
    PlotSeries ideal{.name = "as many times the first", .line = true, .points = {}};
    for (const ClusterBenchRow& row : rows)
        ideal.points.push_back(
            {double(row.config.workers),
             rows.front().tiles_per_s * row.config.workers / rows.front().config.workers,
             {}});
    std::vector<PlotSeries> all{ideal};
    for (auto& [viewers, s] : series) all.push_back(std::move(s));
    return log_log_plot(title, std::move(all));
}

LinkConfig link_of(const ClusterOptions& options) {
    LinkConfig link = options.link;
    link.delay = 1e-3 * options.delay_ms;
    link.jitter = 1e-3 * options.jitter_ms;
    link.bits_per_second = 1e6 * options.mbit;
    return link;
}

/// The scene's own motion, a step further in each view.
void animate(const ClusterOptions& options, SceneBundle& bundle, ClusterBenchConfig& config) {
    if (bundle.motion.empty())
        throw UserError(fmt::format("{}: nothing in it moves by itself", options.scene));
    for (std::size_t i = 0; i < config.path.size(); ++i) {
        const MotionEdits edits =
            edits_at(bundle.scene, bundle.motion, double(i) / options.animate, options.shape_error);
        config.scenes.push_back(apply_edits(bundle.scene, edits.operations).scene);
        bundle.blobs.merge(edits.blobs);
    }
}

/// Views of a recording and the scene at the time of each, evenly spread.
void replay(const ClusterOptions& options, const SceneBundle& bundle, ClusterBenchConfig& config) {
    const Camera begin = config.path.front();
    std::vector<std::pair<Camera, Scene>> steps;
    Scene scene = bundle.scene;
    make_names_unique(scene);
    Camera camera = begin;
    for (const TimedEdit& step : load_timed_edits(options.replay, scene)) {
        scene = apply_edits(std::move(scene), step.operations).scene;
        camera = step.view.value_or(camera);
        steps.emplace_back(camera, scene);
    }
    if (steps.empty()) throw UserError(fmt::format("{}: nothing in it", options.replay));
    config.path.clear();
    const std::size_t views = std::min(steps.size(), std::size_t(options.views));
    for (std::size_t i = 0; i < views; ++i) {
        config.path.push_back(steps[i * steps.size() / views].first);
        config.scenes.push_back(steps[i * steps.size() / views].second);
    }
}

ClusterBenchConfig config_of(const ClusterOptions& options, SceneBundle& bundle) {
    ClusterBenchConfig config = options.config;
    config.tile_seconds = 1e-3 * options.tile_ms;
    const LinkConfig link = link_of(options);
    if (link != LinkConfig{.seed = link.seed}) config.link = link;
    config.spec.scene = options.scene;
    config.spec.size = options.camera.size;
    // Synthetic workers send what is least to send: finished pixels.
    RenderSettings& settings = config.spec.settings;
    settings.integrator =
        options.integrator.value_or(config.synthetic ? Integrator::path : Integrator::igi);
    settings.passes = options.passes.value_or(1);
    config.path =
        walk(chosen_camera(options.camera, bundle, [](const std::string&) {}), options.views);
    if (options.animate > 0) animate(options, bundle, config);
    if (!options.replay.empty()) replay(options, bundle, config);
    return config;
}

void run(const ClusterOptions& options) {
    Interrupt interrupt;
    // A file's motion stays with the process that reads it.
    SceneBundle bundle = options.animate > 0 ? load_scene(options.scene).bundle
                                             : load_contained(options.scene).bundle;
    ClusterBenchConfig config = config_of(options, bundle);
    print_header(options, config.spec);
    std::vector<ClusterBenchRow> rows;
    nlohmann::json json = nlohmann::json::array();
    bool right = true, interrupted = false;
    for (const int viewers : options.viewers)
        for (const int workers : options.workers) {
            if (interrupted) break;
            config.workers = workers;
            config.viewers = viewers;
            const ClusterBenchRow& row =
                rows.emplace_back(bench_cluster(config, bundle, interrupt));
            print_row(row, efficiency(row, rows.front()));
            json.push_back(json_of(row, efficiency(row, rows.front())));
            right = right && row.wrong_pixels == 0;
            interrupted = row.interrupted;
        }
    write(options.csv, csv_of(json));
    write(options.json,
          nlohmann::json{{"version", TESSERA_VERSION}, {"results", json}}.dump(2) + '\n');
    write(options.svg, plot(options.scene + ": tiles a second against workers", rows));
    if (!right) throw UserError("pixels differ from those of an undisturbed frame");
}

// ---- Restarts -----------------------------------------------------------------------------------

/// A folder that is gone afterwards.
class TemporaryFolder {
public:
    TemporaryFolder() {
        std::string pattern =
            (std::filesystem::temp_directory_path() / "tessera-bench-XXXXXX").string();
        if (!mkdtemp(pattern.data())) throw UserError("cannot make a folder in " + pattern);
        path_ = pattern;
    }
    ~TemporaryFolder() {
        std::error_code ignored;
        std::filesystem::remove_all(path_, ignored);
    }
    TemporaryFolder(const TemporaryFolder&) = delete;
    TemporaryFolder& operator=(const TemporaryFolder&) = delete;
    const std::filesystem::path& path() const { return path_; }

private:
    std::filesystem::path path_;
};

void print_restarts(const RestartReport& report, const ClusterOptions& options) {
    const std::vector<std::pair<std::string, std::vector<double>>> times = {
        {"edit to its acknowledgement", report.acknowledge_seconds},
        {"restart to listening", report.start_seconds},
        {"restart to first picture at the viewer", report.picture_seconds}};
    fmt::print("{} kills, {} edits acknowledged, {} of them lost\n", report.kills, report.edits,
               report.lost);
    nlohmann::json json = {{"version", TESSERA_VERSION},
                           {"kills", report.kills},
                           {"edits_acknowledged", report.edits},
                           {"edits_lost", report.lost}};
    for (const auto& [what, seconds] : times) {
        const Percentiles p = percentiles(seconds);
        fmt::print("{:<40} p50 {:.1f}, p95 {:.1f}, p99 {:.1f}, max {:.1f} ms\n", what, 1e3 * p.p50,
                   1e3 * p.p95, 1e3 * p.p99, 1e3 * p.max);
        json["seconds"][what] = json_of(p);
    }
    write(options.json, json.dump(2) + '\n');
}

void restart(const ClusterOptions& options) {
    Interrupt interrupt;
    ProgressBar bar;
    RestartReport report;
    const TemporaryFolder folder;
    const RestartBenchConfig config{
        .cluster = {.workers = 1,
                    .threads = options.config.threads,
                    .log_level = "error",
                    .journal = folder.path() / "journal",
                    .programs = {}},
        .kills = options.server_kills,
        .down_seconds = options.server_down,
        .tick = [&](int kills) {
            interrupt.check();
            bar.show(std::uint64_t(kills), std::uint64_t(options.server_kills),
                     fmt::format("{} edits, {} lost", report.edits, report.lost));
        }};
    try {
        bench_restarts(config, report);
    } catch (const Interrupted&) {
        bar.note("interrupted: the results so far");
    }
    print_restarts(report, options);
    if (report.lost > 0) throw UserError("edits that were acknowledged are lost");
}

[[noreturn]] void simulate(const ClusterOptions& options, std::vector<std::string> arguments) {
    if (!options.json.empty()) arguments.insert(arguments.end(), {"--json", options.json});
    become("tessera-sim", arguments);
}

}  // namespace

void add_cluster_command(CLI::App* bench) {
    auto options = std::make_shared<ClusterOptions>();
    options->camera.size = {1920, 1080};
    ClusterOptions& o = *options;
    CLI::App* command = bench->add_subcommand(
        "cluster",
        "Load a server with workers and viewers; with --simulate, clusters of any size in virtual "
        "time");
    command->set_help_flag("-h,--help", "print this help message and exit");
    command->add_option("SCENE", o.scene, "file or generated scene")->capture_default_str();
    command->add_option("--workers", o.workers, "numbers of workers to measure, 1,2,4...")
        ->delimiter(',')
        ->check(CLI::Range(0, 4096));
    command->add_option("--threads", o.config.threads, "threads of each worker")
        ->check(CLI::Range(1, 1024))
        ->capture_default_str();
    auto* synthetic = command->add_flag("--synthetic", o.config.synthetic,
                                        "workers that answer at once with made-up pixels");
    command
        ->add_option("--server", o.config.server,
                     "HOST:PORT of a server to load, with --viewers 0 by workers alone, with "
                     "--workers 0 by viewers alone")
        ->needs(synthetic);
    command
        ->add_flag("--relays", o.config.relays,
                   "synthetic: get meshes and textures from one another, as real workers do")
        ->needs(synthetic);
    command->add_option("--tile-ms", o.tile_ms, "synthetic: mean time of a tile")
        ->check(CLI::NonNegativeNumber);
    command
        ->add_option("--tile-spread", o.config.spread,
                     "synthetic: standard deviation of the logarithm of that time")
        ->check(CLI::Range(0.0, 3.0))
        ->capture_default_str();
    command->add_option("--viewers", o.viewers, "numbers of viewers to measure, 1,2,4...")
        ->delimiter(',')
        ->check(CLI::Range(0, 512));
    command->add_option("--in-flight", o.config.in_flight, "frames a viewer asks for ahead")
        ->check(CLI::Range(1, 16))
        ->capture_default_str();
    command->add_option("--seconds", o.config.seconds, "time of each measurement")
        ->check(CLI::PositiveNumber)
        ->capture_default_str();
    command->add_option("--keys", o.config.keys,
                        "folder that `tessera keys` made: all speak TLS, to see what it costs");
    command->add_option("--kill", o.config.kills, "seconds after which a worker is killed")
        ->delimiter(',');
    command->add_option("--hang", o.config.hangs, "seconds after which a worker hangs (SIGSTOP)")
        ->delimiter(',');
    command
        ->add_option("--cut", o.config.cuts,
                     "seconds after which the network loses a worker, and nobody is told")
        ->delimiter(',');
    command
        ->add_option("--delay-ms", o.delay_ms,
                     "network between the server and the others: delay of each direction")
        ->check(CLI::Range(0.0, 1e4));
    command->add_option("--jitter-ms", o.jitter_ms, "at most as much more, drawn anew and anew")
        ->check(CLI::Range(0.0, 1e4));
    command->add_option("--mbit", o.mbit, "bandwidth of each link, million bits a second")
        ->check(CLI::PositiveNumber);
    command
        ->add_option("--loss", o.link.loss, "share of packets lost, each sent again after 200 ms")
        ->check(CLI::Range(0.0, 0.5));
    command->add_option("--seed", o.link.seed, "of jitter and loss")->capture_default_str();
    command
        ->add_option("--integrator", o.integrator,
                     "igi (default of real workers) or path (of synthetic ones)")
        ->transform(CLI::CheckedTransformer(std::map<std::string, Integrator>{
            {"igi", Integrator::igi}, {"path", Integrator::path}}));
    command->add_option("--passes", o.passes, "passes of each frame (default 1)")
        ->check(CLI::Range(1, 65536));
    auto* replays = command->add_option(
        "--replay", o.replay,
        "what viewers look at and change: a recording of `tessera record` or `tessera view`");
    command
        ->add_option("--animate", o.animate,
                     "what moves in the scene moves, from view to view by a frame of so many per "
                     "second")
        ->check(CLI::PositiveNumber)
        ->excludes(replays);
    command
        ->add_option("--shape-error", o.shape_error,
                     "vertices that move may be off by so much, in metres of their object, and "
                     "travel in fewer bytes")
        ->check(CLI::PositiveNumber);
    command->add_option("--views", o.views, "cameras on the path, or so many of a recording's")
        ->check(CLI::Range(1, 64))
        ->capture_default_str();
    auto* kills =
        command
            ->add_option("--server-kills", o.server_kills,
                         "instead: kill the server so many times while edits come, and look for "
                         "every edit that it has acknowledged")
            ->check(CLI::Range(1, 1000000));
    command
        ->add_option("--server-down", o.server_down,
                     "with it: seconds until the server is started again")
        ->check(CLI::Range(0.0, 3600.0))
        ->needs(kills);
    command->add_option("--json", o.json, "write the results to this file");
    command->add_option("--csv", o.csv, "and to this one");
    command->add_option("--svg", o.svg, "plot tiles a second against workers to this file");
    add_camera_options(command, o.camera);
    command->add_flag("--simulate", o.simulate, "simulate instead; also: --quick, --schedules N");
    command->allow_extras();
    command->callback([options, command] {
        if (options->simulate) simulate(*options, command->remaining());
        if (!command->remaining().empty())
            throw UserError(fmt::format("bench cluster knows no {}", command->remaining().front()));
        options->server_kills > 0 ? restart(*options) : run(*options);
    });
}

}  // namespace tessera
