#include "client/cluster_bench.h"

#include <fmt/format.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <functional>
#include <sstream>

#include "client/fault_proxy.h"
#include "client/load_viewer.h"
#include "client/progress_bar.h"
#include "client/synthetic_worker.h"
#include "common/check.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr auto tick = std::chrono::milliseconds(20);
/// Of several that follow each other, so that caches are warm.
constexpr int warm_up_rounds = 2;

double seconds_between(Clock::time_point from, Clock::time_point to) {
    return std::chrono::duration<double>(to - from).count();
}

/// User and system time of a process so far, in seconds.
double cpu_seconds(pid_t pid) {
    std::ifstream in(fmt::format("/proc/{}/stat", pid));
    std::string text;
    std::getline(in, text);
    // Behind the name, which may hold blanks, fields 14 and 15 of proc(5) are the 12th and 13th.
    std::istringstream fields(text.substr(std::min(text.rfind(')'), text.size() - 1) + 1));
    std::string skipped;
    for (int i = 0; i < 11; ++i) fields >> skipped;
    double user = 0, system = 0;
    fields >> user >> system;
    return (user + system) / double(sysconf(_SC_CLK_TCK));
}

ServerFootprint footprint(pid_t pid, double at) {
    const std::filesystem::path process = fmt::format("/proc/{}", pid);
    std::ifstream in(process / "statm");
    std::uint64_t all_pages = 0, resident_pages = 0;
    in >> all_pages >> resident_pages;
    std::error_code gone;
    const std::filesystem::directory_iterator descriptors(process / "fd", gone);
    return {.at = at,
            .memory_bytes = resident_pages * std::uint64_t(sysconf(_SC_PAGESIZE)),
            .descriptors = std::uint64_t(std::distance(begin(descriptors), end(descriptors)))};
}

/// A server, workers of either kind, and the pictures that must come out.
class Load {
public:
    Load(const ClusterBenchConfig& config, const SceneBundle& bundle, Interrupt& interrupt);
    ClusterBenchRow measure();

private:
    std::string route(const std::string& server);
    void render_expected();
    void inject(const std::string& kind, std::vector<int>& victims);
    std::vector<LoadFrame> all_frames() const;
    void summarise(ClusterBenchRow& row, const std::vector<LoadFrame>& frames) const;
    double recovery(Clock::time_point fault, const std::vector<LoadFrame>& frames,
                    double usual) const;
    double tasks_per_frame() const;
    std::uint64_t bytes_from_workers();

    const ClusterBenchConfig& config_;
    const SceneBundle& bundle_;
    Interrupt& interrupt_;
    std::vector<std::unique_ptr<FaultProxy>>
        proxies_;  ///< one for each real worker, where asked for
    std::optional<LocalCluster> processes_;
    std::vector<pid_t> real_workers_;
    std::optional<SyntheticWorkers> synthetic_;
    RenderClientConfig client_;
    std::shared_ptr<LoadScript> script_ = std::make_shared<LoadScript>();
    asio::io_context io_{1};  ///< of the viewers
    std::vector<std::shared_ptr<LoadViewer>> viewers_;
};

Load::Load(const ClusterBenchConfig& config, const SceneBundle& bundle, Interrupt& interrupt)
    : config_(config), bundle_(bundle), interrupt_(interrupt) {
    client_.tick = [this] { interrupt_.check(); };
    Credentials worker_credentials;
    if (config.server.empty()) {
        processes_.emplace(LocalClusterConfig{
            .workers = config.synthetic ? 0 : config.workers,
            .threads = config.threads,
            .log_level = "error",
            .route = [this](int, const std::string& server) { return route(server); },
            .keys = config.keys,
            .programs = {}});
        real_workers_ = processes_->workers();
        client_.address = config.link ? route(processes_->address()) : processes_->address();
        client_.credentials = processes_->credentials();
        worker_credentials = processes_->worker_credentials();
    } else {
        client_.address = config.server;
        client_.credentials = load_credentials(config.keys.empty() ? "" : config.keys / "editor");
        worker_credentials = load_credentials(config.keys.empty() ? "" : config.keys / "worker");
    }
    if (config.synthetic && config.workers > 0)
        synthetic_.emplace(SyntheticConfig{.server = parse_address(client_.address),
                                           .credentials = worker_credentials,
                                           .workers = config.workers,
                                           .threads = std::uint32_t(config.threads),
                                           .tile_seconds = config.tile_seconds,
                                           .relays = config.relays,
                                           .spread = config.spread});
    for (const Camera& camera : config.path) {
        FrameRequest request;
        request.spec = config.spec;
        request.spec.camera = camera;
        request.format = PictureFormat::srgb8;
        script_->views.push_back(request);
    }
    script_->scenes = config.scenes.empty() ? std::vector{bundle.scene} : config.scenes;
    if (config.viewers > 0) render_expected();
}

