// The law of the scheduler: under any loss, joining, stalling, duplication and reordering, each
// task of each frame is delivered exactly once, and every frame completes as long as one worker
// lives. Seeded random clusters in simulated time.

#include "server/scheduler.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <random>
#include <set>

#include "server/runs.h"

namespace tessera {
namespace {

using std::chrono::milliseconds;
using std::chrono::seconds;

FrameSpec frame_of(std::uint64_t id, ImageSize size, std::uint32_t passes) {
    FrameSpec spec;
    spec.frame = id;
    spec.scene = "scene";
    spec.version = 1;
    spec.size = size;
    spec.settings.passes = passes;
    return spec;
}

/// A cluster in which everything goes wrong, driven by one random number generator.
class Cluster {
public:
    explicit Cluster(unsigned seed) : random_(seed) {}

    void run() {
        add_worker();
        for (std::uint64_t id = 1; id <= 1 + below(3); ++id) add_frame(id);
        for (int step = 0; step < 100000 && !frames_.empty(); ++step) {
            disturb();
            hand_out();
            advance();
        }
        EXPECT_TRUE(frames_.empty()) << "a frame does not complete";
    }

private:
    struct Work {
        TimePoint answers_at;
        std::uint64_t worker;
        TileTask task;
    };
    struct Frame {
        FrameSpec spec;
        std::uint32_t runs;
        std::uint32_t window;
        std::map<std::pair<std::uint32_t, std::uint32_t>, unsigned> delivered;  ///< by run and tile
    };
    struct Worker {
        std::uint32_t limit;
        std::set<TileTask> holds;
        bool slow;
    };

    static std::uint32_t quarters_of(const std::set<TileTask>& tasks) {
        std::uint32_t sum = 0;
        for (const TileTask& task : tasks) sum += task.part == 0 ? quarters : 1;
        return sum;
    }
    std::uint32_t below(std::uint32_t n) { return std::uint32_t(random_() % n); }
    bool chance(double p) { return std::uniform_real_distribution<>()(random_) < p; }

    void add_worker() {
        const std::uint32_t threads = 1 + below(4);
        const std::uint64_t id = ++last_worker_;
        scheduler_.add_worker(id, threads);
        if (chance(0.9))
            scheduler_.scene_ready(id, "scene", 1);
        else
            scheduler_.scene_ready(id, "scene", 2), useless_.insert(id);
        workers_[id] = {threads + SchedulerConfig{}.prefetch, {}, chance(0.3)};
        if (workers_.size() == useless_.size()) add_worker();
    }

    void remove_worker(std::uint64_t id) {
        scheduler_.remove_worker(id);
        workers_.erase(id);
        useless_.erase(id);
        std::erase_if(work_, [&](const Work& w) { return w.worker == id; });
        if (workers_.size() == useless_.size()) add_worker();
    }

    void add_frame(std::uint64_t id) {
        FrameSpec spec = frame_of(id, {1 + int(below(60)), 1 + int(below(60))}, 1 + below(40));
        if (chance(0.3)) spec.settings.integrator = Integrator::path;
        const std::uint32_t window = 1 + below(3);
        scheduler_.add_frame(spec, window);
        frames_[id] = {spec, run_count(spec.settings), window, {}};
    }

    void disturb() {
        if (chance(0.02)) add_worker();
        if (chance(0.02)) {
            auto victim = workers_.begin();
            std::advance(victim, below(std::uint32_t(workers_.size())));
            if (victim->first != immortal_) remove_worker(victim->first);
        }
        if (chance(0.005)) limit(*std::next(frames_.begin(), below(std::uint32_t(frames_.size()))));
        if (frames_.size() > 1 && chance(0.001)) end_frame(frames_.begin()->first);
        if (chance(0.002)) exclude(frames_.begin()->first);
    }

    /// A worker finds that it cannot render the frame; another one can.
    void exclude(std::uint64_t frame) {
        const std::uint64_t worker = workers_.begin()->first;
        scheduler_.exclude(worker, frame);
        excluded_.insert({worker, frame});
        std::erase_if(workers_.begin()->second.holds,
                      [&](const TileTask& t) { return t.frame == frame; });
        add_worker();
        scheduler_.scene_ready(last_worker_, "scene", 1);
        useless_.erase(last_worker_);
        immortal_ = last_worker_;
    }

