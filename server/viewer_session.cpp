#include "server/viewer_session.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <utility>

#include "common/check.h"
#include "common/log.h"

namespace tessera {
namespace {

/// Frames that a viewer may have in flight; each costs memory for its passes.
constexpr std::size_t most_frames = 16;

/// A picture or channel in the form in which it travels.
struct Part {
    PictureChunk whole;  ///< offset 0
    Payload pixels;
};

template <class T>
Part make_part(const FrameRequest& request, Channel channel, PictureFormat format, int components,
               std::vector<T> values) {
    const auto owner = std::make_shared<const std::vector<T>>(std::move(values));
    const std::span<const std::byte> bytes = std::as_bytes(std::span(*owner));
    return {.whole = {.request = request.request,
                      .channel = channel,
                      .format = format,
                      .width = std::uint32_t(request.spec.size.width),
                      .height = std::uint32_t(request.spec.size.height),
                      .components = std::uint32_t(components),
                      .offset = 0,
                      .total = bytes.size()},
            .pixels = {owner, bytes}};
}

Part picture_part(const FrameRequest& request, Image picture) {
    if (request.format == PictureFormat::srgb8)
        return make_part(request, Channel::radiance, request.format, 3,
                         to_srgb8(picture, request.tone_map));
    return make_part(request, Channel::radiance, request.format, 3, std::move(picture.data));
}

/// Runs on the pool: tone mapping a large picture takes longer than the strand may be held up.
asio::awaitable<std::vector<Part>> make_parts(const FinishedFrame& frame) {
    std::vector<Part> parts{picture_part(frame.request, frame.sums->picture())};
    for (int c = 1; c < channel_count; ++c) {
        if (!frame.request.spec.extra.has(Channel(c))) continue;
        Image image = frame.sums->channel(Channel(c));
        parts.push_back(make_part(frame.request, Channel(c), PictureFormat::linear_float,
                                  image.channels, std::move(image.data)));
    }
    co_return parts;
}

Message chunk_of(const Part& part, std::size_t offset) {
    Message message;
    PictureChunk chunk = part.whole;
    chunk.offset = offset;
    message.body = chunk;
    message.payload = {part.pixels.owner,
                       part.pixels.bytes.subspan(
                           offset, std::min<std::size_t>(chunk_bytes, chunk.total - offset))};
    return message;
}

}  // namespace

ViewerSession::ViewerSession(const Hello& hello, std::shared_ptr<Connection> connection,
                             bool may_edit, std::function<Status()> status)
    : description_(fmt::format("viewer {} at {}", hello.name, connection->remote_address())),
      connection_(std::move(connection)),
      may_edit_(may_edit),
      status_(std::move(status)) {}

asio::awaitable<void> ViewerSession::run(RenderFarm& farm, SceneStore& store) {
    const auto self = shared_from_this();
    spdlog::info("{} joins", description_);
    for (;;) handle(co_await connection_->receive(), farm, store);
}

void ViewerSession::leave(RenderFarm& farm) {
    connection_->close();
    for (const auto& [request, frame] : std::exchange(frames_, {})) farm.cancel_frame(frame);
    for (const auto& [name, scene] : scenes_)
        if (scene.use_count() == 1) farm.drop_scene(scene->now.name);
    scenes_.clear();
}

void ViewerSession::handle(Message message, RenderFarm& farm, SceneStore& store) {
    if (const auto* update = message.get<SceneUpdate>()) {
        if (!may_edit_)
            return fail(0, fmt::format("scene {} is not taken: this viewer's keys are to look, not "
                                       "to edit; use a scene that the server has loaded, or an "
                                       "editor's keys",
                                       update->scene));
        connection_->send({receiver_.update(*update), {}});
        publish_ready_scenes(farm, store);
    } else if (const auto* chunk = message.get<BlobChunk>()) {
        receiver_.add(*chunk, message.payload.bytes);
        publish_ready_scenes(farm, store);
    } else if (const auto* request = message.get<FrameRequest>()) {
        begin_frame(*request, farm, store);
    } else if (const auto* cancel = message.get<FrameCancel>()) {
        cancel_frame(cancel->request, farm);
    } else if (message.get<StatusRequest>()) {
        connection_->send({status_(), {}});
    } else if (const auto* ping = message.get<Ping>()) {
        connection_->send({Pong{ping->stamp}, {}});
    } else if (!message.get<Pong>()) {
        throw ProtocolError("sends a message that is not for viewers to send");
    }
}

void ViewerSession::publish_ready_scenes(RenderFarm& farm, SceneStore& store) {
    while (const std::optional<ReadyScene> ready = receiver_.take_ready()) {
        ScenePtr& held = scenes_[ready->name];
        const ScenePtr next = store.publish(held, *ready);
        const ScenePtr before = std::exchange(held, next);
        if (before && before != next && before.use_count() == 1) farm.drop_scene(before->now.name);
        connection_->send({SceneReady{.scene = ready->name,
                                      .version = ready->scene->version,
                                      .modelled = {},
                                      .left_out = {}},
                           {}});
    }
}

void ViewerSession::begin_frame(const FrameRequest& request, RenderFarm& farm, SceneStore& store) {
    const auto own = scenes_.find(request.spec.scene);
    const ScenePtr scene =
        own != scenes_.end() ? own->second : store.find_loaded(request.spec.scene);
    if (!scene)
        return fail(request.request,
                    fmt::format("there is no scene '{}'; upload it first, or use one that the "
                                "server has loaded ({})",
                                request.spec.scene, fmt::join(store.loaded_names(), ", ")));
    if (frames_.contains(request.request))
        throw ProtocolError(fmt::format("uses request number {} twice", request.request));
    if (frames_.size() >= most_frames)
        return fail(request.request, fmt::format("more than {} frames at once; wait for one to "
                                                 "finish or cancel it",
                                                 most_frames));
    // The farm outlives the session, but a session that has ended hears nothing more.
    const auto weak = weak_from_this();
    frames_[request.request] = farm.begin_frame(
        request, scene->now,
        {.progress =
             [weak](const FrameProgress& progress) {
                 if (const auto self = weak.lock()) self->connection_->send({progress, {}});
             },
         .done =
             [weak, pool = farm.pool()](FinishedFrame frame) {
                 const auto self = weak.lock();
                 if (!self) return;
                 asio::co_spawn(self->connection_->executor(),
                                self->send_frame(std::move(frame), pool), asio::detached);
             },
         .failed =
             [weak, number = request.request](const std::string& reason) {
                 const auto self = weak.lock();
                 if (!self) return;
                 self->frames_.erase(number);
                 self->fail(number, reason);
             }});
}

void ViewerSession::cancel_frame(std::uint64_t request, RenderFarm& farm) {
    const auto found = frames_.find(request);
    if (found == frames_.end()) return;  // answered in the meantime
    farm.cancel_frame(found->second);
    frames_.erase(found);
}

void ViewerSession::fail(std::uint64_t request, const std::string& reason) {
    spdlog::warn("{}, request {}: {}", description_, request, reason);
    connection_->send({Failure{request, reason}, {}});
}

bool ViewerSession::wants(const FrameRequest& request) const {
    const auto found = frames_.find(request.request);
    return found != frames_.end() && found->second == request.spec.frame;
}

/// Feeds picture and channels into the bulk lane, as fast as the viewer reads.
asio::awaitable<void> ViewerSession::send_frame(FinishedFrame frame, asio::any_io_executor pool) {
    const auto self = shared_from_this();
    try {
        const std::vector<Part> parts =
            co_await asio::co_spawn(pool, make_parts(frame), asio::use_awaitable);
        for (const Part& part : parts)
            for (std::size_t offset = 0; offset < part.whole.total; offset += chunk_bytes) {
                co_await connection_->wait_until_drained(chunk_bytes);
                if (!wants(frame.request)) co_return;
                connection_->send_bulk(chunk_of(part, offset));
            }
        if (!wants(frame.request)) co_return;
        frames_.erase(frame.request.request);
        connection_->send_bulk({FrameDone{frame.request.request, frame.statistics}, {}});
    } catch (const std::exception& error) {
        spdlog::info("{}: picture not sent: {}", description_, error.what());
        connection_->close();
    }
}

}  // namespace tessera
