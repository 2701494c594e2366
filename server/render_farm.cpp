#include "server/render_farm.h"

#include <fmt/format.h>

#include <algorithm>
#include <atomic>
#include <fstream>
#include <utility>

#include "common/check.h"
#include "common/clock.h"
#include "common/log.h"
#include "server/frame_trace.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

/// Viewers hear of progress no more often.
constexpr auto report_interval = std::chrono::milliseconds(100);
/// Below this many runs the error estimate is too rough to stop by.
constexpr std::uint32_t least_runs_for_error = 4;
/// Lights that statistics list.
constexpr std::size_t most_lights_told = 256;
/// Rows that are worth a thread of their own when a run is folded.
constexpr int least_band_rows = 64;

double seconds_between(Clock::time_point from, Clock::time_point to) {
    return std::chrono::duration<double>(to - from).count();
}

/// Where the discontinuity filter runs, and why. A worker that filters would send the filtered
/// colour and what the filter took away (server/detail_blend.h), neither of which packs, and trace
/// what its tiles' windows reach into a second time.
std::string filter_sentence(const RenderSettings& settings, double bytes_of_tile) {
    const double side = 1 + double(settings.interleave / 2 * 2) / tile_size;
    constexpr double pixels = tile_size * tile_size;
    return fmt::format(
        "filter on the server: a tile comes in {:.1f} kB; filtered by the workers it would take "
        "{:.1f} kB and {:.2f} times the rays",
        1e-3 * bytes_of_tile, 1e-3 * 2 * 3 * sizeof(float) * pixels, side * side);
}

std::string quarter_name(const TileTask& task) {
    return task.part == 0 ? "" : fmt::format(", quarter {}", task.part);
}

}  // namespace

/// One frame on its way.
struct RenderFarm::Job {
    FrameRequest request;
    ReadyScene scene;
    FrameObserver observer;
    std::shared_ptr<FrameSums> sums;
    FrameAssembler assembler;
    bool sums_busy = false;                  ///< on the pool
    std::function<void(SavedFrame)> saving;  ///< to be called with the sums; may be empty
    asio::steady_timer report_timer;
    std::optional<FrameProgress> reported;
    std::optional<Clock::time_point> started;       ///< first tile handed out
    std::map<std::uint64_t, std::string> failures;  ///< workers that cannot render it, and why
    double error_estimate = 0;                      ///< after the last run folded
    std::uint64_t rays = 0;
    std::uint64_t sanitised = 0;
    std::uint64_t pixel_bytes = 0;  ///< of tiles as they came
    double tiles = 0;               ///< with those bytes
    std::uint32_t active_lights = 0;
    std::map<std::uint64_t, WorkerShare> shares;
    Clock::time_point fold_began;
    std::optional<FrameTrace> trace;  ///< from the first tile on, where one is wanted

    Job(const asio::any_io_executor& strand, const FrameRequest& r, const ReadyScene& s,
        FrameObserver o, std::shared_ptr<FrameSums> begun, std::shared_ptr<BufferPool> buffers)
        : request(r),
          scene(s),
          observer(std::move(o)),
          sums(begun ? std::move(begun) : std::make_shared<FrameSums>(r.spec)),
          assembler(r.spec, sums->runs(), std::move(buffers)),
          report_timer(strand) {}

    std::uint64_t frame() const { return request.spec.frame; }
};

RenderFarm::RenderFarm(const asio::any_io_executor& strand, unsigned fold_threads,
                       std::filesystem::path trace, RelayMode relays)
    : strand_(strand),
      relays_(relays),
      deadline_timer_(strand),
      fold_threads_(fold_threads),
      trace_(std::move(trace)),
      pool_(fold_threads) {}

RenderFarm::~RenderFarm() {
    pool_.stop();
    pool_.join();
}

void RenderFarm::keep_ready(ScenePtr scene) {
    kept_ready_.push_back(std::move(scene));
    sync_scene(kept_ready_.back()->now.name);
}

