// A cluster in virtual time: the real Scheduler and FrameAssembler, driven by as many made-up
// workers as one likes, whose tiles take made-up times and to which everything happens that happens
// to workers. The same seed gives the same run, and a run of thousands of workers takes seconds, so
// that laws can be checked over thousands of fault schedules, and clusters be planned that nobody
// has.
//
// A worker has threads, a queue of tasks and a connection that takes half a round trip each way; a
// server takes its time for each result, one after the other. What is left out: bandwidth, and the
// time to build scenes.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "common/image.h"
#include "server/scheduler.h"

namespace tessera {

/// What happens to a worker.
enum class Mishap : std::uint8_t {
    death,    ///< its connection closes, its tasks are lost
    hang,     ///< does nothing for a time; its connection stays open (SIGSTOP)
    cut,      ///< works on, but nothing passes to or from it for a time
    slowdown  ///< its tiles take `factor` times as long for a time
};

struct Fault {
    Mishap mishap = Mishap::death;
    std::uint32_t worker = 0;  ///< index
    double at = 0;             ///< seconds
    double seconds = 0;        ///< how long; after a death, until it joins again; 0: for ever
    double factor = 10;
};

struct SimConfig {
    std::uint32_t workers = 8;
    std::uint32_t threads = 1;
    std::vector<double> slowness;  ///< by worker: times as long for each tile; 1 where it is short

    ImageSize size{320, 240};
    std::uint32_t passes = 16;  ///< of 16 to a run
    std::uint32_t frames = 1;
    std::uint32_t in_flight = 1;  ///< frames asked for at a time
    double tile_seconds = 0.01;   ///< mean
    double spread = 0.5;  ///< standard deviation of the logarithm of a tile's time over the picture
    double noise = 0.1;   ///< the same, from frame to frame
    double quarter_overhead = 0.1;  ///< share of its time by which a quarter takes longer

    double round_trip = 0.001;     ///< seconds, between server and worker or viewer
    double jitter = 0;             ///< share of it by which a message may come later
    double server_seconds = 2e-6;  ///< the server's time for a result, next task included

    double lies = 0;  ///< chance that a result comes twice, belongs to no task, or to an old frame
    std::vector<Fault> faults;
    unsigned seed = 0;
    SchedulerConfig scheduler;
};

struct SimReport {
    std::vector<double> frame_seconds;  ///< from asking to the last pixel, in order of completion
    double seconds = 0;                 ///< of all frames
    /// What the same tiles take on the same workers when no thread ever waits, faults aside.
    double ideal_seconds = 0;
    std::uint64_t tiles = 0;     ///< of all frames and runs
    double rendered = 0;         ///< including those for nothing
    std::uint64_t quarters = 0;  ///< of those
    std::uint32_t most_leases = 0;
    double server_load = 0;           ///< share of the time in which the server works
    std::vector<std::string> broken;  ///< laws that did not hold; empty unless there is a bug

    double efficiency() const { return ideal_seconds / seconds; }
};

SimReport simulate(const SimConfig& config);

/// A small cluster with a random schedule of faults, which spare one worker.
SimConfig random_cluster(unsigned seed);

}  // namespace tessera
