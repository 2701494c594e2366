#include "server/scheduler.h"

#include <algorithm>
#include <cmath>

#include "common/check.h"
#include "server/runs.h"

namespace tessera {
namespace {

/// Weight of the newest task in the running mean of task times: the last five or so count.
constexpr double newest_weight = 0.2;

Duration seconds(double s) {
    return std::chrono::duration_cast<Duration>(std::chrono::duration<double>(s));
}

}  // namespace

void Scheduler::add_worker(std::uint64_t worker, std::uint32_t threads) {
    const bool added =
        workers_.try_emplace(worker, Worker{threads, threads + config_.prefetch, 0, {}}).second;
    CHECK(added);
}

void Scheduler::remove_worker(std::uint64_t worker) {
    workers_.erase(worker);
    for (auto& [id, frame] : frames_) take_back(frame, worker);
}

void Scheduler::exclude(std::uint64_t worker, std::uint64_t frame) {
    Frame& f = frames_.at(frame);
    f.excluded.insert(worker);
    for (const auto& [task, outstanding] : f.outstanding)
        if (holds(outstanding, worker)) --workers_.at(worker).leases;
    take_back(f, worker);
}

/// Forgets the worker's leases; what nobody else holds is handed out again.
void Scheduler::take_back(Frame& frame, std::uint64_t worker) {
    for (auto entry = frame.outstanding.begin(); entry != frame.outstanding.end();) {
        auto& [task, outstanding] = *entry;
        std::erase_if(outstanding.leases, [&](const Lease& l) { return l.worker == worker; });
        queue_if_orphaned(frame, task, outstanding);
        const bool over = outstanding.done && outstanding.leases.empty();
        entry = over ? frame.outstanding.erase(entry) : std::next(entry);
    }
}

void Scheduler::scene_ready(std::uint64_t worker, const std::string& scene, std::uint64_t version) {
    workers_.at(worker).scenes[scene] = version;
}

void Scheduler::scene_gone(std::uint64_t worker, const std::string& scene) {
    workers_.at(worker).scenes.erase(scene);
}

void Scheduler::add_frame(const FrameSpec& spec, std::uint32_t run_limit) {
    Frame frame;
    frame.spec = spec;
    frame.runs = run_count(spec.settings);
    frame.run_limit = std::min(run_limit, frame.runs);
    CHECK(frames_.emplace(spec.frame, std::move(frame)).second);
}

void Scheduler::allow_runs(std::uint64_t frame, std::uint32_t run_limit) {
    Frame& f = frames_.at(frame);
    f.run_limit = std::min(std::max(f.run_limit, run_limit), f.runs);
}

void Scheduler::limit_runs(std::uint64_t frame, std::uint32_t runs) {
    Frame& f = frames_.at(frame);
    f.runs = std::min(f.runs, runs);
    f.run_limit = std::min(f.run_limit, runs);
    std::erase_if(f.outstanding, [&](const auto& entry) {
        const bool unwanted = *run_of(f.spec, entry.first) >= runs;
        if (unwanted) release_all(entry.second);
        return unwanted;
    });
}

void Scheduler::remove_frame(std::uint64_t frame) {
    const auto found = frames_.find(frame);
    if (found == frames_.end()) return;
    for (const auto& [task, outstanding] : found->second.outstanding) release_all(outstanding);
    frames_.erase(found);
}

Answer Scheduler::completed(std::uint64_t worker, const TileTask& task, TimePoint now) {
    const auto found = frames_.find(task.frame);
    if (found == frames_.end()) return Answer::unknown;
    Frame& frame = found->second;
    const auto entry = frame.outstanding.find(task);
    if (entry == frame.outstanding.end()) return Answer::unknown;
    std::vector<Lease>& leases = entry->second.leases;
    const auto lease = std::find_if(leases.begin(), leases.end(),
                                    [&](const Lease& l) { return l.worker == worker; });
    if (lease == leases.end()) return Answer::unknown;

    const double took = std::chrono::duration<double>(now - lease->issued).count();
    frame.task_seconds +=
        (frame.task_seconds == 0 ? 1 : newest_weight) * (took - frame.task_seconds);
    leases.erase(lease);
    --workers_.at(worker).leases;
    const Answer answer = entry->second.done ? Answer::duplicate : Answer::first;
    entry->second.done = true;
    if (leases.empty()) frame.outstanding.erase(entry);
    return answer;
}

std::vector<Assignment> Scheduler::assign(TimePoint now) {
    expire(now);
    next_late_ = TimePoint::max();
    // One task for each worker in turn, so that a few tasks spread over many workers.
    std::vector<Assignment> out;
    std::size_t before;
    do {
        before = out.size();
        for (const auto& [id, worker] : workers_)
            if (const auto assignment = next_for(id, now)) out.push_back(*assignment);
    } while (out.size() > before);
    return out;
}

std::optional<TimePoint> Scheduler::next_deadline() const {
    const TimePoint next = std::min(next_expiry_, next_late_);
    return next == TimePoint::max() ? std::nullopt : std::optional(next);
}

bool Scheduler::ready(std::uint64_t worker, const Frame& frame) const {
    const auto& scenes = workers_.at(worker).scenes;
    const auto scene = scenes.find(frame.spec.scene);
    return scene != scenes.end() && scene->second == frame.spec.version &&
           !frame.excluded.contains(worker);
}

bool Scheduler::holds(const Outstanding& outstanding, std::uint64_t worker) {
    return std::any_of(outstanding.leases.begin(), outstanding.leases.end(),
                       [&](const Lease& l) { return l.worker == worker; });
}

/// Queues a task that nobody can be trusted to answer.
void Scheduler::queue_if_orphaned(Frame& frame, const TileTask& task, Outstanding& outstanding) {
    const bool trusted = std::any_of(outstanding.leases.begin(), outstanding.leases.end(),
                                     [](const Lease& l) { return !l.expired; });
    if (trusted || outstanding.done || outstanding.queued) return;
    outstanding.queued = true;
    frame.again.push_back(task);
}

std::optional<TileTask> Scheduler::lost_task_for(std::uint64_t worker, Frame& frame) {
    std::erase_if(frame.again, [&](const TileTask& task) {
        const auto entry = frame.outstanding.find(task);
        return entry == frame.outstanding.end() || entry->second.done;
    });
    const auto task = std::find_if(frame.again.begin(), frame.again.end(), [&](const TileTask& t) {
        return !holds(frame.outstanding.at(t), worker);
    });
    if (task == frame.again.end()) return std::nullopt;
    const TileTask found = *task;
    frame.again.erase(task);
    frame.outstanding.at(found).queued = false;
    return found;
}

std::optional<TileTask> Scheduler::new_task(Frame& frame) {
    if (frame.next_run >= frame.run_limit) return std::nullopt;
    const TileTask task = task_of(frame.spec, frame.next_run, frame.next_tile);
    if (++frame.next_tile == tile_count(frame.spec.size)) {
        frame.next_tile = 0;
        ++frame.next_run;
    }
    return task;
}

/// The task that has been out for longest, if that is long enough for another worker to try it.
std::optional<TileTask> Scheduler::late_task_for(std::uint64_t worker, const Frame& frame,
                                                 TimePoint now) {
    if (frame.task_seconds == 0) return std::nullopt;
    std::optional<TileTask> oldest;
    TimePoint issued = TimePoint::max();
    for (const auto& [task, outstanding] : frame.outstanding) {
        if (outstanding.done || outstanding.leases.empty() ||
            outstanding.leases.size() >= config_.most_copies || holds(outstanding, worker))
            continue;
        if (outstanding.leases.front().issued >= issued) continue;
        issued = outstanding.leases.front().issued;
        oldest = task;
    }
    if (!oldest) return std::nullopt;
    const TimePoint late = issued + seconds(config_.late * frame.task_seconds);
    if (late <= now) return oldest;
    next_late_ = std::min(next_late_, late);
    return std::nullopt;
}

/// Offers the worker's turn to each frame it can render, beginning after the one served last.
template <class Choose>
std::optional<Assignment> Scheduler::in_turn(std::uint64_t worker, TimePoint now,
                                             const Choose& choose) {
    auto frame = frames_.upper_bound(last_frame_);
    for (std::size_t i = 0; i < frames_.size(); ++i, ++frame) {
        if (frame == frames_.end()) frame = frames_.begin();
        if (!ready(worker, frame->second)) continue;
        const std::optional<TileTask> task = choose(frame->second);
        if (!task) continue;
        last_frame_ = frame->first;
        lease(worker, frame->second, *task, now);
        return Assignment{worker, *task};
    }
    return std::nullopt;
}

std::optional<Assignment> Scheduler::next_for(std::uint64_t worker, TimePoint now) {
    const Worker& w = workers_.at(worker);
    if (w.leases >= w.limit) return std::nullopt;
    const auto undone = in_turn(worker, now, [&](Frame& frame) {
        const auto lost = lost_task_for(worker, frame);
        return lost ? lost : new_task(frame);
    });
    if (undone || w.leases >= w.threads) return undone;
    return in_turn(worker, now, [&](Frame& frame) { return late_task_for(worker, frame, now); });
}

void Scheduler::lease(std::uint64_t worker, Frame& frame, const TileTask& task, TimePoint now) {
    const auto [entry, fresh] = frame.outstanding.try_emplace(task);
    if (!fresh) ++frame.reissued;
    const Duration time =
        std::max(config_.shortest_lease, seconds(config_.patience * frame.task_seconds));
    entry->second.leases.push_back({worker, now, now + time});
    next_expiry_ = std::min(next_expiry_, now + time);
    ++workers_.at(worker).leases;
}

void Scheduler::release_all(const Outstanding& outstanding) {
    for (const Lease& lease : outstanding.leases) --workers_.at(lease.worker).leases;
}

void Scheduler::expire(TimePoint now) {
    if (now < next_expiry_) return;
    next_expiry_ = TimePoint::max();
    for (auto& [id, frame] : frames_)
        for (auto& [task, outstanding] : frame.outstanding) {
            for (Lease& lease : outstanding.leases) {
                lease.expired = lease.expired || lease.deadline <= now;
                if (!lease.expired) next_expiry_ = std::min(next_expiry_, lease.deadline);
            }
            queue_if_orphaned(frame, task, outstanding);
        }
}

}  // namespace tessera
