// One worker: its connection, what it holds, what it is at. Lives on the server's strand.
#pragma once

#include <deque>
#include <map>
#include <memory>
#include <set>
#include <string>

#include "common/scene_sync.h"

namespace tessera {

class RenderFarm;

class WorkerSession : public std::enable_shared_from_this<WorkerSession> {
public:
    WorkerSession(std::uint64_t id, const Hello& hello, std::shared_ptr<Connection> connection);

    /// Serves the worker; throws ProtocolError or boost::system::system_error when that ends.
    asio::awaitable<void> run(RenderFarm& farm);
    /// To be called after `run`.
    void leave(RenderFarm& farm);
    void close() { connection_->close(); }
    /// Closes, and tells the worker why.
    void dismiss(const std::string& reason) { connection_->dismiss(reason); }

    /// Sends what leads from the version it has to this one, unless it is there or on its way.
    /// The worker builds `tracer` with it. Returns whether an update was sent.
    bool bring(const ReadyScene& scene, TracerKind tracer);
    /// Returns whether the worker had it.
    bool drop(const std::string& scene);
    /// Adds a task to those that send_tasks() sends; returns whether it is the first of them.
    bool hand_out(const FrameSpec& spec, const TileTask& task);
    void send_tasks();
    void end_frame(std::uint64_t frame);

    /// How far the worker is with a version of a scene.
    struct SceneState {
        ReadyScene sent;
        BlobStore offered;  ///< of all versions sent since one was ready: it may ask for them
        bool ready = false;
        SceneReady report;    ///< when ready
        std::string failure;  ///< not empty when the worker cannot build it
    };
    /// Null when that version was never sent or a newer one has followed.
    const SceneState* state_of(const std::string& scene, std::uint64_t version) const;

    std::uint64_t id() const { return id_; }
    const std::string& name() const { return name_; }
    std::string description() const;  ///< for logs
    std::uint32_t threads() const { return threads_; }
    const std::string& address() const { return connection_->remote_address(); }
    double round_trip_seconds() const { return round_trip_seconds_; }
    std::uint64_t memory_bytes() const { return memory_bytes_; }
    std::uint64_t bytes_received() const { return connection_->bytes_received(); }
    /// Where other workers get blobs from it, "host:port"; empty: nowhere.
    const std::string& relay_address() const { return relay_address_; }
    std::uint64_t relayed_bytes() const { return relayed_bytes_; }
    std::uint64_t sent_bytes() const { return connection_->bytes_sent(); }
    /// As it was of late.
    const LinkSpeed& link() const { return link_; }

    std::uint64_t tiles = 0;  ///< results used
    std::uint64_t rays = 0;
    double busy_seconds = 0;  ///< of its threads, for all results

private:
    void handle(Message message, RenderFarm& farm);
    void ponged(const Pong& pong, RenderFarm& farm);
    void send_blobs_of(const BlobRequest& request, RenderFarm& farm);
    void became_ready(const SceneReady& ready, RenderFarm& farm);
    void failed(const Failure& failure, RenderFarm& farm);
    asio::awaitable<void> keep_pinging();

    std::uint64_t id_;
    std::string name_;
    std::uint32_t threads_;
    std::shared_ptr<Connection> connection_;
    std::map<std::string, SceneState> scenes_;
    std::deque<std::string> unanswered_;  ///< scenes of updates sent, oldest first
    std::set<std::uint64_t> frames_;      ///< begun on the worker
    TileTasks tasks_;                     ///< to be sent
    double round_trip_seconds_ = 0;
    std::uint64_t memory_bytes_ = 0;
    std::string relay_address_;
    std::uint64_t relayed_bytes_ = 0;
    LinkSpeed link_;
    asio::steady_timer ping_timer_;
};

}  // namespace tessera