    void limit(std::pair<const std::uint64_t, Frame>& entry) {
        auto& [id, frame] = entry;
        frame.runs = std::min(frame.runs, complete_runs(frame) + 1 + below(3));
        scheduler_.limit_runs(id, frame.runs);
        for (auto& [worker, w] : workers_)
            std::erase_if(w.holds, [&, f = &frame](const TileTask& t) {
                return t.frame == f->spec.frame && *run_of(f->spec, t) >= f->runs;
            });
    }

    void end_frame(std::uint64_t id) {
        scheduler_.remove_frame(id);
        frames_.erase(id);
        for (auto& [worker, w] : workers_)
            std::erase_if(w.holds, [&](const TileTask& t) { return t.frame == id; });
    }

    void hand_out() {
        for (const auto& [id, task] : scheduler_.assign(now_)) {
            ASSERT_FALSE(useless_.contains(id)) << "worker has another version of the scene";
            ASSERT_FALSE(excluded_.contains({id, task.frame})) << "worker cannot render this frame";
            Worker& worker = workers_.at(id);
            Frame& frame = frames_.at(task.frame);
            const std::optional<std::uint32_t> run = run_of(frame.spec, task);
            ASSERT_TRUE(run);
            ASSERT_LT(*run, std::min(frame.runs, complete_runs(frame) + frame.window));
            ASSERT_TRUE(worker.holds.insert(task).second) << "the worker has this task already";
            ASSERT_LT(quarters_of(worker.holds), quarters * (worker.limit + 1));
            ASSERT_EQ(worker.holds.size() > 0, scheduler_.leases(id) > 0);
            // Answers come in any order; a stalling worker takes longer than any lease.
            const auto time = chance(0.01)  ? milliseconds(20000)
                              : worker.slow ? milliseconds(1 + below(4000))
                                            : milliseconds(1 + below(100));
            work_.push_back({now_ + time, id, task});
        }
    }

    void advance() {
        const auto next = std::min_element(work_.begin(), work_.end(), [](auto& a, auto& b) {
            return a.answers_at < b.answers_at;
        });
        const auto deadline = scheduler_.next_deadline();
        if (deadline && (next == work_.end() || *deadline < next->answers_at)) {
            now_ = std::max(now_, *deadline);
        } else if (next != work_.end()) {
            const Work work = *next;
            work_.erase(next);
            now_ = std::max(now_, work.answers_at);
            deliver(work);
            if (chance(0.05)) deliver(work);
        }
    }

    void deliver(const Work& work) {
        const Answer answer = scheduler_.completed(work.worker, work.task, now_);
        const bool held = workers_.at(work.worker).holds.erase(work.task) > 0;
        ASSERT_EQ(answer == Answer::unknown, !held);
        if (!held) return;
        Frame& frame = frames_.at(work.task.frame);
        // With a tile all its quarters are delivered, whoever else is at them.
        const unsigned all = (1u << quarters) - 1, part = work.task.part;
        const unsigned these = part == 0 ? all : 1u << (part - 1);
        unsigned& there = frame.delivered[{*run_of(frame.spec, work.task), work.task.tile}];
        ASSERT_EQ(answer == Answer::first, (there & these) != these) << "delivered twice, or never";
        there |= these;
        scheduler_.allow_runs(work.task.frame, complete_runs(frame) + frame.window);
        if (complete_runs(frame) >= frame.runs) end_frame(work.task.frame);
    }

    /// Runs complete without a gap.
    std::uint32_t complete_runs(const Frame& frame) const {
        std::uint32_t run = 0;
        std::vector<std::uint32_t> tiles(run_count(frame.spec.settings));
        for (const auto& [place, there] : frame.delivered)
            tiles[place.first] += there == (1u << quarters) - 1;
        while (run < tiles.size() && tiles[run] == tile_count(frame.spec.size)) ++run;
        return run;
    }