void RenderFarm::drop_scene(const std::string& name) {
    if (wanted_version(name)) {
        doomed_.insert(name);
        return;
    }
    doomed_.erase(name);
    for (const auto& [id, worker] : workers_)
        if (worker->drop(name)) scheduler_.scene_gone(id, name);
}

std::uint64_t RenderFarm::begin_frame(const FrameRequest& request, const ReadyScene& scene,
                                      FrameObserver observer, std::shared_ptr<FrameSums> sums) {
    FrameRequest numbered = request;
    numbered.spec.frame = ++last_frame_;
    numbered.spec.scene = scene.name;
    numbered.spec.version = scene.scene->version;
    auto job = std::make_unique<Job>(strand_, numbered, scene, std::move(observer), std::move(sums),
                                     buffers_);
    Job& begun = *job;
    begun.error_estimate = begun.sums->error_estimate();
    jobs_[last_frame_] = std::move(job);
    scheduler_.add_frame(numbered.spec, begun.assembler.run_limit(), begun.sums->runs());
    sync_scene(scene.name);
    report(begun);
    schedule_report(begun);
    // Later, so that the caller knows the number before it hears of the end.
    asio::post(strand_, [this, name = scene.name, frame = last_frame_] {
        fail_if_hopeless(name);
        // It may have gone on from its end.
        if (const auto found = jobs_.find(frame); found != jobs_.end())
            finish_if_complete(*found->second);
    });
    pump();
    return numbered.spec.frame;
}

void RenderFarm::cancel_frame(std::uint64_t frame) {
    if (!jobs_.contains(frame)) return;
    end_job(frame);
    pump();
}

void RenderFarm::add_worker(std::shared_ptr<WorkerSession> worker) {
    WorkerSession& added = *worker;
    scheduler_.add_worker(added.id(), added.threads());
    relays_.add_worker(added.id(), !added.relay_address().empty());
    workers_[added.id()] = std::move(worker);
    for (const ScenePtr& scene : kept_ready_) sync_worker(added, *wanted_version(scene->now.name));
    for (const auto& [frame, job] : jobs_) sync_worker(added, *wanted_version(job->scene.name));
}

void RenderFarm::remove_worker(std::uint64_t worker) {
    const auto gone = workers_.find(worker);
    if (gone == workers_.end()) return;
    bytes_of_the_gone_ += gone->second->bytes_received();
    workers_.erase(gone);
    scheduler_.remove_worker(worker);
    relays_.remove_worker(worker);
    std::set<std::string> scenes;
    for (const auto& [frame, job] : jobs_) scenes.insert(job->scene.name);
    for (const std::string& scene : scenes) fail_if_hopeless(scene);
    pump();
}

void RenderFarm::scene_ready(WorkerSession& worker, const std::string& scene,
                             std::uint64_t version) {
    scheduler_.scene_ready(worker.id(), scene, version);
    pump();
}

void RenderFarm::scene_failed(WorkerSession& worker, const std::string& scene) {
    scheduler_.scene_gone(worker.id(), scene);
    fail_if_hopeless(scene);
    pump();
}

void RenderFarm::frame_failed(WorkerSession& worker, std::uint64_t frame,
                              const std::string& reason) {
    const auto found = jobs_.find(frame);
    if (found == jobs_.end()) return;
    found->second->failures[worker.id()] = reason;
    scheduler_.exclude(worker.id(), frame);
    fail_if_hopeless(found->second->scene.name);
    pump();
}

void RenderFarm::tile_results(WorkerSession& worker, const TileResults& results,
                              std::span<const std::byte> pixels) {
    const auto now = Clock::now();
    for (const TileReport& tile : results.tiles) {
        tile_result(worker, tile, pixels.first(tile.pixel_bytes), now);
        pixels = pixels.subspan(tile.pixel_bytes);
    }
    let_go_if_done(worker);
    pump_soon();
}

