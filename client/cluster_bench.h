// What a cluster does under load: frames, latencies, the server's CPU time, recovery from faults,
// and whether every pixel is right.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "client/interrupt.h"
#include "client/link_model.h"
#include "client/local_cluster.h"
#include "common/scene.h"
#include "common/tile.h"

namespace tessera {

struct ClusterBenchConfig {
    int workers = 1;
    int threads = 1;  ///< render threads of each worker
    bool synthetic = false;
    bool relays = false;      ///< of synthetic workers
    double tile_seconds = 0;  ///< of synthetic workers
    double spread = 0.5;
    int viewers = 1;
    unsigned in_flight = 1;  ///< frames that a viewer has asked for at a time
    double seconds = 5;
    std::filesystem::path keys;      ///< as make_keys() made them: all speak TLS; empty: plain
    std::vector<double> kills;       ///< seconds after which a worker is killed
    std::vector<double> hangs;       ///< and after which one hangs
    std::vector<double> cuts;        ///< and after which the network loses one
    std::optional<LinkConfig> link;  ///< between the server and everybody else; none: loopback's
    FrameSpec spec;                  ///< scene, size and settings
    std::vector<Camera> path;        ///< views in turn
    std::vector<Scene> scenes;       ///< of each; empty: the bundle's in all
    std::string server;              ///< to be loaded; empty: one that is started here
};

struct Percentiles {
    double p50 = 0, p95 = 0, p99 = 0, max = 0;
};
Percentiles percentiles(std::vector<double> values);

struct FaultReport {
    std::string kind;  ///< kill, hang or cut
    double at = 0;     ///< seconds
    /// By how much the slowest frame that was on its way took longer than frames did before.
    double recovery = 0;
};

/// What a server holds.
struct ServerFootprint {
    double at = 0;                   ///< seconds
    std::uint64_t memory_bytes = 0;  ///< resident
    std::uint64_t descriptors = 0;   ///< open
};

struct ClusterBenchRow {
    ClusterBenchConfig config;
    double seconds = 0;  ///< until the last frame was done
    std::uint64_t frames = 0;
    double frames_per_s = 0;
    double tiles_per_s = 0;
    /// Frames of the viewer that got fewest, and of the one that got most, against the mean.
    double least_share = 1, most_share = 1;
    std::optional<double> ideal_tiles_per_s;  ///< of synthetic workers that never wait
    Percentiles first, final;
    double server_cpu_s_per_tile = 0;
    double bytes_to_viewer = 0;     ///< per frame, of one viewer
    double bytes_from_workers = 0;  ///< per frame
    std::optional<double> bytes_to_workers;
    std::uint64_t wrong_pixels = 0;
    /// After a tenth of the time, and at the end, of a server that was started here.
    std::optional<ServerFootprint> early, late;
    std::vector<FaultReport> faults;
    bool interrupted = false;  ///< by the user; the rest is about the time up to then
};

/// Starts a server and workers on this machine and loads them. A server that is there already is
/// loaded with synthetic workers, viewers or both; nobody knows its CPU time then. `bundle` has the
/// blobs of all scenes. Throws UserError.
ClusterBenchRow bench_cluster(const ClusterBenchConfig& config, const SceneBundle& bundle,
                              Interrupt& interrupt);

}  // namespace tessera
