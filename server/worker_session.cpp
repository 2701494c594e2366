#include "server/worker_session.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "common/check.h"
#include "common/log.h"
#include "common/message_codec.h"
#include "server/render_farm.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr auto ping_interval = std::chrono::seconds(1);
/// A worker answers pings even while it renders or builds; ten lost ones mean that it is gone.
constexpr auto longest_silence = std::chrono::seconds(10);
/// Threads that a worker may claim: bounds what it is handed ahead.
constexpr std::uint32_t most_threads = 1024;

std::uint64_t now_nanoseconds() { return std::uint64_t(Clock::now().time_since_epoch().count()); }

}  // namespace

WorkerSession::WorkerSession(std::uint64_t id, const Hello& hello,
                             std::shared_ptr<Connection> connection)
    : id_(id),
      name_(hello.name.empty() ? connection->remote_address() : hello.name),
      threads_(std::clamp(hello.threads, 1u, most_threads)),
      connection_(std::move(connection)),
      ping_timer_(connection_->executor()) {
    if (hello.relay_port != 0)
        relay_address_ =
            fmt::format("{}{}", address().substr(0, address().rfind(':') + 1), hello.relay_port);
}

asio::awaitable<void> WorkerSession::run(RenderFarm& farm) {
    const auto self = shared_from_this();
    spdlog::info("{} joins with {} threads", description(), threads_);
    asio::co_spawn(
        connection_->executor(), [self] { return self->keep_pinging(); }, asio::detached);
    farm.add_worker(self);
    for (;;) {
        handle(co_await connection_->receive(longest_silence), farm);
        while (std::optional<Message> more = connection_->receive_now())
            handle(std::move(*more), farm);
    }
}

void WorkerSession::leave(RenderFarm& farm) {
    connection_->close();
    ping_timer_.cancel();
    farm.remove_worker(id_);
}

std::string WorkerSession::description() const {
    return fmt::format("worker {} at {}", name_, address());
}

void WorkerSession::handle(Message message, RenderFarm& farm) {
    if (const auto* results = message.get<TileResults>())
        farm.tile_results(*this, *results, message.payload.bytes);
    else if (const auto* request = message.get<BlobRequest>())
        send_blobs_of(*request, farm);
    else if (const auto* ready = message.get<SceneReady>())
        became_ready(*ready, farm);
    else if (const auto* failure = message.get<Failure>())
        failed(*failure, farm);
    else if (const auto* ping = message.get<Ping>())
        connection_->send({Pong{ping->stamp}, {}});
    else if (const auto* pong = message.get<Pong>())
        ponged(*pong, farm);
    else if (message.get<Leave>())
        farm.retire(*this);
    else
        throw ProtocolError("sends a message that is not for workers to send");
}

void WorkerSession::ponged(const Pong& pong, RenderFarm& farm) {
    const std::uint64_t now = now_nanoseconds();
    if (pong.stamp > now) throw ProtocolError("answers a ping that was never sent");
    round_trip_seconds_ = 1e-9 * double(now - pong.stamp);
    memory_bytes_ = pong.memory_bytes;
    relayed_bytes_ = pong.relayed_bytes;
    link_ = connection_->link();
    farm.round_trip(*this, round_trip_seconds_);
}

void WorkerSession::send_blobs_of(const BlobRequest& request, RenderFarm& farm) {
    const auto held = scenes_.find(request.scene);
    if (held == scenes_.end() || request.blobs.empty()) return;
    link_ = connection_->link();
    const BlobStore& offered = held->second.offered;
    for (RelayPlan::Share& share : farm.share_blobs(*this, request, offered)) {
        if (share.peer != 0) {
            connection_->send({BlobSource{share.peer, farm.relay_address(share.peer),
                                          std::move(share.blobs), std::move(share.bytes)},
                               {}});
            continue;
        }
        asio::co_spawn(connection_->executor(),
                       send_blobs(connection_, offered, std::move(share.blobs)),
                       [self = shared_from_this()](std::exception_ptr error) {
                           if (error) self->close();
                       });
    }
}

