// Workers that render nothing: connections that take scenes and their changes as workers do, but
// keep nothing, and answer every task with made-up pixels, at once or after a drawn time. Thousands
// fit into one process, so that a server can be loaded beyond what the machines at hand could
// render.
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "common/connection.h"

namespace tessera {

struct SyntheticConfig {
    Address server;
    Credentials credentials;
    int workers = 1;
    std::uint32_t threads = 1;
    double tile_seconds = 0;  ///< mean time of a task on one thread; 0: none
    bool relays = false;      ///< keep meshes and textures, and pass them on to one another
    double spread = 0.5;      ///< standard deviation of its logarithm, from tile to tile
};

struct SyntheticTraffic {
    std::uint64_t results = 0;
    std::uint64_t bytes_in = 0;
    std::uint64_t bytes_out = 0;
};

/// All of them, on a network thread of their own.
class SyntheticWorkers {
public:
    /// Starts to connect. A worker whose connection ends does not come back.
    explicit SyntheticWorkers(const SyntheticConfig& config);
    ~SyntheticWorkers();
    SyntheticWorkers(const SyntheticWorkers&) = delete;
    SyntheticWorkers& operator=(const SyntheticWorkers&) = delete;

    /// Its connection closes.
    void kill(int worker);
    /// It keeps its connection and does nothing more.
    void hang(int worker);
    SyntheticTraffic traffic();

private:
    class Worker;

    /// Runs `f` on the network thread and returns its result.
    template <class F>
    auto ask(F f);

    asio::io_context io_{1};
    std::vector<std::shared_ptr<Worker>> workers_;
    std::thread thread_;
};

}  // namespace tessera
