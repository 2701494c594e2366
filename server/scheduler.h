// Which worker traces which tile. Demand-driven with prefetch, after Wald's thesis (2004), 8.1.2
// and 8.2: returning a tile is asking for the next one, and each worker always has a few tiles
// waiting so that the round trip is hidden.
//
// Where we differ: the thesis fixes the number of tiles ahead and knows no answer to workers that
// stall, slow down or die. Here
//   - how far a worker is ahead follows its measured round trip and pace,
//   - tiles go out in the order of what they cost in the last such frame, expensive first (Graham,
//     "Bounds on Multiprocessing Timing Anomalies", 1969),
//   - every tile handed out is a lease. One past its deadline, at the worker's own pace, is handed
//     out again, and when hands are idle at the end of a frame, so is what they would finish sooner
//     (Zaharia et al., "Improving MapReduce Performance in Heterogeneous Environments", 2008). The
//     first answer wins. The tiles of a lost worker go out before all others,
//   - a worker gets none of the last tiles that it would finish after everybody else,
//   - tiles that would take a thread long for what is left go out in quarters: towards the end of a
//     frame, and all of them where there are many threads for few tiles (Polychronopoulos and Kuck,
//     "Guided Self-Scheduling", 1987, with two sizes); and late tiles, to idle hands.
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
#include <unordered_map>
#include <utility>
#include <vector>

#include "common/tile.h"
#include "server/cost_map.h"

namespace tessera {

using TimePoint = std::chrono::steady_clock::time_point;
using Duration = std::chrono::steady_clock::duration;

struct SchedulerConfig {
    /// Tasks that a worker holds beside one per thread until its pace is known (Wald 2004, 8.2.4).
    std::uint32_t prefetch = 4;
    /// And at most, later: bounds what a lost worker takes with it.
    std::uint32_t most_prefetch = 256;
    /// Shortest time after which a lease has expired...
    Duration shortest_lease = std::chrono::milliseconds(250);
    /// ...and the same for a worker that has not answered in this frame yet: it may be building.
    Duration first_lease = std::chrono::seconds(2);
    /// Leases last this many times what is expected of the worker, from handing out to answer.
    double patience = 8;
    /// Idle hands double a task that is out this many times what is expected...
    double late = 2;
    /// ...or that they would finish in this share of the time that its holder needs...
    double faster = 0.5;
    /// ...as long as fewer workers than this hold it.
    std::size_t most_copies = 2;
    /// A tile is cut when a thread's share of the work that is left is less than this many of it.
    /// 0: never.
    double fineness = 2;
    /// The server's time for an answer: quarters must not keep it busier than it can be.
    Duration server_time = std::chrono::microseconds(4);
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

/// What the scheduler knows of a worker.
struct WorkerPace {
    std::uint32_t leases = 0;  ///< tasks it holds
    std::uint32_t limit = 0;   ///< and holds at most; in whole tiles
    double round_trip = 0;     ///< seconds
    double task_seconds = 0;   ///< a thread's for an average task; 0: not known yet
    bool retired = false;
    bool overdue = false;  ///< owes an answer for longer than a lease lasts
};

class Scheduler {
public:
    explicit Scheduler(const SchedulerConfig& config = {}) : config_(config) {}

    void add_worker(std::uint64_t worker, std::uint32_t threads);
    /// The worker's tasks are handed out again first.
    void remove_worker(std::uint64_t worker);
    /// The worker goes on to answer, but gets no more tasks.
    void retire(std::uint64_t worker);
    /// From now on the worker renders frames of this version of the scene, and of no other version.
    void scene_ready(std::uint64_t worker, const std::string& scene, std::uint64_t version);
    /// The worker renders no frames of that scene any more.
    void scene_gone(std::uint64_t worker, const std::string& scene);
    /// The worker has shown that it lives, with an answer that took `seconds` there and back.
    void round_trip(std::uint64_t worker, double seconds);

