// A worker process: connects to its server, and again whenever the connection is lost.
#pragma once

#include <chrono>
#include <filesystem>
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
    std::shared_ptr<const ShaderTable> shaders = built_in_shaders();
    bool relays = true;            ///< has meshes and textures for other workers, and takes theirs
    std::uint16_t relay_port = 0;  ///< where; 0: any free port
    std::filesystem::path blob_cache = {};  ///< folder for meshes and textures; empty: none is kept
    std::uint64_t blob_cache_bytes = std::uint64_t(4) << 30;
    /// Attempts in a row that may fail before the worker gives up; none: it never does.
    std::optional<unsigned> attempts;
};

class Worker {
public:
    explicit Worker(const WorkerConfig& config);

    /// Serves until it leaves, or is ended by stopping its io_context; the threads end with the
    /// Worker, which must go before the io_context. Throws UserError when the server refuses this
    /// worker or the attempts are used up.
    asio::awaitable<void> run();
    /// Finishes what it has been handed, then `run` returns. Returns false when there is nothing to
    /// finish, because it is not connected.
    bool leave();

private:
    asio::awaitable<void> serve();

    WorkerConfig config_;
    std::shared_ptr<BlobCache> cache_;  ///< null: none
    WorkerPools pools_;
    bool leaving_ = false;
    BlobStore
        blobs_;  ///< of the session before, so that a server that comes back need not send them
    std::weak_ptr<Session> session_;
    unsigned failures_ = 0;  ///< attempts to connect that have failed in a row
};

}  // namespace tessera