/// The address by which to reach the server over a link of its own.
std::string Load::route(const std::string& server) {
    if (!config_.link && config_.cuts.empty()) return server;
    LinkConfig link = config_.link.value_or(LinkConfig{});
    link.seed += 1000 * std::uint32_t(proxies_.size());
    proxies_.push_back(std::make_unique<FaultProxy>(parse_address(server), link));
    return proxies_.back()->address();
}

/// Renders every view undisturbed, once all workers take part.
void Load::render_expected() {
    RenderClient client(client_);
    const auto joined = [&] {
        interrupt_.check();
        return client.status().workers.size() >= std::size_t(config_.workers);
    };
    while (!joined()) {
    }
    for (int round = 0; round < warm_up_rounds; ++round) {
        script_->expected.clear();
        for (std::size_t i = 0; i < script_->views.size(); ++i) {
            if (i < script_->scenes.size())
                client.upload_scene(config_.spec.scene, {script_->scenes[i], bundle_.blobs});
            script_->expected.push_back(
                client.render(script_->views[i], [](const FrameProgress&) {}).srgb8);
        }
    }
}

double Load::tasks_per_frame() const {
    const std::uint32_t per_task = passes_per_task(config_.spec.settings);
    return double(tile_count(config_.spec.size)) *
           double((config_.spec.settings.passes + per_task - 1) / per_task);
}

/// That the server has received so far; of synthetic workers, that they have sent.
std::uint64_t Load::bytes_from_workers() {
    if (synthetic_) return synthetic_->traffic().bytes_out;
    RenderClientConfig client = client_;
    client.tick = [] {};
    return RenderClient(client).status().worker_bytes;
}

ClusterBenchRow Load::measure() {
    std::exception_ptr failure;
    for (int i = 0; i < config_.viewers; ++i) {
        viewers_.push_back(
            std::make_shared<LoadViewer>(client_, script_, std::size_t(i), config_.in_flight));
        asio::co_spawn(io_, viewers_.back()->run(bundle_), [&](std::exception_ptr error) {
            if (error) failure = error;
        });
    }

    // Run the viewers, and hurt workers when it is time.
    ClusterBenchRow row;
    row.config = config_;
    std::vector<std::pair<double, std::string>> faults;
    for (const double at : config_.kills) faults.emplace_back(at, "kill");
    for (const double at : config_.hangs) faults.emplace_back(at, "hang");
    for (const double at : config_.cuts) faults.emplace_back(at, "cut");
    std::sort(faults.begin(), faults.end());
    std::vector<int> victims;
    std::vector<Clock::time_point> fault_times;
    const std::uint64_t sent_before = bytes_from_workers();
    const std::uint64_t received_before = synthetic_ ? synthetic_->traffic().bytes_in : 0;
    const auto server_cpu = [&] { return processes_ ? cpu_seconds(processes_->server()) : 0; };
    const double cpu_before = server_cpu();
    const auto start = Clock::now();
    ProgressBar bar;
    const auto elapsed = [&] { return seconds_between(start, Clock::now()); };
    const auto look_at_server = [&](std::optional<ServerFootprint>& seen) {
        if (processes_) seen = footprint(processes_->server(), elapsed());
    };
    try {
        while (elapsed() < config_.seconds && !failure) {
            io_.run_for(tick);
            interrupt_.check();
            if (!row.early && elapsed() >= config_.seconds / 10) look_at_server(row.early);
            if (victims.size() < faults.size() && elapsed() >= faults[victims.size()].first) {
                fault_times.push_back(Clock::now());
                row.faults.push_back({.kind = faults[victims.size()].second, .at = elapsed()});
                inject(row.faults.back().kind, victims);
            }
            const double frames = double(all_frames().size());
            bar.show(std::uint64_t(1e3 * elapsed()), std::uint64_t(1e3 * config_.seconds),
                     fmt::format("{:.1f} frames/s, {:.0f} tiles/s", frames / elapsed(),
                                 frames * tasks_per_frame() / elapsed()));
        }
    } catch (const Interrupted&) {
        row.interrupted = true;
    }
    if (failure) std::rethrow_exception(failure);

    // Sum up.
    const double cpu_used = server_cpu() - cpu_before;
    look_at_server(row.late);
    const std::vector<LoadFrame> frames = all_frames();
    for (const LoadFrame& frame : frames)
        row.seconds = std::max(row.seconds, seconds_between(start, frame.done));
    const double tiles = std::max(1.0, double(frames.size()) * tasks_per_frame());
    row.server_cpu_s_per_tile = cpu_used / tiles;
    summarise(row, frames);
    const double count = std::max(1.0, double(frames.size()));
    row.bytes_from_workers = double(bytes_from_workers() - sent_before) / count;
    if (synthetic_)
        row.bytes_to_workers = double(synthetic_->traffic().bytes_in - received_before) / count;
    std::vector<double> usual;
    for (const LoadFrame& frame : frames)
        if (fault_times.empty() || frame.done < fault_times.front()) usual.push_back(frame.final);
    for (std::size_t i = 0; i < fault_times.size(); ++i)
        row.faults[i].recovery = recovery(fault_times[i], frames, percentiles(usual).p50);
    for (const auto& viewer : viewers_) viewer->stop();
    io_.run_for(tick);
    return row;
}

