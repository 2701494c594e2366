// Which worker traces which tile. Demand-driven with prefetch, after Wald's thesis (2004), 8.1.2
// and 8.2: returning a tile is asking for the next one, and each worker always has a few tiles
// waiting so that the round trip is hidden.
//
// Where we differ: the thesis has no answer to workers that stall or die. Here every tile handed
// out is a lease. A lease past its deadline, or old ones when hands are idle at the end of a frame,
// are given to another worker as well; the first answer wins. The tiles of a lost worker are handed
// out again before all others.
//
// Pure: events and a `now` in, assignments out.
#pragma once

#include <chrono>
#include <cstdint>
#include <deque>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "common/tile.h"

namespace tessera {

using TimePoint = std::chrono::steady_clock::time_point;
using Duration = std::chrono::steady_clock::duration;

struct SchedulerConfig {
    std::uint32_t prefetch = 4;  ///< tasks a worker holds beside one per thread (Wald 2004, 8.2.4)
    /// Shortest time after which a lease has expired.
    Duration shortest_lease = std::chrono::seconds(2);
    /// Leases last this many times what a task took lately, from handing out to answer.
    double patience = 8;
    /// Idle hands double a task that is out this many times what a task took lately...
    double late = 2;
    /// ...as long as fewer workers than this hold it.
    std::size_t most_copies = 2;
};

struct Assignment {
    std::uint64_t worker = 0;
    TileTask task;

    bool operator==(const Assignment&) const = default;
};

/// What a worker's answer is to the frame.
enum class Answer : std::uint8_t {
    first,      ///< to be used
    duplicate,  ///< another worker was faster
    unknown,    ///< frame gone, pass no longer wanted, or never handed to this worker
};

class Scheduler {
public:
    explicit Scheduler(const SchedulerConfig& config = {}) : config_(config) {}

    void add_worker(std::uint64_t worker, std::uint32_t threads);
    /// The worker's tasks are handed out again first.
    void remove_worker(std::uint64_t worker);
    /// From now on the worker renders frames of this version of the scene, and of no other version.
    void scene_ready(std::uint64_t worker, const std::string& scene, std::uint64_t version);
    /// The worker renders no frames of that scene any more.
    void scene_gone(std::uint64_t worker, const std::string& scene);

    /// Runs before `run_limit` may be handed out (FrameAssembler::run_limit).
    void add_frame(const FrameSpec& spec, std::uint32_t run_limit);
    /// Moves the limit on; runs in front of it are handed out in order.
    void allow_runs(std::uint64_t frame, std::uint32_t run_limit);
    /// Nothing from `runs` on is wanted any more.
    void limit_runs(std::uint64_t frame, std::uint32_t runs);
    /// This worker cannot render this frame: what it holds of it goes to others.
    void exclude(std::uint64_t worker, std::uint64_t frame);
    /// The frame is complete or cancelled.
    void remove_frame(std::uint64_t frame);

    Answer completed(std::uint64_t worker, const TileTask& task, TimePoint now);

    /// Tasks to send now. Frames take turns, task by task.
    std::vector<Assignment> assign(TimePoint now);
    /// When assign() may have something new to say without any event.
    std::optional<TimePoint> next_deadline() const;

    /// Tasks the worker holds.
    std::uint32_t leases(std::uint64_t worker) const { return workers_.at(worker).leases; }
    /// Tasks of the frame that were handed out more than once.
    std::uint64_t reissued(std::uint64_t frame) const { return frames_.at(frame).reissued; }

private:
    struct Worker {
        std::uint32_t threads = 1;
        std::uint32_t limit = 1;
        std::uint32_t leases = 0;
        std::map<std::string, std::uint64_t> scenes;  ///< name -> version
    };
    struct Lease {
        std::uint64_t worker = 0;
        TimePoint issued;
        TimePoint deadline;
        bool expired = false;
    };
    /// A task handed out. Stays until every holder has answered, or the frame is gone.
    struct Outstanding {
        std::vector<Lease> leases;
        bool done = false;
        bool queued = false;  ///< in Frame::again
    };
    struct Frame {
        FrameSpec spec;
        std::uint32_t runs = 0;
        std::uint32_t run_limit = 0;
        std::uint32_t next_run = 0;  ///< first task never handed out
        std::uint32_t next_tile = 0;
        std::deque<TileTask> again;  ///< lost or expired; goes before new ones
        std::map<TileTask, Outstanding> outstanding;
        double task_seconds = 0;  ///< from handing out to answer, running mean; 0: not known yet
        std::uint64_t reissued = 0;
        std::set<std::uint64_t> excluded;  ///< workers that cannot render it
    };

    bool ready(std::uint64_t worker, const Frame& frame) const;
    static void take_back(Frame& frame, std::uint64_t worker);
    static bool holds(const Outstanding& outstanding, std::uint64_t worker);
    static void queue_if_orphaned(Frame& frame, const TileTask& task, Outstanding& outstanding);
    static std::optional<TileTask> lost_task_for(std::uint64_t worker, Frame& frame);
    static std::optional<TileTask> new_task(Frame& frame);
    std::optional<TileTask> late_task_for(std::uint64_t worker, const Frame& frame, TimePoint now);

    template <class Choose>
    std::optional<Assignment> in_turn(std::uint64_t worker, TimePoint now, const Choose& choose);
    std::optional<Assignment> next_for(std::uint64_t worker, TimePoint now);
    void lease(std::uint64_t worker, Frame& frame, const TileTask& task, TimePoint now);
    void release_all(const Outstanding& outstanding);
    void expire(TimePoint now);

    SchedulerConfig config_;
    std::map<std::uint64_t, Worker> workers_;
    std::map<std::uint64_t, Frame> frames_;
    std::uint64_t last_frame_ = 0;              ///< whose turn it was
    TimePoint next_expiry_ = TimePoint::max();  ///< no lease expires before
    TimePoint next_late_ = TimePoint::max();    ///< when idle hands may double a task
};

}  // namespace tessera
