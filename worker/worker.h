// A worker process: connects to its server, and again whenever the connection is lost.
#pragma once

#include <chrono>
#include <optional>
#include <string>

#include "common/connection.h"
#include "worker/session.h"

namespace tessera {

struct WorkerConfig {
    Address server;
    unsigned threads = 1;     ///< render threads
    std::string name;         ///< for the server's logs and status
    Credentials credentials;  ///< the server's operator gives them out
    /// Attempts in a row that may fail before the worker gives up; none: it never does.
    std::optional<unsigned> attempts;
};

/// Time to wait after `failures` attempts in a row have failed: doubles from 0.1 s up to 5 s, and
/// `u` in [0, 1) takes up to half of it away, so that workers do not all come back at once.
std::chrono::milliseconds retry_delay(unsigned failures, double u);

class Worker {
public:
    explicit Worker(const WorkerConfig& config) : config_(config), pools_(config.threads) {}

    /// Serves for ever, to be ended by stopping its io_context; the threads end with the Worker,
    /// which must go before the io_context. Throws UserError when the server refuses this worker
    /// or the attempts are used up.
    asio::awaitable<void> run();

private:
    asio::awaitable<void> serve();

    WorkerConfig config_;
    WorkerPools pools_;
    unsigned failures_ = 0;  ///< attempts to connect that have failed in a row
};

}  // namespace tessera
