// The workers as one: brings them scenes, spreads frames over them, adds up what comes back.
// The shell around Scheduler and FrameAssembler; lives on the server's strand. Only folding leaves
// the strand, for a small pool of threads.
#pragma once

#include <filesystem>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "server/frame.h"
#include "server/relay_plan.h"
#include "server/scene_store.h"
#include "server/scheduler.h"
#include "server/worker_session.h"

namespace tessera {

struct FinishedFrame {
    FrameRequest request;
    std::shared_ptr<const FrameSums> sums;
    FrameStatistics statistics;
};

/// A frame on its way, as FrameSums::resume takes it.
struct SavedFrame {
    std::shared_ptr<const Bytes> sums;
    double render_seconds = 0;
    std::uint64_t rays = 0;
};

/// What the viewer's session wants to hear; called on the strand. After `done` or `failed` nothing
/// more comes.
struct FrameObserver {
    std::function<void(const FrameProgress&)> progress;
    std::function<void(FinishedFrame)> done;
    std::function<void(const std::string& reason)> failed;
    /// May be empty. Called after every run of passes; what it returns, if anything, runs on the
    /// pool before the sums change again.
    std::function<std::function<void(const FrameSums&)>(const FrameStatistics&)> look = {};
};

class RenderFarm {
public:
    /// Everything happens on `strand`; folding on `fold_threads` threads of its own. `trace`: file
    /// for the timeline of the frame that finished last; empty: none.
    RenderFarm(const asio::any_io_executor& strand, unsigned fold_threads,
               std::filesystem::path trace = {}, RelayMode relays = RelayMode::automatic);
    ~RenderFarm();

    /// Workers get this scene as soon as they join.
    void keep_ready(ScenePtr scene);
    /// A scene that is kept ready has a newer version: workers get it after frames in flight.
    void scene_changed(const std::string& name) { sync_scene(name); }
    /// No new frames of the scene will come: workers drop it after those in flight.
    void drop_scene(const std::string& name);

    /// Returns the number of the frame. It waits for workers if there are none, and goes on from
    /// `sums` if there are any.
    std::uint64_t begin_frame(const FrameRequest& request, const ReadyScene& scene,
                              FrameObserver observer, std::shared_ptr<FrameSums> sums = {});
    /// `saved` is called with what the frame has added up to so far, empty before the first run is
    /// complete, unless the frame is over before. One at a time; the frame goes on.
    void save_frame(std::uint64_t frame, std::function<void(SavedFrame)> saved);
    /// Nothing more is said about the frame. A frame that is over is no error.
    void cancel_frame(std::uint64_t frame);

    void add_worker(std::shared_ptr<WorkerSession> worker);
    void remove_worker(std::uint64_t worker);
    void scene_ready(WorkerSession& worker, const std::string& scene, std::uint64_t version);
    void scene_failed(WorkerSession& worker, const std::string& scene);
    void frame_failed(WorkerSession& worker, std::uint64_t frame, const std::string& reason);
    /// `pixels`: of these tiles, one after the other. Throws ProtocolError when one does not fit
    /// its frame.
    void tile_results(WorkerSession& worker, const TileResults& results,
                      std::span<const std::byte> pixels);

    /// Who sends what the worker asks for.
    std::vector<RelayPlan::Share> share_blobs(const WorkerSession& worker,
                                              const BlobRequest& request, const BlobStore& offered);
    const std::string& relay_address(std::uint64_t worker) const;

    /// The worker gets no more tasks, and goes when it has answered those that it holds.
    void retire(WorkerSession& worker);
    /// The worker has answered a ping.
    void round_trip(const WorkerSession& worker, double seconds);

    /// Closes all workers' connections and forgets all frames.
    void stop();

    std::vector<WorkerStatus> worker_status() const;
    /// That have come from workers, also from those that left.
    std::uint64_t worker_bytes() const;
    std::uint32_t frames_in_flight() const { return std::uint32_t(jobs_.size()); }
    std::uint64_t frames_done() const { return frames_done_; }
    asio::any_io_executor strand() const { return strand_; }
    /// For other work that is too heavy for the strand.
    asio::any_io_executor pool() { return pool_.get_executor(); }

private:
    struct Job;

    void tile_result(WorkerSession& worker, const TileReport& tile,
                     std::span<const std::byte> pixels, TimePoint now);
    void let_go_if_done(WorkerSession& worker);
    void pump();
    void pump_soon();
    void arm_timer();
    void sync_scene(const std::string& name);
    void sync_worker(WorkerSession& worker, const ReadyScene& scene);
    const ReadyScene* wanted_version(const std::string& name) const;
    TracerKind wanted_tracer(const std::string& name) const;
    void fail_if_hopeless(const std::string& scene);
    std::string why_hopeless(const Job& job) const;

    void fold_next(Job& job);
    void save_sums(Job& job);
    void run_folded(std::uint64_t frame, RunBuffer run);
    void write_trace(const Job& job);
    void run_seen(std::uint64_t frame, RunBuffer run);
    void stop_at_limits(Job& job);
    void finish_if_complete(Job& job);
    void end_job(std::uint64_t frame);
    void report(Job& job);
    void schedule_report(Job& job);
    std::uint32_t ready_workers(const Job& job) const;
    FrameStatistics statistics(const Job& job) const;

    asio::any_io_executor strand_;
    Scheduler scheduler_;
    RelayPlan relays_;
    std::map<std::uint64_t, std::shared_ptr<WorkerSession>> workers_;
    std::map<std::uint64_t, std::unique_ptr<Job>> jobs_;  ///< by frame number: oldest first
    std::vector<ScenePtr> kept_ready_;
    std::set<std::string> doomed_;  ///< to be dropped once no frame needs them
    std::uint64_t last_frame_ = 0;
    std::uint64_t frames_done_ = 0;
    std::uint64_t bytes_of_the_gone_ = 0;
    bool pump_is_due_ = false;
    std::shared_ptr<BufferPool> buffers_ = std::make_shared<BufferPool>();
    asio::steady_timer deadline_timer_;
    unsigned fold_threads_;
    std::filesystem::path trace_;
    asio::thread_pool pool_;
};

}  // namespace tessera