    /// Runs before `run_limit` may be handed out (FrameAssembler::run_limit), those before
    /// `first_run` are done already.
    void add_frame(const FrameSpec& spec, std::uint32_t run_limit, std::uint32_t first_run = 0);
    /// Moves the limit on; runs in front of it are handed out in order.
    void allow_runs(std::uint64_t frame, std::uint32_t run_limit);
    /// Nothing from `runs` on is wanted any more.
    void limit_runs(std::uint64_t frame, std::uint32_t runs);
    /// This worker cannot render this frame: what it holds of it goes to others.
    void exclude(std::uint64_t worker, std::uint64_t frame);
    /// The frame is complete or cancelled.
    void remove_frame(std::uint64_t frame);

    /// `render_seconds`: what the worker says that the task took it.
    Answer completed(std::uint64_t worker, const TileTask& task, TimePoint now,
                     std::optional<double> render_seconds = {});

    /// Tasks to send now. Frames take turns, task by task.
    std::vector<Assignment> assign(TimePoint now);
    /// When assign() may have something new to say without any event.
    std::optional<TimePoint> next_deadline() const;

    WorkerPace pace(std::uint64_t worker) const;
    /// Tasks the worker holds.
    std::uint32_t leases(std::uint64_t worker) const;
    /// Tasks of the frame that were handed out more than once.
    std::uint64_t reissued(std::uint64_t frame) const { return frames_.at(frame).reissued; }

private:
    using Slot = std::uint32_t;  ///< index of a worker
    static constexpr std::uint32_t none = ~0u;

    struct Worker {
        std::uint64_t id = 0;  ///< 0: the slot is free
        std::uint32_t threads = 1;
        std::uint32_t limit = 1;
        std::uint32_t leases = 0;
        std::uint32_t quarters_held = 0;
        double work_held = 0;       ///< costs of the tasks it holds
        double round_trip = 0;      ///< seconds
        double task_seconds = 0;    ///< of a thread for a task of cost 1; 0: not known yet
        std::uint32_t expired = 0;  ///< leases of those that it still holds
        bool overdue =
            false;  ///< lets leases expire; until it answers, or has none and is heard of
        bool retired = false;
        bool waiting = false;                                            ///< in waiting_
        std::vector<std::pair<std::string, std::uint64_t>> scenes = {};  ///< name -> version
    };
    /// A task in a worker's hands. Those of one task form a list.
    struct Lease {
        Slot worker = none;         ///< none: free to use again
        std::uint32_t next = none;  ///< of the same task
        TileTask task;
        std::uint32_t run = 0;
        float cost = 1;
        float ahead = 1;  ///< cost of what its thread had to do up to its end, when handed out
        bool expired = false;
        TimePoint issued;
    };
    struct Task {
        std::uint32_t leases = none;    ///< the oldest
        std::uint32_t quarters = none;  ///< of a tile that is cut: where its first quarter is
        float cost = 0;                 ///< of what has been answered
        bool handed_out = false;
        bool done = false;
        bool queued = false;  ///< in Frame::again
    };
    /// A run of which tasks have been handed out.
    struct Run {
        std::vector<Task> tasks;      ///< by tile; then the quarters of tiles that are cut
        std::uint32_t unsettled = 0;  ///< tasks not done, or still in somebody's hands
    };
    /// What the workers that may be trusted with a frame can do together.
    struct Crew {
        double speed = 0;  ///< tasks of cost 1 a second; 0: not known
        double threads = 0;
        double busy_seconds = 0;  ///< that tasks of other frames in their hands take them
        double task_seconds = 0;  ///< mean time of a thread for a task of cost 1...
        double round_trip = 0;    ///< ...and from handing one out to its answer beside that
        TimePoint valid_until;
    };
    struct Frame {
        FrameSpec spec;
        std::uint32_t runs = 0;
        std::uint32_t run_limit = 0;
        std::uint32_t next_run = 0;  ///< first task never handed out
        std::uint32_t next_index = 0;
        std::uint32_t next_part = 0;  ///< not 0: that tile is cut
        CostMap costs;
        std::vector<std::uint32_t> order;  ///< of the tiles in each run
        std::deque<TileTask> again;        ///< lost or expired; goes before new ones
        std::uint32_t first_open = 0;
        std::deque<Run> open;     ///< first_open and on
        double work_left = 0;     ///< costs of the tasks of all runs that are not done
        double work_held = 0;     ///< costs of its tasks in workers' hands
        double task_seconds = 0;  ///< from handing out to answer, running mean; 0: not known yet
        std::uint64_t reissued = 0;
        std::set<std::uint64_t> excluded;  ///< workers that cannot render it
        std::vector<bool> answered;        ///< by worker: has returned a task of it
        Crew crew;
        TimePoint next_search;  ///< for tasks that idle hands could double
    };

