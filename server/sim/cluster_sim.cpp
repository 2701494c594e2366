#include "server/sim/cluster_sim.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <queue>
#include <random>
#include <unordered_map>

#include "common/check.h"
#include "common/tile_codec.h"
#include "server/frame.h"
#include "server/runs.h"

namespace tessera {
namespace {

constexpr double never = std::numeric_limits<double>::infinity();
/// As the server's sessions do: workers are asked for a sign of life, and dropped without one.
constexpr double ping_seconds = 1;
constexpr double longest_silence = 10;
/// A worker that was dropped comes back.
constexpr double reconnect_seconds = 0.1;
/// Virtual time after which a frame counts as stuck: far beyond every fault of random_cluster.
constexpr double stuck_seconds = 1e4;

TimePoint time_point(double seconds) {
    return TimePoint(std::chrono::round<Duration>(std::chrono::duration<double>(seconds)));
}
double seconds_of(TimePoint time) {
    return std::chrono::duration<double>(time.time_since_epoch()).count();
}

/// Pixels that tell where they belong, so that a misplaced one shows.
float pattern(const TileTask& task, std::size_t pixel) {
    std::uint64_t h =
        (task.frame << 40 ^ std::uint64_t(task.first_pass) << 20 ^ pixel) * 0x9e3779b97f4a7c15u;
    h ^= h >> 29;
    return float(h % 65536);
}

class Simulation {
public:
    explicit Simulation(const SimConfig& config);
    SimReport run();

private:
    struct Worker {
        std::uint64_t id = 0;  ///< the server's number for it; 0: not connected
        double slowness = 1;   ///< by its nature
        double slowdown = 1;   ///< by mishap
        double hangs_until = 0;
        double cut_until = 0;
        std::uint32_t idle_threads = 0;
        std::deque<TileTask> queue;
        std::uint32_t leases = 0;  ///< as the server should count them
    };
    struct Frame {
        FrameSpec spec;
        FrameAssembler assembler;
        double asked = 0;
    };
    enum class What : std::uint8_t {
        task,      ///< reaches the worker
        rendered,  ///< by one of its threads
        result,    ///< reaches the server
        lost,      ///< the server hears that the connection is closed
        join,      ///< the worker connects
        ping,      ///< the worker's answer to one
        silence,   ///< has the worker been silent for too long?
        fault,     ///< number `index` begins
        recovery,  ///< and ends
        ask,       ///< a viewer asks for the next frame
        deadline,  ///< of the scheduler
    };
    struct Event {
        double at = 0;
        std::uint64_t number = 0;  ///< order among those at the same time
        What what = What::task;
        std::uint32_t index = 0;  ///< of the worker or fault
        std::uint64_t id = 0;     ///< connection: none of the worker's any more if it differs
        TileTask task = {};
        double seconds = 0;  ///< spent rendering

        bool operator<(const Event& o) const {
            return at != o.at ? at > o.at : number > o.number;  // the queue's top is the earliest
        }
    };

    double uniform() { return std::uniform_real_distribution<>()(random_); }
    bool chance(double p) { return p > 0 && uniform() < p; }
    double trip() { return config_.round_trip / 2 * (1 + config_.jitter * uniform()); }
    void at(double time, Event event);
    void complain(const std::string& what);

    void handle(const Event& event);
    void join(std::uint32_t index);
    void disconnect(std::uint32_t index);
    void task_arrives(const Event& event);
    void start_threads(std::uint32_t index);
    void rendered(const Event& event);
    void send(std::uint32_t index, What what, const TileTask& task, double seconds);
    void send_lies(std::uint32_t index, const TileTask& task, double seconds);
    void result_arrives(const Event& event);
    void begin(const Fault& fault, std::uint32_t number);
    void end(const Fault& fault);
    void ask();
    void fold(Frame& frame);
    void check_pixels(const Frame& frame, const RunBuffer& run);
    void hand_out();
    void check_leases();
    double tile_seconds(const TileTask& task);

