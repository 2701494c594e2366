#include "server/scheduler.h"

#include <algorithm>
#include <cmath>
#include <span>

#include "common/check.h"
#include "server/runs.h"

namespace tessera {
namespace {

/// Weight of the newest task in running means: the last ten or so count.
constexpr double newest_weight = 0.1;
/// No task takes less, whatever a worker says.
constexpr double least_task_seconds = 1e-6;
/// Times the mean that a tile may well cost of which nothing is known.
constexpr double doubt = 2;
/// Parts of a task's time after which what is known of all workers together is summed up again.
constexpr double crew_refresh = 1.0 / 8;
constexpr auto least_crew_refresh = std::chrono::microseconds(100);

Duration seconds(double s) {
    return std::chrono::duration_cast<Duration>(std::chrono::duration<double>(s));
}

std::uint32_t quarters_in(const TileTask& task) { return task.part == 0 ? quarters : 1; }

void update_mean(double& mean, double value) {
    mean += (mean == 0 ? 1 : newest_weight) * (value - mean);
}

}  // namespace

// ---- Workers ------------------------------------------------------------------------------------

void Scheduler::add_worker(std::uint64_t worker, std::uint32_t threads) {
    Slot slot = Slot(workers_.size());
    if (free_slots_.empty()) {
        workers_.emplace_back();
    } else {
        slot = free_slots_.back();
        free_slots_.pop_back();
    }
    CHECK(slots_.emplace(worker, slot).second);
    const bool waiting = workers_[slot].waiting;  // the list may still name the slot
    workers_[slot] = {.id = worker, .threads = threads, .limit = threads + config_.prefetch};
    workers_[slot].waiting = waiting;
    for (auto& [id, frame] : frames_)
        if (slot < frame.answered.size()) frame.answered[slot] = false;
    wait(slot);
}

void Scheduler::remove_worker(std::uint64_t worker) {
    const auto found = slots_.find(worker);
    if (found == slots_.end()) return;
    end_leases_of(found->second, nullptr);
    workers_[found->second].id = 0;
    free_slots_.push_back(found->second);
    slots_.erase(found);
    crew_changed();
}

void Scheduler::retire(std::uint64_t worker) {
    worker_of(worker).retired = true;
    crew_changed();
}

void Scheduler::exclude(std::uint64_t worker, std::uint64_t frame) {
    Frame& f = frames_.at(frame);
    f.excluded.insert(worker);
    end_leases_of(slots_.at(worker), &f);
    crew_changed();
}

void Scheduler::scene_ready(std::uint64_t worker, const std::string& scene, std::uint64_t version) {
    scene_gone(worker, scene);
    worker_of(worker).scenes.emplace_back(scene, version);
}

void Scheduler::scene_gone(std::uint64_t worker, const std::string& scene) {
    std::erase_if(worker_of(worker).scenes, [&](const auto& s) { return s.first == scene; });
    crew_changed();
}

void Scheduler::round_trip(std::uint64_t worker, double seconds) {
    Worker& w = worker_of(worker);
    // A sign of life is not yet a tile.
    w.overdue = w.expired > 0;
    update_mean(w.round_trip, seconds);
    set_limit(slots_.at(worker));
}

/// How far a worker is ahead: as many tasks as it finishes in a round trip, which is a Poisson
/// variable when tasks differ, so its mean and two deviations; and one.
void Scheduler::set_limit(Slot worker) {
    Worker& w = workers_[worker];
    if (w.task_seconds > 0) {
        const double finished =
            std::min(w.threads * w.round_trip / w.task_seconds, double(config_.most_prefetch));
        const double ahead = std::ceil(finished + 2 * std::sqrt(finished)) + 1;
        w.limit = w.threads + std::min(std::uint32_t(ahead), config_.most_prefetch);
    }
    wait(worker);
}

void Scheduler::wait(Slot worker) {
    Worker& w = workers_[worker];
    if (w.waiting || w.quarters_held >= quarters * w.limit) return;
    w.waiting = true;
    waiting_.push_back(worker);
}

WorkerPace Scheduler::pace(std::uint64_t worker) const {
    const Worker& w = workers_[slots_.at(worker)];
    return {.leases = w.leases,
            .limit = w.limit,
            .round_trip = w.round_trip,
            .task_seconds = w.task_seconds,
            .retired = w.retired,
            .overdue = w.overdue};
}

std::uint32_t Scheduler::leases(std::uint64_t worker) const {
    return workers_[slots_.at(worker)].leases;
}

// ---- Frames -------------------------------------------------------------------------------------

void Scheduler::add_frame(const FrameSpec& spec, std::uint32_t run_limit, std::uint32_t first_run) {
    Frame frame;
    frame.spec = spec;
    frame.runs = run_count(spec.settings);
    frame.run_limit = std::min(run_limit, frame.runs);
    frame.costs = memory_.recall(spec);
    frame.order = frame.costs.order();
    frame.next_run = frame.first_open = first_run;
    frame.work_left = double(frame.runs - first_run) * tile_count(spec.size);
    CHECK(frames_.emplace(spec.frame, std::move(frame)).second);
}

void Scheduler::allow_runs(std::uint64_t frame, std::uint32_t run_limit) {
    Frame& f = frames_.at(frame);
    f.run_limit = std::min(std::max(f.run_limit, run_limit), f.runs);
}

void Scheduler::limit_runs(std::uint64_t frame, std::uint32_t runs) {
    Frame& f = frames_.at(frame);
    const std::uint32_t tiles = tile_count(f.spec.size);
    const std::uint32_t opened = f.first_open + std::uint32_t(f.open.size());
    if (f.runs > std::max(runs, opened))
        f.work_left -= double(f.runs - std::max(runs, opened)) * tiles;
    f.runs = std::min(f.runs, runs);
    f.run_limit = std::min(f.run_limit, runs);
    while (!f.open.empty() && f.first_open + f.open.size() > runs) {
        for (std::uint32_t tile = 0; tile < tiles; ++tile)
            f.work_left -= work_left(f, f.open.back(), tile);
        for (Task& task : f.open.back().tasks) end_leases(f, task);
        f.open.pop_back();
    }
}

void Scheduler::remove_frame(std::uint64_t frame) {
    const auto found = frames_.find(frame);
    if (found == frames_.end()) return;
    Frame& f = found->second;
    for (Run& run : f.open)
        for (Task& task : run.tasks) end_leases(f, task);
    memory_.keep(f.spec, f.costs);
    frames_.erase(found);
}

bool Scheduler::ready(const Worker& worker, const Frame& frame) {
    if (worker.id == 0 || worker.retired || frame.excluded.contains(worker.id)) return false;
    return std::any_of(worker.scenes.begin(), worker.scenes.end(), [&](const auto& scene) {
        return scene.second == frame.spec.version && scene.first == frame.spec.scene;
    });
}

bool Scheduler::answered(const Frame& frame, Slot worker) {
    return worker < frame.answered.size() && frame.answered[worker];
}

float Scheduler::cost_of(const Frame& frame, const TileTask& name) {
    return frame.costs.predicted(name.tile) * (name.part == 0 ? 1 : 1.0f / quarters);
}

/// Null as well for quarters of a tile that is not cut.
Scheduler::Task* Scheduler::find(Frame& frame, std::uint32_t run, const TileTask& name) {
    if (run < frame.first_open || run - frame.first_open >= frame.open.size()) return nullptr;
    std::vector<Task>& tasks = frame.open[run - frame.first_open].tasks;
    Task& tile = tasks[name.tile];
    if (name.part == 0) return &tile;
    return tile.quarters == none ? nullptr : &tasks[tile.quarters + name.part - 1];
}

Scheduler::Run& Scheduler::open_run(Frame& frame, std::uint32_t run) {
    const std::uint32_t tiles = tile_count(frame.spec.size);
    while (frame.first_open + frame.open.size() <= run)
        frame.open.push_back({.tasks = std::vector<Task>(tiles), .unsettled = tiles});
    return frame.open[run - frame.first_open];
}

void Scheduler::cut(Run& run, std::uint32_t tile) {
    const Task part{.handed_out = run.tasks[tile].handed_out};
    run.tasks[tile].quarters = std::uint32_t(run.tasks.size());
    run.tasks.resize(run.tasks.size() + quarters, part);
    run.unsettled += quarters;
}

/// Whether this is a tile that its quarters stand for.
bool Scheduler::is_cut(Frame& frame, std::uint32_t run, const TileTask& name) {
    return name.part == 0 && find(frame, run, name)->quarters != none;
}

/// Costs of the tile's tasks that are not done.
double Scheduler::work_left(const Frame& frame, const Run& run, std::uint32_t tile) {
    const Task& whole = run.tasks[tile];
    const double cost = double(frame.costs.predicted(tile));
    if (whole.quarters == none || whole.done) return whole.done ? 0 : cost;
    const auto parts = std::span(run.tasks).subspan(whole.quarters, quarters);
    return cost / quarters * double(std::ranges::count(parts, false, &Task::done));
}

void Scheduler::finish(Run& run, Task& task) {
    if (!task.done && task.leases == none) --run.unsettled;
    task.done = true;
}

/// After the first answer to a task: with a tile its quarters are done, and with the last quarter
/// the tile. Enters what a tile has cost into the map.
void Scheduler::finish_tile(Frame& frame, std::uint32_t number, const TileTask& name, float cost) {
    Run& run = open_run(frame, number);
    Task& tile = run.tasks[name.tile];
    const double before = work_left(frame, run, name.tile);
    finish(run, *find(frame, number, name));
    tile.cost = name.part == 0 ? cost : tile.cost + cost;
    if (tile.quarters != none) {
        const auto parts = std::span(run.tasks).subspan(tile.quarters, quarters);
        for (Task& part : parts)
            if (name.part == 0) finish(run, part);
        if (std::ranges::all_of(parts, &Task::done)) finish(run, tile);
    }
    frame.work_left = std::max(0.0, frame.work_left - before + work_left(frame, run, name.tile));
    if (tile.done) frame.costs.measure(name.tile, tile.cost);
}

/// Whether the tile would still be under way when there is little else left to do, and its quarters
/// are large enough for the server. What others have to do counts: nobody is idle meanwhile.
bool Scheduler::pays_to_cut(const Frame& frame, std::uint32_t tile) const {
    if (!quarters_suit_server(frame, tile, frame.crew.threads)) return false;
    const double cost = double(frame.costs.predicted(tile));
    double left = 0;
    for (const auto& [id, other] : frames_)
        if (&other == &frame || has_work(other)) left += other.work_left;
    const double feared = cost * (frame.costs.is_known() ? 1 : doubt);
    return config_.fineness * feared > left / frame.crew.threads;
}

/// Whether there are any, and the server can take them from so many threads.
bool Scheduler::quarters_suit_server(const Frame& frame, std::uint32_t tile, double threads) const {
    const Crew& crew = frame.crew;
    if (crew.speed == 0 || !can_be_cut(frame.spec.size, tile)) return false;
    const double server_seconds = std::chrono::duration<double>(config_.server_time).count();
    return double(frame.costs.predicted(tile)) / quarters * crew.task_seconds >=
           threads * server_seconds;
}

/// Whether idle hands may share a tile that is out. Such are few: the server does not mind.
bool Scheduler::can_cut_late(Frame& frame, std::uint32_t run, const TileTask& name) const {
    return config_.fineness > 0 && name.part == 0 && !find(frame, run, name)->queued &&
           quarters_suit_server(frame, name.tile, 1);
}

/// The quarters of a tile that is out go to whoever is idle next.
void Scheduler::cut_late(Frame& frame, std::uint32_t run, const TileTask& name) {
    cut(open_run(frame, run), name.tile);
    TileTask part = name;
    for (part.part = 1; part.part <= quarters; ++part.part) {
        find(frame, run, part)->queued = true;
        frame.again.push_back(part);
    }
}

// ---- Leases -------------------------------------------------------------------------------------

bool Scheduler::holds(const Task& task, Slot worker) const {
    for (std::uint32_t l = task.leases; l != none; l = leases_[l].next)
        if (leases_[l].worker == worker) return true;
    return false;
}

/// Queues a task that nobody can be trusted to answer.
void Scheduler::queue_if_orphaned(Frame& frame, std::uint32_t run, const TileTask& name) const {
    Task& task = *find(frame, run, name);
    if (task.done || task.queued || is_cut(frame, run, name)) return;
    for (std::uint32_t l = task.leases; l != none; l = leases_[l].next)
        if (!leases_[l].expired) return;
    task.queued = true;
    frame.again.push_back(name);
}

void Scheduler::lease(Slot worker, Frame& frame, const TileTask& name, TimePoint now,
                      std::vector<Assignment>& out) {
    std::uint32_t index = std::uint32_t(leases_.size());
    if (free_leases_.empty()) {
        leases_.emplace_back();
    } else {
        index = free_leases_.back();
        free_leases_.pop_back();
    }
    Worker& w = workers_[worker];
    Lease& lease = leases_[index];
    const float cost = cost_of(frame, name);
    lease = {.worker = worker,
             .next = none,
             .task = name,
             .run = *run_of(frame.spec, name),
             .cost = cost,
             .ahead = float(w.work_held / w.threads) + cost,
             .expired = false,
             .issued = now};
    ++w.leases;
    w.quarters_held += quarters_in(name);
    w.work_held += cost;
    frame.work_held += cost;

    // Append it to those of the task.
    open_run(frame, lease.run);
    Task& task = *find(frame, lease.run, name);
    if (task.handed_out) ++frame.reissued;
    task.handed_out = true;
    std::uint32_t* link = &task.leases;
    while (*link != none) link = &leases_[*link].next;
    *link = index;
    next_expiry_ = std::min(next_expiry_, now + lease_time(lease, frame));
    out.push_back({w.id, name});
}

void Scheduler::end_lease(Frame& frame, Task& task, std::uint32_t index) {
    Lease& lease = leases_[index];
    std::uint32_t* link = &task.leases;
    while (*link != index) link = &leases_[*link].next;
    *link = lease.next;

    Worker& w = workers_[lease.worker];
    --w.leases;
    w.quarters_held -= quarters_in(lease.task);
    w.expired -= lease.expired;
    w.work_held = w.leases == 0 ? 0 : std::max(0.0, w.work_held - lease.cost);
    frame.work_held = std::max(0.0, frame.work_held - lease.cost);
    if (w.id != 0) wait(lease.worker);
    lease.worker = none;
    free_leases_.push_back(index);

    // Forget runs of which nothing more can come.
    if (!task.done || task.leases != none) return;
    --frame.open[lease.run - frame.first_open].unsettled;
}

void Scheduler::end_leases(Frame& frame, Task& task) {
    while (task.leases != none) end_lease(frame, task, task.leases);
}

/// Forgets the worker's leases; what nobody else holds is handed out again.
void Scheduler::end_leases_of(Slot worker, const Frame* only) {
    for (std::uint32_t l = 0; l < leases_.size(); ++l) {
        if (leases_[l].worker != worker || (only && only->spec.frame != leases_[l].task.frame))
            continue;
        const TileTask name = leases_[l].task;
        const std::uint32_t run = leases_[l].run;
        Frame& frame = frames_.at(name.frame);
        end_lease(frame, *find(frame, run, name), l);
        queue_if_orphaned(frame, run, name);
    }
}

void Scheduler::expire(TimePoint now) {
    if (now < next_expiry_) return;
    next_expiry_ = TimePoint::max();
    for (Lease& lease : leases_) {
        if (lease.worker == none || lease.expired) continue;
        Frame& frame = frames_.at(lease.task.frame);
        const TimePoint deadline = lease.issued + lease_time(lease, frame);
        if (now < deadline) {
            next_expiry_ = std::min(next_expiry_, deadline);
            continue;
        }
        lease.expired = true;
        ++workers_[lease.worker].expired;
        workers_[lease.worker].overdue = true;
        crew_changed();
        queue_if_orphaned(frame, lease.run, lease.task);
    }
}

Answer Scheduler::completed(std::uint64_t worker, const TileTask& name, TimePoint now,
                            std::optional<double> render_seconds) {
    const auto slot = slots_.find(worker);
    if (slot == slots_.end()) return Answer::unknown;
    const auto found = frames_.find(name.frame);
    if (found == frames_.end()) return Answer::unknown;
    Frame& frame = found->second;
    const std::optional<std::uint32_t> run = run_of(frame.spec, name);
    Task* task = run ? find(frame, *run, name) : nullptr;
    if (!task) return Answer::unknown;
    std::uint32_t index = task->leases;
    while (index != none && leases_[index].worker != slot->second) index = leases_[index].next;
    if (index == none) return Answer::unknown;

    workers_[slot->second].overdue = false;
    const float cost = learn(slot->second, frame, leases_[index], now, render_seconds);
    const Answer answer = task->done ? Answer::duplicate : Answer::first;
    if (answer == Answer::first) finish_tile(frame, *run, name, cost);
    end_lease(frame, *task, index);
    while (!frame.open.empty() && frame.open.front().unsettled == 0) {
        frame.open.pop_front();
        ++frame.first_open;
    }
    return answer;
}

// ---- Paces --------------------------------------------------------------------------------------

/// Returns what the task has cost.
float Scheduler::learn(Slot worker, Frame& frame, const Lease& lease, TimePoint now,
                       std::optional<double> render_seconds) {
    Worker& w = workers_[worker];
    const double took = std::chrono::duration<double>(now - lease.issued).count();
    update_mean(frame.task_seconds, took);
    const double spent = std::min(render_seconds ? std::max(*render_seconds, least_task_seconds)
                                                 : took * lease.cost / lease.ahead,
                                  took);
    if (spent > 0) update_mean(w.task_seconds, spent / lease.cost);
    // What a task took that found an idle thread and was not rendering is a round trip; the first
    // task of a frame may have waited for preparations.
    const bool found_idle_thread = lease.ahead <= lease.cost * 1.001f;
    if (render_seconds && found_idle_thread && answered(frame, worker))
        update_mean(w.round_trip, took - spent);
    if (!answered(frame, worker)) {
        frame.answered.resize(std::max<std::size_t>(frame.answered.size(), worker + 1));
        frame.answered[worker] = true;
        next_expiry_ = now;  // now we know better how long its leases may last
    }
    set_limit(worker);
    return spent > 0 ? float(spent / w.task_seconds) : lease.cost;
}

/// Handing out to answer when its thread has to do `ahead` up to then; 0: not known.
double Scheduler::seconds_for(const Worker& worker, double ahead) {
    return worker.task_seconds > 0 ? worker.round_trip + worker.task_seconds * ahead : 0;
}

double Scheduler::expected_seconds(const Lease& lease, const Frame& frame) const {
    const double own = seconds_for(workers_[lease.worker], lease.ahead);
    return own > 0 && answered(frame, lease.worker) ? own : std::max(own, frame.task_seconds);
}

Duration Scheduler::lease_time(const Lease& lease, const Frame& frame) const {
    return std::max(answered(frame, lease.worker) ? config_.shortest_lease : config_.first_lease,
                    seconds(config_.patience * expected_seconds(lease, frame)));
}

void Scheduler::crew_changed() {
    for (auto& [id, frame] : frames_) frame.crew.valid_until = {};
}

void Scheduler::measure_crew(Frame& frame, TimePoint now) const {
    if (now < frame.crew.valid_until) return;
    Crew crew;
    double round_trips = 0, work_held = 0;
    for (const Worker& w : workers_) {
        if (w.task_seconds == 0 || w.overdue || !ready(w, frame)) continue;
        const double speed = w.threads / w.task_seconds;
        crew.speed += speed;
        crew.threads += w.threads;
        round_trips += speed * w.round_trip;
        work_held += w.work_held;
    }
    if (crew.speed > 0) {
        crew.task_seconds = crew.threads / crew.speed;
        crew.round_trip = round_trips / crew.speed;
        crew.busy_seconds = std::max(0.0, work_held - frame.work_held) / crew.speed;
    }
    crew.valid_until =
        now + std::max<Duration>(least_crew_refresh,
                                 seconds(crew_refresh * (crew.round_trip + crew.task_seconds)));
    frame.crew = crew;
}

/// Whether the worker would finish a task before the others could finish the frame without it,
/// give or take a task. Holds for at least one of those that count in the crew once it is idle.
bool Scheduler::in_time(const Worker& worker, const Frame& frame, const TileTask& name) {
    const Crew& crew = frame.crew;
    if (crew.speed == 0) return true;
    if (worker.overdue) return false;
    const double mean = name.part == 0 ? 1 : 1.0 / quarters;
    const double ahead =
        worker.work_held / worker.threads + std::min(double(cost_of(frame, name)), mean);
    const double others = frame.work_left / crew.speed + crew.busy_seconds + crew.round_trip +
                          mean * crew.task_seconds;
    return seconds_for(worker, ahead) <= others * 1.000001;
}

// ---- Handing out --------------------------------------------------------------------------------

std::vector<Assignment> Scheduler::assign(TimePoint now) {
    expire(now);
    next_late_ = TimePoint::max();
    std::vector<Assignment> out;
    const auto work_is_left = [&] {
        return std::any_of(frames_.begin(), frames_.end(),
                           [](const auto& entry) { return has_work(entry.second); });
    };
    // One task for each worker in turn, so that a few tasks spread over many workers.
    bool handed_out = true;
    while (handed_out && work_is_left()) {
        handed_out = false;
        std::size_t kept = 0;
        for (std::size_t i = 0; i < waiting_.size(); ++i) {
            const Slot slot = waiting_[i];
            Worker& w = workers_[slot];
            w.waiting = w.id != 0 && !w.retired && w.quarters_held < quarters * w.limit;
            if (!w.waiting) continue;
            waiting_[kept++] = slot;
            if (hand_out_in_turn(slot, now, out)) handed_out = true;
        }
        waiting_.resize(kept);
    }
    for (auto& [id, frame] : frames_) double_late(frame, now, out);
    return out;
}

std::optional<TimePoint> Scheduler::next_deadline() const {
    const TimePoint next = std::min(next_expiry_, next_late_);
    return next == TimePoint::max() ? std::nullopt : std::optional(next);
}

bool Scheduler::has_work(const Frame& frame) {
    return !frame.again.empty() || frame.next_run < frame.run_limit;
}

/// Offers the worker's turn to each frame it can render, beginning after the one served last.
bool Scheduler::hand_out_in_turn(Slot worker, TimePoint now, std::vector<Assignment>& out) {
    auto entry = frames_.upper_bound(last_frame_);
    for (std::size_t i = 0; i < frames_.size(); ++i, ++entry) {
        if (entry == frames_.end()) entry = frames_.begin();
        Frame& frame = entry->second;
        if (!has_work(frame) || !ready(workers_[worker], frame)) continue;
        measure_crew(frame, now);
        std::optional<TileTask> task = lost_task_for(worker, frame);
        if (!task) task = new_task_for(worker, frame);
        if (!task) {
            // It may look different when the crew is measured again.
            next_late_ = std::min(next_late_, frame.crew.valid_until);
            continue;
        }
        last_frame_ = entry->first;
        lease(worker, frame, *task, now, out);
        return true;
    }
    return false;
}

std::optional<TileTask> Scheduler::lost_task_for(Slot worker, Frame& frame) {
    for (auto name = frame.again.begin(); name != frame.again.end();) {
        Task* task = find(frame, *run_of(frame.spec, *name), *name);
        if (!task || task->done) {
            name = frame.again.erase(name);
        } else if (holds(*task, worker) || !in_time(workers_[worker], frame, *name)) {
            ++name;
        } else {
            const TileTask found = *name;
            task->queued = false;
            frame.again.erase(name);
            return found;
        }
    }
    return std::nullopt;
}

std::optional<TileTask> Scheduler::new_task_for(Slot worker, Frame& frame) {
    if (frame.next_run >= frame.run_limit) return std::nullopt;
    const std::uint32_t tile = frame.order[frame.next_index];
    if (frame.next_part == 0 && pays_to_cut(frame, tile)) {
        cut(open_run(frame, frame.next_run), tile);
        frame.next_part = 1;
    }
    const TileTask task = task_of(frame.spec, frame.next_run, tile, frame.next_part);
    if (!in_time(workers_[worker], frame, task)) return std::nullopt;
    if (task.part > 0 && task.part < quarters) {
        ++frame.next_part;
        return task;
    }
    frame.next_part = 0;
    if (++frame.next_index == frame.order.size()) {
        frame.next_index = 0;
        ++frame.next_run;
    }
    return task;
}

/// Gives idle hands what is late, and then what would take longest where it is.
void Scheduler::double_late(Frame& frame, TimePoint now, std::vector<Assignment>& out) {
    if (frame.task_seconds == 0 || waiting_.empty()) return;
    const auto idle = [&](Slot slot) {
        const Worker& w = workers_[slot];
        return w.leases < w.threads && ready(w, frame) && (!w.overdue || frame.crew.speed == 0);
    };
    if (std::none_of(waiting_.begin(), waiting_.end(), idle)) return;
    if (now < frame.next_search) {
        next_late_ = std::min(next_late_, frame.next_search);
        return;
    }
    frame.next_search = now + seconds(crew_refresh * frame.task_seconds);
    measure_crew(frame, now);

    // Find what is late, and what is not yet with the time at which it should be done.
    struct Candidate {
        TimePoint at;
        TileTask name;
    };
    std::vector<Candidate> late, slow;
    for (const Lease& l : leases_) {
        if (l.worker == none || l.task.frame != frame.spec.frame) continue;
        const Task& task = *find(frame, l.run, l.task);
        std::size_t copies = 0;
        for (std::uint32_t i = task.leases; i != none; i = leases_[i].next) ++copies;
        if (task.done || copies >= config_.most_copies || &leases_[task.leases] != &l ||
            task.quarters != none)
            continue;
        const double expected = expected_seconds(l, frame);
        const TimePoint late_at = l.issued + seconds(config_.late * expected);
        if (late_at > now) next_late_ = std::min(next_late_, late_at);
        if (late_at <= now)
            late.push_back({l.issued, l.task});
        else
            slow.push_back({l.issued + seconds(expected), l.task});
    }
    std::sort(late.begin(), late.end(), [](auto& a, auto& b) { return a.at > b.at; });
    std::sort(slow.begin(), slow.end(), [](auto& a, auto& b) { return a.at < b.at; });

    // Give each idle worker the oldest of the late ones, or the one that is to take longest; or a
    // quarter of it, and others to those that come next.
    const auto give_quarter = [&](Slot slot) {
        const auto name = lost_task_for(slot, frame);
        if (name) lease(slot, frame, *name, now, out);
        return name.has_value();
    };
    const auto give = [&](Slot slot, std::vector<Candidate>& from) {
        for (std::size_t i = from.size(); i-- > 0;) {
            const TileTask name = from[i].name;
            const std::uint32_t run = *run_of(frame.spec, name);
            if (holds(*find(frame, run, name), slot)) continue;
            from.erase(from.begin() + std::ptrdiff_t(i));
            if (can_cut_late(frame, run, name)) {
                cut_late(frame, run, name);
                return give_quarter(slot);
            }
            lease(slot, frame, name, now, out);
            return true;
        }
        return false;
    };
    for (const Slot slot : waiting_) {
        while (idle(slot) && (give_quarter(slot) || give(slot, late))) {
        }
        while (idle(slot) && !slow.empty()) {
            const Worker& w = workers_[slot];
            const TileTask& name = slow.back().name;
            const bool cuts = can_cut_late(frame, *run_of(frame.spec, name), name);
            const double own = seconds_for(w, cost_of(frame, name) / (cuts ? quarters : 1));
            const double left = std::chrono::duration<double>(slow.back().at - now).count();
            if (own == 0 || own > config_.faster * left || !give(slot, slow)) break;
        }
    }
}

}  // namespace tessera