void Load::inject(const std::string& kind, std::vector<int>& victims) {
    const int victim = int(victims.size());
    victims.push_back(victim);
    if (victim >= config_.workers) throw UserError("more workers are to be hurt than there are");
    const bool kills = kind == "kill";
    if (synthetic_)
        kills ? synthetic_->kill(victim) : synthetic_->hang(victim);
    else if (kind == "cut")
        proxies_[std::size_t(victim)]->cut();
    else
        ::kill(real_workers_[std::size_t(victim)], kills ? SIGKILL : SIGSTOP);
}

std::vector<LoadFrame> Load::all_frames() const {
    std::vector<LoadFrame> frames;
    for (const auto& viewer : viewers_)
        frames.insert(frames.end(), viewer->frames().begin(), viewer->frames().end());
    return frames;
}

double Load::recovery(Clock::time_point fault, const std::vector<LoadFrame>& frames,
                      double usual) const {
    double longest = usual;
    for (const LoadFrame& frame : frames)
        if (frame.asked <= fault && frame.done >= fault) longest = std::max(longest, frame.final);
    return longest - usual;
}

void Load::summarise(ClusterBenchRow& row, const std::vector<LoadFrame>& frames) const {
    std::vector<double> first, final;
    for (const LoadFrame& frame : frames) {
        first.push_back(frame.first);
        final.push_back(frame.final);
        row.wrong_pixels += frame.wrong_pixels;
    }
    row.frames = frames.size();
    row.first = percentiles(first);
    row.final = percentiles(final);
    if (!frames.empty()) row.frames_per_s = double(frames.size()) / row.seconds;
    row.tiles_per_s = row.frames_per_s * tasks_per_frame();
    if (config_.synthetic && config_.tile_seconds > 0)
        row.ideal_tiles_per_s = config_.workers * config_.threads / config_.tile_seconds;
    std::uint64_t received = 0;
    std::vector<double> shares;
    for (const auto& viewer : viewers_) {
        received += viewer->bytes_received();
        shares.push_back(double(viewer->frames().size() * viewers_.size()) /
                         std::max(1.0, double(frames.size())));
    }
    if (!shares.empty()) {
        row.least_share = std::ranges::min(shares);
        row.most_share = std::ranges::max(shares);
    }
    row.bytes_to_viewer = double(received) / std::max(1.0, double(frames.size()));
}

}  // namespace

Percentiles percentiles(std::vector<double> values) {
    if (values.empty()) return {};
    std::sort(values.begin(), values.end());
    const auto at = [&](double share) {
        return values[std::min(values.size() - 1, std::size_t(share * double(values.size())))];
    };
    return {at(0.5), at(0.95), at(0.99), values.back()};
}

ClusterBenchRow bench_cluster(const ClusterBenchConfig& config, const SceneBundle& bundle,
                              Interrupt& interrupt) {
    return Load(config, bundle, interrupt).measure();
}

}  // namespace tessera