void RenderFarm::tile_result(WorkerSession& worker, const TileReport& tile,
                             std::span<const std::byte> pixels, TimePoint now) {
    const auto found = jobs_.find(tile.task.frame);
    if (found == jobs_.end()) return;  // cancelled while the worker was at it
    Job& job = *found->second;
    if (!job.assembler.fits(tile.task, pixels))
        throw ProtocolError(
            fmt::format("answers with a tile that is none of frame {}", tile.task.frame));
    const Answer answer = scheduler_.completed(worker.id(), tile.task, now, tile.seconds);
    if (job.trace)
        job.trace->add(
            worker.name(), worker.threads(),
            fmt::format("tile {}{}, pass {}{}", tile.task.tile, quarter_name(tile.task),
                        tile.task.first_pass, answer == Answer::first ? "" : ", not needed"),
            from_seconds(tile.seconds), now);
    worker.busy_seconds += tile.seconds;
    if (answer != Answer::first) return;
    CHECK(job.assembler.add(tile.task, pixels, worker.id(), tile.lights) == Arrival::stored);
    ++worker.tiles;
    worker.rays += tile.rays;
    job.rays += tile.rays;
    job.sanitised += tile.sanitised;
    job.pixel_bytes += tile.pixel_bytes;
    job.tiles += tile.task.part == 0 ? 1 : 1.0 / quarters;
    job.active_lights = std::max(job.active_lights, tile.active_lights);
    WorkerShare& share = job.shares[worker.id()];
    ++share.tiles;
    share.rays += tile.rays;
    fold_next(job);
}

std::vector<RelayPlan::Share> RenderFarm::share_blobs(const WorkerSession& worker,
                                                      const BlobRequest& request,
                                                      const BlobStore& offered) {
    if (request.failed_peer != 0) {
        relays_.failed(worker.id(), request.failed_peer);
        return {{.peer = 0, .blobs = request.blobs, .bytes = {}}};
    }
    // Connections that send at the same time get a part of the uplink each: the fastest is nearest.
    LinkSpeed uplink = worker.link();
    for (const auto& [id, other] : workers_)
        uplink.bytes_per_second = std::max(uplink.bytes_per_second, other->link().bytes_per_second);
    return relays_.share(worker.id(), request.blobs, offered, uplink);
}

const std::string& RenderFarm::relay_address(std::uint64_t worker) const {
    return workers_.at(worker)->relay_address();
}

void RenderFarm::retire(WorkerSession& worker) {
    scheduler_.retire(worker.id());
    let_go_if_done(worker);
}

/// Closing its connection ends the session, which then removes the worker.
void RenderFarm::let_go_if_done(WorkerSession& worker) {
    const WorkerPace pace = scheduler_.pace(worker.id());
    if (pace.retired && pace.leases == 0) worker.close();
}

void RenderFarm::round_trip(const WorkerSession& worker, double seconds) {
    scheduler_.round_trip(worker.id(), seconds);
    pump();
}

void RenderFarm::stop() {
    while (!jobs_.empty()) end_job(jobs_.begin()->first);
    for (const auto& [id, worker] : workers_) worker->close();
    deadline_timer_.cancel();
}

std::vector<WorkerStatus> RenderFarm::worker_status() const {
    std::vector<WorkerStatus> out;
    for (const auto& [id, worker] : workers_) {
        const WorkerPace pace = scheduler_.pace(id);
        out.push_back({.peer = id,
                       .name = worker->name(),
                       .address = worker->address(),
                       .threads = worker->threads(),
                       .leases = pace.leases,
                       .tiles = worker->tiles,
                       .rays = worker->rays,
                       .round_trip_seconds = worker->round_trip_seconds(),
                       .prefetch = pace.limit,
                       .task_seconds = pace.task_seconds,
                       .memory_bytes = worker->memory_bytes(),
                       .overdue = pace.overdue,
                       .busy_seconds = worker->busy_seconds,
                       .relayed_bytes = worker->relayed_bytes(),
                       .sent_bytes = worker->sent_bytes()});
    }
    return out;
}