    std::mt19937 random_;
    Scheduler scheduler_;
    TimePoint now_{};
    std::uint64_t last_worker_ = 0;
    std::map<std::uint64_t, Worker> workers_;
    std::set<std::uint64_t> useless_;
    std::uint64_t immortal_ = 0;  ///< lives on so that excluded frames complete
    std::set<std::pair<std::uint64_t, std::uint64_t>> excluded_;
    std::map<std::uint64_t, Frame> frames_;
    std::vector<Work> work_;
};

TEST(Scheduler, every_task_is_delivered_once_whatever_happens) {
    for (unsigned seed = 0; seed < 3000 && !testing::Test::HasFailure(); ++seed) {
        SCOPED_TRACE(seed);
        Cluster(seed).run();
    }
}

/// One worker with `threads` threads that is ready for the scene.
void add_ready(Scheduler& scheduler, std::uint64_t worker, std::uint32_t threads) {
    scheduler.add_worker(worker, threads);
    scheduler.scene_ready(worker, "scene", 1);
}

TEST(Scheduler, a_worker_gets_a_task_per_thread_and_some_ahead) {
    Scheduler scheduler;
    scheduler.add_frame(frame_of(1, {160, 160}, 1), 1);
    add_ready(scheduler, 1, 3);
    EXPECT_EQ(scheduler.assign(TimePoint{}).size(), 7u);
    EXPECT_TRUE(scheduler.assign(TimePoint{}).empty());
    EXPECT_EQ(scheduler.completed(1, task_of(frame_of(1, {160, 160}, 1), 0, 2), TimePoint{}),
              Answer::first);
    EXPECT_EQ(scheduler.assign(TimePoint{}).size(), 1u);
}

TEST(Scheduler, tiles_are_cut_once_little_is_left_for_each_thread) {
    const FrameSpec spec = frame_of(1, {320, 160}, 1);
    for (const double fineness : {0.0, 2.0}) {
        Scheduler scheduler({.prefetch = 0, .fineness = fineness});
        scheduler.add_frame(spec, 1);
        add_ready(scheduler, 1, 10);
        TimePoint now{};
        std::set<TileTask> held, answered;
        for (;;) {
            for (const Assignment& a : scheduler.assign(now)) held.insert(a.task);
            if (held.empty()) break;
            const TileTask task = *held.begin();
            held.erase(held.begin());
            answered.insert(task);
            EXPECT_EQ(scheduler.completed(1, task, now += milliseconds(1), 1e-2), Answer::first);
        }
        std::map<std::uint32_t, std::uint32_t> pieces;
        for (const TileTask& task : answered) pieces[task.tile] += task.part == 0 ? quarters : 1;
        EXPECT_EQ(pieces.size(), 200u);
        for (const auto& [tile, quarters_there] : pieces) EXPECT_EQ(quarters_there, quarters);
        const auto cut = std::ranges::count_if(answered, [](auto& task) { return task.part > 0; });
        EXPECT_EQ(cut > 0, fineness > 0) << cut;
        EXPECT_LT(cut, 200);
    }
}

TEST(Scheduler, frames_take_turns) {
    Scheduler scheduler({.prefetch = 20});
    for (std::uint64_t id : {1, 2, 3}) scheduler.add_frame(frame_of(id, {160, 160}, 1), 1);
    add_ready(scheduler, 1, 1);
    std::map<std::uint64_t, int> tasks;
    for (const Assignment& a : scheduler.assign(TimePoint{})) ++tasks[a.task.frame];
    EXPECT_EQ(tasks, (std::map<std::uint64_t, int>{{1, 7}, {2, 7}, {3, 7}}));
}

TEST(Scheduler, tasks_of_a_lost_worker_go_out_before_new_ones) {
    Scheduler scheduler({.prefetch = 0});
    scheduler.add_frame(frame_of(1, {160, 160}, 1), 1);
    add_ready(scheduler, 1, 4);
    const auto lost = scheduler.assign(TimePoint{});
    scheduler.remove_worker(1);
    add_ready(scheduler, 2, 4);
    const auto again = scheduler.assign(TimePoint{});
    ASSERT_EQ(again.size(), lost.size());
    for (std::size_t i = 0; i < lost.size(); ++i) EXPECT_EQ(again[i].task, lost[i].task);
    EXPECT_EQ(scheduler.reissued(1), 4u);
}

TEST(Scheduler, an_expired_lease_goes_to_another_worker_and_the_first_answer_wins) {
    Scheduler scheduler({.prefetch = 0});
    scheduler.add_frame(frame_of(1, {16, 16}, 1), 1);
    add_ready(scheduler, 1, 1);
    add_ready(scheduler, 2, 1);
    const TimePoint start{};
    const auto first = scheduler.assign(start);
    ASSERT_EQ(first.size(), 1u);
    ASSERT_EQ(scheduler.next_deadline(), start + seconds(2));
    EXPECT_TRUE(scheduler.assign(start + milliseconds(1999)).empty());
    const auto second = scheduler.assign(start + seconds(2));
    ASSERT_EQ(second.size(), 1u);
    EXPECT_NE(second[0].worker, first[0].worker);
    EXPECT_EQ(scheduler.completed(first[0].worker, first[0].task, start + seconds(3)),
              Answer::first);
    EXPECT_EQ(scheduler.completed(second[0].worker, second[0].task, start + seconds(3)),
              Answer::duplicate);
    EXPECT_EQ(scheduler.completed(second[0].worker, second[0].task, start + seconds(3)),
              Answer::unknown);
}

TEST(Scheduler, idle_hands_double_what_is_late_at_the_end_of_a_frame) {
    Scheduler scheduler({.prefetch = 0});
    const FrameSpec spec = frame_of(1, {48, 16}, 1);
    scheduler.add_frame(spec, 1);
    for (std::uint64_t worker : {1, 2, 3}) add_ready(scheduler, worker, 1);
    const TimePoint start{};
    const auto out = scheduler.assign(start);
    ASSERT_EQ(out.size(), 3u);
    for (int i : {0, 1}) scheduler.completed(out[i].worker, out[i].task, start + milliseconds(10));
    EXPECT_TRUE(scheduler.assign(start + milliseconds(11)).empty());
    ASSERT_EQ(scheduler.next_deadline(), start + milliseconds(20));
    const auto doubled = scheduler.assign(start + milliseconds(20));
    ASSERT_EQ(doubled.size(), 2u) << "a quarter each";
    for (const Assignment& a : doubled) EXPECT_EQ(a.task.tile, out[2].task.tile);
    EXPECT_NE(doubled[0].task.part, 0u);
    EXPECT_NE(doubled[0].task.part, doubled[1].task.part);
    const auto now = start + milliseconds(21);
    EXPECT_EQ(scheduler.completed(doubled[0].worker, doubled[0].task, now), Answer::first);
    EXPECT_EQ(scheduler.completed(out[2].worker, out[2].task, now), Answer::first);
    EXPECT_EQ(scheduler.completed(doubled[1].worker, doubled[1].task, now), Answer::duplicate);
    EXPECT_TRUE(scheduler.assign(now).empty());
}

TEST(Scheduler, quarters_go_on_when_who_holds_their_tile_is_lost) {
    Scheduler scheduler({.prefetch = 0});
    scheduler.add_frame(frame_of(1, {32, 16}, 1), 1);
    for (std::uint64_t worker : {1, 2}) add_ready(scheduler, worker, 1);
    const TimePoint start{};
    const auto out = scheduler.assign(start);
    ASSERT_EQ(out.size(), 2u);
    scheduler.completed(out[0].worker, out[0].task, start + milliseconds(10));
    TimePoint now = start + milliseconds(20);
    std::vector<Assignment> work = scheduler.assign(now);
    scheduler.remove_worker(out[1].worker);
    std::set<std::uint32_t> parts;
    while (!work.empty()) {
        now += milliseconds(1);
        for (const auto& [worker, task] : work) {
            EXPECT_EQ(task.tile, out[1].task.tile);
            EXPECT_TRUE(parts.insert(task.part).second);
            EXPECT_EQ(scheduler.completed(worker, task, now), Answer::first);
        }
        work = scheduler.assign(now);
    }
    EXPECT_EQ(parts, (std::set<std::uint32_t>{1, 2, 3, 4}));
}

}  // namespace
}  // namespace tessera