    Worker& worker_of(std::uint64_t id) { return workers_[slots_.at(id)]; }
    static bool ready(const Worker& worker, const Frame& frame);
    static bool answered(const Frame& frame, Slot worker);
    static float cost_of(const Frame& frame, const TileTask& name);
    static Task* find(Frame& frame, std::uint32_t run, const TileTask& name);
    static Run& open_run(Frame& frame, std::uint32_t run);
    static void cut(Run& run, std::uint32_t tile);
    static bool is_cut(Frame& frame, std::uint32_t run, const TileTask& name);
    static void finish(Run& run, Task& task);
    static void finish_tile(Frame& frame, std::uint32_t run, const TileTask& name, float cost);
    static double work_left(const Frame& frame, const Run& run, std::uint32_t tile);
    bool quarters_suit_server(const Frame& frame, std::uint32_t tile, double threads) const;
    bool can_cut_late(Frame& frame, std::uint32_t run, const TileTask& name) const;
    static void cut_late(Frame& frame, std::uint32_t run, const TileTask& name);
    bool pays_to_cut(const Frame& frame, std::uint32_t tile) const;
    bool holds(const Task& task, Slot worker) const;
    void queue_if_orphaned(Frame& frame, std::uint32_t run, const TileTask& name) const;

    void lease(Slot worker, Frame& frame, const TileTask& name, TimePoint now,
               std::vector<Assignment>& out);
    void end_lease(Frame& frame, Task& task, std::uint32_t lease);
    void end_leases(Frame& frame, Task& task);
    void end_leases_of(Slot worker, const Frame* only);
    void expire(TimePoint now);
    void wait(Slot worker);
    void crew_changed();

    float learn(Slot worker, Frame& frame, const Lease& lease, TimePoint now,
                std::optional<double> render_seconds);
    void set_limit(Slot worker);
    void measure_crew(Frame& frame, TimePoint now) const;
    static double seconds_for(const Worker& worker, double ahead);
    double expected_seconds(const Lease& lease, const Frame& frame) const;
    Duration lease_time(const Lease& lease, const Frame& frame) const;
    static bool in_time(const Worker& worker, const Frame& frame, const TileTask& name);

    static bool has_work(const Frame& frame);
    std::optional<TileTask> lost_task_for(Slot worker, Frame& frame);
    std::optional<TileTask> new_task_for(Slot worker, Frame& frame);
    bool hand_out_in_turn(Slot worker, TimePoint now, std::vector<Assignment>& out);
    void double_late(Frame& frame, TimePoint now, std::vector<Assignment>& out);

    SchedulerConfig config_;
    std::vector<Worker> workers_;
    std::unordered_map<std::uint64_t, Slot> slots_;
    std::vector<Slot> free_slots_;
    std::vector<Slot> waiting_;  ///< workers that may take tasks
    std::vector<Lease> leases_;
    std::vector<std::uint32_t> free_leases_;
    std::map<std::uint64_t, Frame> frames_;
    CostMemory memory_;
    std::uint64_t last_frame_ = 0;              ///< whose turn it was
    TimePoint next_expiry_ = TimePoint::max();  ///< no lease expires before
    TimePoint next_late_ = TimePoint::max();    ///< when idle hands may double a task
};

}  // namespace tessera