    SimConfig config_;
    std::mt19937_64 random_;
    Scheduler scheduler_;
    double now_ = 0;
    double server_free_ = 0;  ///< when the server has done what has reached it
    double server_busy_ = 0;
    double next_deadline_ = never;
    std::uint64_t events_ = 0;
    std::uint64_t last_id_ = 0;
    std::uint64_t last_frame_ = 0;
    std::priority_queue<Event> queue_;
    std::vector<Worker> workers_;
    std::unordered_map<std::uint64_t, std::uint32_t> index_of_;  ///< of those the server knows
    std::map<std::uint64_t, std::unique_ptr<Frame>> frames_;
    std::vector<double> costs_;  ///< of the picture's tiles, mean 1
    double ideal_work_ = 0;      ///< seconds on one thread
    SimReport report_;
};

Simulation::Simulation(const SimConfig& config)
    : config_(config), random_(config.seed), scheduler_(config.scheduler) {
    workers_.resize(config.workers);
    for (std::uint32_t i = 0; i < config.workers; ++i) {
        if (i < config.slowness.size()) workers_[i].slowness = config.slowness[i];
        at(0, {.what = What::join, .index = i});
    }
    for (std::uint32_t i = 0; i < config.faults.size(); ++i)
        at(config.faults[i].at, {.what = What::fault, .index = i});
    for (std::uint32_t i = 0; i < std::min(config.in_flight, config.frames); ++i)
        at(0, {.what = What::ask});
    std::lognormal_distribution<> cost(-config.spread * config.spread / 2, config.spread);
    costs_.resize(tile_count(config.size));
    for (double& c : costs_) c = cost(random_);
}

void Simulation::at(double time, Event event) {
    event.at = time;
    event.number = ++events_;
    queue_.push(event);
}

void Simulation::complain(const std::string& what) {
    report_.broken.push_back(fmt::format("after {:.6f} s: {}", now_, what));
}

SimReport Simulation::run() {
    while (report_.frame_seconds.size() < config_.frames && report_.broken.empty()) {
        if (queue_.empty() || queue_.top().at > stuck_seconds) {
            complain("a frame is stuck");
            break;
        }
        const Event event = queue_.top();
        queue_.pop();
        now_ = event.at;
        handle(event);
    }
    double speed = 0;
    for (const Worker& worker : workers_) speed += config_.threads / worker.slowness;
    report_.seconds = now_;
    report_.ideal_seconds = ideal_work_ / speed;
    report_.server_load = server_busy_ / now_;
    return report_;
}

void Simulation::handle(const Event& event) {
    if (event.what == What::fault) return begin(config_.faults[event.index], event.index);
    if (event.what == What::recovery) return end(config_.faults[event.index]);
    if (event.what == What::ask) return ask();
    if (event.what == What::deadline) {
        if (event.at == next_deadline_) hand_out();
        return;
    }
    if (event.what == What::join) return join(event.index);
    if (event.what == What::lost) {
        if (index_of_.erase(event.id) > 0) scheduler_.remove_worker(event.id);
        return hand_out();
    }
    Worker& worker = workers_[event.index];
    if (worker.id != event.id) return;  // of an earlier life
    // What reaches a worker that hangs, or passes a connection that is cut, waits.
    const bool on_worker = event.what == What::task || event.what == What::rendered;
    const double until =
        on_worker ? std::max(worker.hangs_until, event.what == What::task ? worker.cut_until : 0)
                  : worker.cut_until;
    if (now_ < until && event.what != What::silence) {
        if (until != never) at(until, event);
        return;
    }
    switch (event.what) {
        case What::task:
            return task_arrives(event);
        case What::rendered:
            return rendered(event);
        case What::result:
            return result_arrives(event);
        case What::ping:
            if (worker.hangs_until <= now_) scheduler_.round_trip(event.id, config_.round_trip);
            at(now_ + ping_seconds, {.what = What::ping, .index = event.index, .id = event.id});
            return;
        case What::silence:
            if (std::max(worker.hangs_until, worker.cut_until) > now_) disconnect(event.index);
            return;
        default:
            CHECK(false);
    }
}

void Simulation::join(std::uint32_t index) {
    Worker& worker = workers_[index];
    if (worker.id != 0) return;
    worker.id = ++last_id_;
    worker.idle_threads = config_.threads;
    worker.queue.clear();
    worker.leases = 0;
    worker.hangs_until = worker.cut_until = 0;
    index_of_[worker.id] = index;
    scheduler_.add_worker(worker.id, config_.threads);
    scheduler_.scene_ready(worker.id, "scene", 1);
    at(now_ + config_.round_trip, {.what = What::ping, .index = index, .id = worker.id});
    hand_out();
}

void Simulation::disconnect(std::uint32_t index) {
    Worker& worker = workers_[index];
    if (worker.id == 0) return;
    at(now_ + trip(), {.what = What::lost, .index = index, .id = worker.id});
    worker.id = 0;
}

void Simulation::task_arrives(const Event& event) {
    workers_[event.index].queue.push_back(event.task);
    start_threads(event.index);
}

/// Takes from the queue what still is of a frame; that it is over is known half a round trip late.
void Simulation::start_threads(std::uint32_t index) {
    Worker& worker = workers_[index];
    while (worker.idle_threads > 0 && !worker.queue.empty()) {
        const TileTask task = worker.queue.front();
        worker.queue.pop_front();
        if (!frames_.contains(task.frame)) continue;
        --worker.idle_threads;
        report_.rendered += task.part == 0 ? 1 : 1.0 / quarters;
        report_.quarters += task.part > 0;
        const double seconds = tile_seconds(task) * worker.slowness * worker.slowdown;
        at(now_ + seconds, {.what = What::rendered,
                            .index = index,
                            .id = worker.id,
                            .task = task,
                            .seconds = seconds});
    }
}

double Simulation::tile_seconds(const TileTask& task) {
    std::mt19937 own(unsigned(task.frame * 31 + task.first_pass) * 1048583u + task.tile);
    std::lognormal_distribution<> noise(-config_.noise * config_.noise / 2, config_.noise);
    const double whole = config_.tile_seconds * costs_[task.tile] * noise(own);
    if (task.part == 0) return whole;
    // Quarters differ as tiles do, and add up to their tile.
    std::mt19937 of_tile(task.tile);
    std::lognormal_distribution<> share(0, config_.spread);
    double shares[quarters], sum = 0;
    for (double& s : shares) sum += s = share(of_tile);
    return whole * shares[task.part - 1] / sum * (1 + config_.quarter_overhead);
}

void Simulation::rendered(const Event& event) {
    ++workers_[event.index].idle_threads;
    start_threads(event.index);
    send(event.index, What::result, event.task, event.seconds);
    if (chance(config_.lies)) send_lies(event.index, event.task, event.seconds);
}

/// A result passes the server after all that reached it before.
void Simulation::send(std::uint32_t index, What what, const TileTask& task, double seconds) {
    server_free_ = std::max(server_free_, now_ + trip()) + config_.server_seconds;
    server_busy_ += config_.server_seconds;
    at(server_free_,
       {.what = what, .index = index, .id = workers_[index].id, .task = task, .seconds = seconds});
}

void Simulation::send_lies(std::uint32_t index, const TileTask& task, double seconds) {
    send(index, What::result, task, seconds);
    TileTask other = task;
    other.tile = std::uint32_t(random_() % (tile_count(config_.size) + 1));
    send(index, What::result, other, 1e30);
    other.frame -= 1;
    send(index, What::result, other, 0);
}

/// What RenderFarm::tile_result does.
void Simulation::result_arrives(const Event& event) {
    const auto found = frames_.find(event.task.frame);
    if (found == frames_.end()) return;
    Frame& frame = *found->second;
    std::vector<float> radiance;
    const bool known = run_of(frame.spec, event.task).has_value();
    const Rect rect = known ? rect_of(config_.size, event.task) : Rect{};
    for (int y = rect.y0; y < rect.y1; ++y)
        for (int i = 3 * rect.x0; i < 3 * rect.x1; ++i)
            radiance.push_back(pattern(
                event.task, std::size_t(y) * 3 * std::size_t(config_.size.width) + std::size_t(i)));
    const Bytes pixels = pack_tile(tile_channels(frame.spec), rect.pixels(), radiance);
    if (!frame.assembler.fits(event.task, pixels)) {
        disconnect(event.index);
        return at(now_ + reconnect_seconds, {.what = What::join, .index = event.index});
    }
    Worker& worker = workers_[event.index];
    const Answer answer =
        scheduler_.completed(event.id, event.task, time_point(now_), event.seconds);
    if (answer != Answer::unknown) --worker.leases;
    if (answer == Answer::first) {
        if (frame.assembler.add(event.task, pixels) != Arrival::stored)
            complain(fmt::format("tile {} is counted twice or of no open run", event.task.tile));
        fold(frame);
    }
    hand_out();
}

void Simulation::fold(Frame& frame) {
    while (std::optional<RunBuffer> run = frame.assembler.take_complete()) {
        check_pixels(frame, *run);
        frame.assembler.run_folded(std::move(*run));
        scheduler_.allow_runs(frame.spec.frame, frame.assembler.run_limit());
    }
    if (!frame.assembler.finished()) return;
    const std::uint64_t tasks = frame.assembler.tiles_done();
    if (tasks != frame.assembler.tiles_total()) complain("finished with tiles missing");
    report_.tiles += tasks;
    report_.frame_seconds.push_back(now_ - frame.asked);
    scheduler_.remove_frame(frame.spec.frame);
    frames_.erase(frame.spec.frame);
    for (Worker& worker : workers_)
        if (worker.id != 0) worker.leases = scheduler_.leases(worker.id);
    if (last_frame_ < config_.frames) at(now_ + config_.round_trip, {.what = What::ask});
}

void Simulation::check_pixels(const Frame& frame, const RunBuffer& run) {
    const TileTask task = task_of(frame.spec, run.run, 0);
    for (std::size_t i = 0; i < run.data.size(); ++i)
        if (run.data[i] != pattern(task, i)) return complain("a pixel is wrong");
}

void Simulation::ask() {
    FrameSpec spec;
    spec.frame = ++last_frame_;
    spec.scene = "scene";
    spec.version = 1;
    spec.size = config_.size;
    spec.settings.integrator = Integrator::path;
    spec.settings.passes = config_.passes;
    FrameAssembler assembler(spec);
    scheduler_.add_frame(spec, assembler.run_limit());
    for (std::uint32_t run = 0; run < run_count(spec.settings); ++run)
        for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
            ideal_work_ += tile_seconds(task_of(spec, run, tile));
    frames_[spec.frame] = std::make_unique<Frame>(Frame{spec, std::move(assembler), now_});
    hand_out();
}

void Simulation::hand_out() {
    for (const auto& [id, task] : scheduler_.assign(time_point(now_))) {
        const auto known = index_of_.find(id);
        if (known == index_of_.end()) return complain("a task for a worker that is gone");
        Worker& worker = workers_[known->second];
        const Frame& frame = *frames_.at(task.frame);
        const auto run = run_of(frame.spec, task);
        if (!run || *run >= frame.assembler.run_limit()) complain("a task of no open run");
        if (worker.id != id) continue;  // gone, but the server has not heard of it
        ++worker.leases;
        report_.most_leases = std::max(report_.most_leases, worker.leases);
        at(now_ + trip(), {.what = What::task, .index = known->second, .id = id, .task = task});
    }
    check_leases();
    const auto deadline = scheduler_.next_deadline();
    const double next = deadline ? std::max(seconds_of(*deadline), now_) : never;
    if (next == next_deadline_ && next > now_) return;
    next_deadline_ = next;
    if (next != never) at(next, {.what = What::deadline});
}

/// That the scheduler counts as we do, looking at a few workers each time.
void Simulation::check_leases() {
    for (int i = 0; i < 3; ++i) {
        const Worker& worker = workers_[(events_ + unsigned(i)) % workers_.size()];
        if (worker.id != 0 && worker.leases != scheduler_.leases(worker.id))
            complain("leases are miscounted");
    }
}

void Simulation::begin(const Fault& fault, std::uint32_t number) {
    Worker& worker = workers_[fault.worker];
    const double until = fault.seconds > 0 ? now_ + fault.seconds : never;
    if (fault.mishap == Mishap::death) disconnect(fault.worker);
    if (fault.mishap == Mishap::hang) worker.hangs_until = until;
    if (fault.mishap == Mishap::cut) worker.cut_until = until;
    if (fault.mishap == Mishap::slowdown) worker.slowdown = fault.factor;
    if (fault.mishap == Mishap::hang || fault.mishap == Mishap::cut)
        at(now_ + longest_silence, {.what = What::silence, .index = fault.worker, .id = worker.id});
    if (until != never) at(until, {.what = What::recovery, .index = number});
}

void Simulation::end(const Fault& fault) {
    Worker& worker = workers_[fault.worker];
    if (fault.mishap == Mishap::slowdown) worker.slowdown = 1;
    join(fault.worker);
}

}  // namespace

SimReport simulate(const SimConfig& config) { return Simulation(config).run(); }

SimConfig random_cluster(unsigned seed) {
    std::mt19937_64 random(seed);
    const auto below = [&](std::uint32_t n) { return std::uint32_t(random() % n); };
    const auto between = [&](double a, double b) {
        return std::uniform_real_distribution<>(a, b)(random);
    };
    SimConfig config;
    config.seed = seed;
    config.workers = 1 + below(12);
    config.threads = 1 + below(4);
    config.size = {1 + int(below(120)), 1 + int(below(120))};
    config.passes = 1 + below(64);
    config.frames = 1 + below(4);
    config.in_flight = 1 + below(3);
    config.tile_seconds = std::exp(between(std::log(1e-4), std::log(1e-1)));
    config.round_trip = std::exp(between(std::log(1e-5), std::log(1e-1)));
    config.spread = between(0, 1.5);
    config.noise = between(0, 0.5);
    config.jitter = between(0, 4);
    config.lies = below(2) * between(0, 0.2);
    for (std::uint32_t i = 0; i < config.workers; ++i)
        config.slowness.push_back(below(4) == 0 ? between(1, 20) : 1);

    // Mishaps come while there is something to disturb, to all workers but the first.
    const double work = config.tile_seconds * tile_count(config.size) *
                        double((config.passes + 15) / 16 * config.frames);
    const double lasts = 2 * work / (config.workers * config.threads);
    for (std::uint32_t n = config.workers > 1 ? below(12) : 0; n > 0; --n)
        config.faults.push_back({.mishap = Mishap(below(4)),
                                 .worker = 1 + below(config.workers - 1),
                                 .at = between(0, lasts),
                                 .seconds = below(3) == 0 ? 0 : lasts * between(0.01, 2),
                                 .factor = between(1, 100)});
    return config;
}

}  // namespace tessera
