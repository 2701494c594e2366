// What a worker does for one server while their connection lasts: keeps scenes, begins and ends
// frames, hands tasks to the render threads and streams results back in the order they get done.
// What is done while the connection is still taking what was done before goes together: a tile
// never waits for another one, and cheap tiles share messages by themselves.
//
// One network thread owns all of this state and never renders or builds (Wald, "Realtime Ray
// Tracing and Interactive Global Illumination", 2004, 8.2.5): jobs run in the pools and post what
// they made back to it.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "common/connection.h"
#include "common/relay.h"
#include "common/scene_sync.h"
#include "worker/blob_cache.h"
#include "worker/renderer.h"
#include "worker/thread_pool.h"

namespace tessera {

/// The threads that work for a session; they outlive it. Their queues are bounded: a server that
/// fills one breaks the protocol.
struct WorkerPools {
    std::atomic<bool> ending = false;  ///< long jobs end early
    ThreadPool render;
    ThreadPool scenes;  ///< one thread: builds scenes one after the other
    ThreadPool frames;  ///< one thread: begins and ends frames in order
    ThreadPool reads;   ///< one thread: finds blobs on disk
    ThreadPool writes;  ///< one thread: puts blobs there

    explicit WorkerPools(unsigned render_threads);
    ~WorkerPools() { ending = true; }
};

class Session : public std::enable_shared_from_this<Session> {
public:
    /// `config`: of the renderers. `known`: blobs that are here already. `relay`: to other workers,
    /// not begun; may be null. `cache`: on disk; may be null.
    Session(std::shared_ptr<Connection> connection, WorkerPools& pools,
            const RendererConfig& config, const BlobStore& known = {},
            std::shared_ptr<Relay> relay = {}, std::shared_ptr<BlobCache> cache = {});
    ~Session();

    /// Serves until the connection ends; throws what Connection::receive throws.
    /// `relay_token`: of the server's Welcome.
    asio::awaitable<void> run(const std::string& relay_token = {});
    const BlobStore& blobs() const { return receiver_->blobs(); }
    /// Asks the server for no more work and to end the session after what it has.
    void leave() { connection_->send({Leave{}, {}}); }

private:
    struct BuiltVersion {
        std::uint64_t version = 0;
        std::shared_ptr<Renderer> renderer;
    };

    /// A frame begun by the server. Jobs share it; only `ended` changes under them.
    struct Frame {
        FrameSpec spec;
        std::shared_ptr<Renderer> renderer;
        std::atomic<bool> ended = false;
        bool ready = false;             ///< the renderer has begun it
        std::vector<TileTask> waiting;  ///< until it is ready
    };

    struct FinishedTile {
        TileReport report;
        Bytes pixels;  ///< none: the frame has ended
    };

    void handle(const Message& message);
    void on(const SceneUpdate& update);
    void on(const BlobSource& source);
    void on(const SceneDrop& drop);
    void on(const FrameBegin& begin);
    void on(const FrameEnd& end);
    void on(const TileTasks& tasks);
    void on(const Ping& ping);

    /// Returns false when the disk has too much to do.
    bool look_on_disk(const BlobRequest& request);
    void looked_on_disk(const BlobRequest& request, BlobStore found);
    void keep_on_disk(const ReadyScene& scene);
    void build_next_scene();
    void scene_built(const ReadyScene& scene, std::shared_ptr<Renderer> renderer,
                     const std::string& error);
    /// Null when there is none.
    std::shared_ptr<Renderer> newest_renderer(const std::string& scene) const;
    /// Null when the version is not held.
    std::shared_ptr<Renderer> find_renderer(const std::string& scene, std::uint64_t version) const;
    void frame_ready(const std::shared_ptr<Frame>& frame, const std::string& error);
    void take(const TileTask& task);
    void render(const std::shared_ptr<Frame>& frame, const TileTask& task);
    /// Runs while anything is finished.
    asio::awaitable<void> send_finished();
    /// What goes in the next message.
    Message take_finished();
    void report_ready(const std::string& scene, std::uint64_t version, const Renderer& renderer);
    void fail(std::uint64_t frame, const std::string& reason);

    /// Runs `work` in `pool` and then `done(session, result of work)` on the network thread, unless
    /// the session is over. Throws ProtocolError when the pool's queue is full.
    template <class Work, class Done>
    void run_in(ThreadPool& pool, Work work, Done done);
    /// The same, but returns false when the queue is full.
    template <class Work, class Done>
    bool try_run_in(ThreadPool& pool, Work work, Done done);

    std::shared_ptr<Connection> connection_;
    asio::any_io_executor executor_;
    WorkerPools& pools_;
    RendererConfig renderer_config_;
    std::shared_ptr<SceneReceiver> receiver_ = std::make_shared<SceneReceiver>();
    std::shared_ptr<Relay> relay_;
    std::shared_ptr<BlobCache> cache_;
    std::map<std::string, std::vector<BlobId>> kept_;  ///< by scene: handed to the disk, sorted
    std::map<std::string, TracerKind> tracers_;        ///< by scene: what to build with it
    bool building_ = false;
    std::map<std::string, std::deque<BuiltVersion>> renderers_;  ///< by scene, oldest first
    std::map<std::uint64_t, std::shared_ptr<Frame>> frames_;
    std::deque<FinishedTile> finished_;  ///< not sent yet; never more than tasks handed out
    bool sending_ = false;
};

}  // namespace tessera