std::uint64_t RenderFarm::worker_bytes() const {
    std::uint64_t bytes = bytes_of_the_gone_;
    for (const auto& [id, worker] : workers_) bytes += worker->bytes_received();
    return bytes;
}

/// Later, so that results that arrive together are answered together.
void RenderFarm::pump_soon() {
    if (std::exchange(pump_is_due_, true)) return;
    asio::post(strand_, [this] {
        if (pump_is_due_) pump();
    });
}

/// Hands out whatever can be handed out now.
void RenderFarm::pump() {
    pump_is_due_ = false;
    const auto now = Clock::now();
    std::vector<WorkerSession*> served;
    for (const auto& [worker, task] : scheduler_.assign(now)) {
        Job& job = *jobs_.at(task.frame);
        if (!job.started) {
            job.started = now;
            if (!trace_.empty()) job.trace.emplace(now);
        }
        WorkerSession& session = *workers_.at(worker);
        if (const auto [share, first] = job.shares.try_emplace(worker); first) {
            share->second.name = session.name();
            share->second.threads = session.threads();
        }
        if (session.hand_out(job.request.spec, task)) served.push_back(&session);
    }
    for (WorkerSession* session : served) session->send_tasks();
    arm_timer();
}

void RenderFarm::arm_timer() {
    const auto next = scheduler_.next_deadline();
    if (!next) {
        deadline_timer_.expires_at(Clock::time_point::max());
    } else if (*next != deadline_timer_.expiry() || *next <= Clock::now()) {
        deadline_timer_.expires_at(*next);
        deadline_timer_.async_wait([this](const boost::system::error_code& cancelled) {
            if (!cancelled) pump();
        });
    }
}

/// Workers hold one version of a scene at a time: the one of the oldest frame in flight, so that it
/// is finished before they move on.
const ReadyScene* RenderFarm::wanted_version(const std::string& name) const {
    for (const auto& [frame, job] : jobs_)
        if (job->scene.name == name) return &job->scene;
    for (const ScenePtr& scene : kept_ready_)
        if (scene->now.name == name) return &scene->now;
    return nullptr;
}

/// What the oldest frame in flight asks for.
TracerKind RenderFarm::wanted_tracer(const std::string& name) const {
    for (const auto& [frame, job] : jobs_)
        if (job->scene.name == name) return job->request.spec.settings.tracer;
    return TracerKind::kdtree;
}

void RenderFarm::sync_scene(const std::string& name) {
    const ReadyScene* wanted = wanted_version(name);
    if (!wanted) return;
    for (const auto& [id, worker] : workers_) sync_worker(*worker, *wanted);
}

void RenderFarm::sync_worker(WorkerSession& worker, const ReadyScene& scene) {
    if (worker.bring(scene, wanted_tracer(scene.name)))
        scheduler_.scene_gone(worker.id(), scene.name);
}

/// Ends frames of a scene that no worker can build or render.
void RenderFarm::fail_if_hopeless(const std::string& scene) {
    std::vector<std::pair<std::uint64_t, std::string>> hopeless;
    for (const auto& [frame, job] : jobs_)
        if (job->scene.name == scene)
            if (const std::string reason = why_hopeless(*job); !reason.empty())
                hopeless.emplace_back(frame, reason);
    for (const auto& [frame, reason] : hopeless) {
        const FrameObserver observer = std::move(jobs_.at(frame)->observer);
        end_job(frame);
        observer.failed(reason);
    }
}

/// Empty as long as there is a worker that may yet render the frame, or none at all to judge by.
std::string RenderFarm::why_hopeless(const Job& job) const {
    std::string reason;
    for (const auto& [id, worker] : workers_) {
        const auto* state = worker->state_of(job.scene.name, job.scene.scene->version);
        const auto failure = job.failures.find(id);
        if (failure != job.failures.end())
            reason = failure->second;
        else if (state && !state->failure.empty())
            reason = state->failure;
        else
            return {};
        reason = fmt::format("worker {}: {}", worker->name(), reason);
    }
    return reason;
}