bool WorkerSession::bring(const ReadyScene& scene, TracerKind tracer) {
    const auto held = scenes_.find(scene.name);
    const bool known = held != scenes_.end();
    if (known && held->second.sent.scene->version == scene.scene->version) return false;
    // Once a build has failed, nobody knows what the worker holds: start again from nothing.
    const bool from_nothing = !known || !held->second.failure.empty();
    const SceneDelta delta =
        diff(from_nothing ? SceneVersion{} : *held->second.sent.scene, *scene.scene);
    BlobStore offered = known ? held->second.offered : BlobStore{};
    offered.merge(scene.blobs);
    SceneState& state = scenes_[scene.name] = {
        .sent = scene, .offered = std::move(offered), .ready = false, .report = {}, .failure = {}};
    try {
        connection_->send({SceneUpdate{scene.name, delta, tracer}, {}});
        unanswered_.push_back(scene.name);
    } catch (const UserError& too_large) {
        state.failure = too_large.what();
    }
    return true;
}

bool WorkerSession::drop(const std::string& scene) {
    if (scenes_.erase(scene) == 0) return false;
    std::erase(unanswered_, scene);
    connection_->send({SceneDrop{scene}, {}});
    return true;
}

bool WorkerSession::hand_out(const FrameSpec& spec, const TileTask& task) {
    if (frames_.insert(spec.frame).second) connection_->send({FrameBegin{spec}, {}});
    if (tasks_.tasks.size() == max_tiles_together) send_tasks();
    tasks_.tasks.push_back(task);
    return tasks_.tasks.size() == 1;
}

void WorkerSession::send_tasks() {
    if (!tasks_.tasks.empty()) connection_->send({std::exchange(tasks_, {}), {}});
}

void WorkerSession::end_frame(std::uint64_t frame) {
    if (frames_.erase(frame) > 0) connection_->send({FrameEnd{frame}, {}});
}

const WorkerSession::SceneState* WorkerSession::state_of(const std::string& scene,
                                                         std::uint64_t version) const {
    const auto held = scenes_.find(scene);
    if (held == scenes_.end() || held->second.sent.scene->version != version) return nullptr;
    return &held->second;
}

void WorkerSession::became_ready(const SceneReady& ready, RenderFarm& farm) {
    std::erase(unanswered_, ready.scene);
    const auto held = scenes_.find(ready.scene);
    // It may speak of a scene that was dropped or changed in the meantime.
    if (held == scenes_.end() || held->second.sent.scene->version != ready.version) return;
    held->second.ready = true;
    held->second.offered = held->second.sent.blobs;
    held->second.report = ready;
    held->second.failure.clear();
    spdlog::info("worker {} has built {} version {} in {:.2f} s", name_, ready.scene, ready.version,
                 ready.build_seconds);
    farm.scene_ready(*this, ready.scene, ready.version);
}

/// A failure is about a frame, or else about the oldest update that the worker has not answered.
void WorkerSession::failed(const Failure& failure, RenderFarm& farm) {
    spdlog::warn("worker {}: {}", name_, failure.reason);
    if (failure.request != 0) return farm.frame_failed(*this, failure.request, failure.reason);
    if (unanswered_.empty()) return;
    const std::string scene = std::exchange(unanswered_.front(), {});
    unanswered_.pop_front();
    scenes_.at(scene).failure = failure.reason.empty() ? "no reason given" : failure.reason;
    farm.scene_failed(*this, scene);
}

asio::awaitable<void> WorkerSession::keep_pinging() {
    const auto self = shared_from_this();
    boost::system::error_code cancelled;
    while (connection_->open() && !cancelled) {
        connection_->send({Ping{now_nanoseconds()}, {}});
        ping_timer_.expires_after(ping_interval);
        co_await ping_timer_.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
    }
}

}  // namespace tessera