void RenderFarm::save_frame(std::uint64_t frame, std::function<void(SavedFrame)> saved) {
    const auto found = jobs_.find(frame);
    if (found == jobs_.end()) return;
    found->second->saving = std::move(saved);
    fold_next(*found->second);
}

/// On the pool, before the sums change again.
void RenderFarm::save_sums(Job& job) {
    if (job.sums->runs() == 0) return std::exchange(job.saving, {})({});
    job.sums_busy = true;
    const FrameStatistics so_far = statistics(job);
    asio::post(pool_, [this, sums = job.sums, frame = job.frame(), so_far] {
        const auto bytes = std::make_shared<const Bytes>(sums->saved());
        asio::post(strand_, [this, frame, bytes, so_far] {
            const auto found = jobs_.find(frame);
            if (found == jobs_.end()) return;
            Job& saved = *found->second;
            saved.sums_busy = false;
            std::exchange(saved.saving, {})({bytes, so_far.render_seconds, so_far.rays});
            fold_next(saved);
        });
    });
}

/// Folds the next run if it is complete, in bands of rows on the pool.
void RenderFarm::fold_next(Job& job) {
    if (!job.sums_busy && job.saving) save_sums(job);
    if (job.sums_busy) return;
    std::optional<RunBuffer> complete = job.assembler.take_complete();
    if (!complete) return;
    job.sums_busy = true;
    const auto run = std::make_shared<RunBuffer>(std::move(*complete));
    const int height = job.request.spec.size.height;
    const int bands = std::clamp(height / least_band_rows, 1, int(fold_threads_));
    const auto left = std::make_shared<std::atomic<int>>(bands);
    job.fold_began = Clock::now();
    for (int band = 0; band < bands; ++band)
        asio::post(pool_, [this, run, left, sums = job.sums, frame = job.frame(),
                           y0 = height * band / bands, y1 = height * (band + 1) / bands] {
            sums->fold(*run, y0, y1);
            if (--*left == 0)
                asio::post(strand_, [this, run, frame] { run_folded(frame, std::move(*run)); });
        });
}

void RenderFarm::run_folded(std::uint64_t frame, RunBuffer run) {
    const auto found = jobs_.find(frame);
    if (found == jobs_.end()) return;
    Job& job = *found->second;
    if (job.trace)
        job.trace->add("server", 1, fmt::format("fold of run {}", run.run),
                       Clock::now() - job.fold_began, Clock::now());
    job.sums->finish_run(run);
    job.error_estimate = job.sums->error_estimate();
    const auto look = job.observer.look ? job.observer.look(statistics(job))
                                        : std::function<void(const FrameSums&)>();
    if (!look) return run_seen(frame, std::move(run));
    asio::post(pool_, [this, look, sums = job.sums, frame,
                       seen = std::make_shared<RunBuffer>(std::move(run))] {
        look(*sums);
        asio::post(strand_, [this, seen, frame] { run_seen(frame, std::move(*seen)); });
    });
}

/// Lets the next run be folded.
void RenderFarm::run_seen(std::uint64_t frame, RunBuffer run) {
    const auto found = jobs_.find(frame);
    if (found == jobs_.end()) return;
    Job& job = *found->second;
    job.sums_busy = false;
    job.assembler.run_folded(std::move(run));
    stop_at_limits(job);
    scheduler_.allow_runs(frame, job.assembler.run_limit());
    fold_next(job);
    finish_if_complete(job);
    pump();
}

/// Ends the passes when time or error allows.
void RenderFarm::stop_at_limits(Job& job) {
    const FrameRequest& request = job.request;
    const bool in_time = request.time_limit <= 0 || !job.started ||
                         seconds_between(*job.started, Clock::now()) < request.time_limit;
    const bool too_rough = request.error_limit <= 0 || job.sums->runs() < least_runs_for_error ||
                           job.error_estimate > request.error_limit;
    if (in_time && too_rough) return;
    job.assembler.limit_passes(1);
    scheduler_.limit_runs(job.frame(), job.assembler.runs());
}

void RenderFarm::finish_if_complete(Job& job) {
    if (!job.assembler.finished()) return;
    if (job.trace) write_trace(job);
    FinishedFrame finished{job.request, job.sums, statistics(job)};
    finished.statistics.lights = job.sums->lights(most_lights_told);
    const FrameObserver observer = std::move(job.observer);
    end_job(job.frame());
    ++frames_done_;
    observer.done(std::move(finished));
}

/// At once, so that the file is there when the viewer hears that the frame is done: who asks for
/// traces accepts the pause.
void RenderFarm::write_trace(const Job& job) {
    std::ofstream out(trace_);
    out << job.trace->json();
    if (!out.flush()) spdlog::warn("cannot write {}", trace_.string());
}

void RenderFarm::end_job(std::uint64_t frame) {
    scheduler_.remove_frame(frame);
    for (const auto& [id, worker] : workers_) {
        worker->end_frame(frame);
        let_go_if_done(*worker);
    }
    const std::string scene = jobs_.at(frame)->scene.name;
    jobs_.erase(frame);
    sync_scene(scene);
    if (doomed_.contains(scene)) drop_scene(scene);
}

void RenderFarm::report(Job& job) {
    const FrameProgress progress{.request = job.request.request,
                                 .tiles_done = job.assembler.tiles_done(),
                                 .tiles_total = job.assembler.tiles_total(),
                                 .passes_done = job.sums->passes(),
                                 .workers = ready_workers(job),
                                 .error_estimate = job.error_estimate};
    if (job.reported == progress) return;
    job.reported = progress;
    job.observer.progress(progress);
}

void RenderFarm::schedule_report(Job& job) {
    job.report_timer.expires_after(report_interval);
    job.report_timer.async_wait(
        [this, frame = job.frame()](const boost::system::error_code& cancelled) {
            const auto found = jobs_.find(frame);
            if (cancelled || found == jobs_.end()) return;
            Job& reporting = *found->second;
            report(reporting);
            schedule_report(reporting);
            stop_at_limits(reporting);
            finish_if_complete(reporting);
            pump();
        });
}

std::uint32_t RenderFarm::ready_workers(const Job& job) const {
    return std::uint32_t(std::count_if(workers_.begin(), workers_.end(), [&](const auto& entry) {
        const auto* state = entry.second->state_of(job.scene.name, job.scene.scene->version);
        return state && state->ready;
    }));
}

FrameStatistics RenderFarm::statistics(const Job& job) const {
    FrameStatistics out;
    if (job.started) out.render_seconds = seconds_between(*job.started, Clock::now());
    out.passes = job.sums->passes();
    out.rays = job.rays;
    out.sanitised = job.sanitised;
    out.tiles_reissued = scheduler_.reissued(job.frame());
    out.error_estimate = job.error_estimate;
    out.active_lights = job.active_lights;
    for (const auto& [id, worker] : workers_) {
        const auto* state = worker->state_of(job.scene.name, job.scene.scene->version);
        if (!state || !state->ready) continue;
        out.build_seconds = std::max(out.build_seconds, state->report.build_seconds);
        out.modelled = state->report.modelled;
        out.left_out = state->report.left_out;
    }
    for (const auto& [id, share] : job.shares)
        if (share.tiles > 0) out.workers.push_back(share);
    const RenderSettings& settings = job.request.spec.settings;
    if (job.tiles > 0 && settings.integrator == Integrator::igi &&
        settings.filter != FilterPlace::off)
        out.modelled.push_back(filter_sentence(settings, double(job.pixel_bytes) / job.tiles));
    return out;
}

}  // namespace tessera
