#include "server/viewer_session.h"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <utility>

#include "common/check.h"
#include "common/log.h"
#include "server/picture_parts.h"

namespace tessera {
namespace {

/// Requests for blobs that may be answered at the same time.
constexpr unsigned most_blob_requests = 16;
/// Changes of one viewer that may wait for the journal: enough for a batch to be worth its while.
constexpr std::size_t most_unwritten = 64;
/// Pictures of views that may be under way: one being read while the next one travels.
constexpr std::uint64_t most_unread_pictures = 2;

/// Runs on the pool: tone mapping a large picture takes longer than the strand may be held up.
asio::awaitable<std::vector<PicturePart>> make_parts(const FinishedFrame& frame) {
    co_return parts_of(frame);
}
/// Null when these are no sums of such a frame.
asio::awaitable<std::shared_ptr<FrameSums>> resumed(const FrameSpec& spec, const Bytes& saved) {
    const auto sums = std::make_shared<FrameSums>(spec);
    co_return sums->resume(saved) ? sums : nullptr;
}
asio::awaitable<PicturePart> make_part(const LivePicture& picture, int jpeg_quality) {
    co_return part_of(picture, jpeg_quality);
}

std::string no_scene(const std::string& name, const SceneStore& store) {
    return fmt::format(
        "there is no scene '{}'; upload it first, or use one that is open to all ({})", name,
        fmt::join(store.open_names(), ", "));
}

std::string no_open_scene(const std::string& name, const SceneStore& store) {
    return fmt::format("there is no open scene '{}'; there are: {}", name,
                       fmt::join(store.open_names(), ", "));
}

/// The blobs that an edit brings along.
BlobStore blobs_of(const SceneEdit& edit, std::span<const std::byte> payload) {
    BlobStore blobs;
    for (const std::uint64_t bytes : edit.blob_bytes) {
        const auto blob = payload.first(bytes);
        blobs.insert(Bytes(blob.begin(), blob.end()));
        payload = payload.subspan(bytes);
    }
    return blobs;
}

}  // namespace

ViewerSession::ViewerSession(const Hello& hello, std::shared_ptr<Connection> connection,
                             bool may_edit, const Limits& limits, std::function<Status()> status)
    : description_(fmt::format("viewer {} at {}", hello.name, connection->remote_address())),
      connection_(std::move(connection)),
      may_edit_(may_edit),
      limits_(limits),
      status_(std::move(status)),
      receiver_({.blob_bytes = limits.session_bytes, .option = "the server's --max-session"}),
      news_(connection_->executor()),
      written_(connection_->executor()) {}

asio::awaitable<void> ViewerSession::run(RenderFarm& farm, SceneStore& store, SceneWriter& writer) {
    const auto self = shared_from_this();
    spdlog::info("{} joins", description_);
    asio::co_spawn(
        connection_->executor(), [self, pool = farm.pool()] { return self->keep_informed(pool); },
        asio::detached);
    for (;;) {
        Message message = co_await connection_->receive();
        // A frame is of the newest version, with what its viewer has changed before.
        if (message.get<FrameRequest>()) co_await wait_for_writes(0);
        const bool shares = message.get<SceneShare>();
        handle(std::move(message), farm, store, writer);
        if (resuming_ && resuming_->sums.size() == resuming_->request.sums_bytes)
            co_await resume_frame(farm, store);
        // What follows may be about the scene that is shared.
        co_await wait_for_writes(shares ? 0 : most_unwritten);
    }
}

asio::awaitable<void> ViewerSession::wait_for_writes(std::size_t most) {
    boost::system::error_code cancelled;
    while (unwritten_ > most) {
        written_.expires_at(std::chrono::steady_clock::time_point::max());
        co_await written_.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
    }
}

void ViewerSession::leave(RenderFarm& farm) {
    connection_->close();
    news_.cancel();
    for (const auto& [name, watched] : watched_) watched.scene->watchers.erase(this);
    for (const auto& [request, view] : std::exchange(views_, {})) view.live->end();
    for (const auto& [request, asked] : std::exchange(frames_, {})) farm.cancel_frame(asked.frame);
    for (const auto& [name, scene] : scenes_)
        if (scene.use_count() == 1) farm.drop_scene(scene->now.name);
    scenes_.clear();
}

/// Pieces of what was asked for, and answers, are no requests.
void ViewerSession::count(const Message& message) {
    if (message.get<BlobChunk>() || message.get<SumsChunk>() || message.get<Pong>()) return;
    if (!requests_.count(std::chrono::steady_clock::now(), limits_.requests))
        throw ProtocolError(
            fmt::format("makes more than {} requests in a second (the server's --max-requests)",
                        limits_.requests));
}

void ViewerSession::handle(Message message, RenderFarm& farm, SceneStore& store,
                           SceneWriter& writer) {
    count(message);
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
    } else if (const auto* shared = message.get<SceneShare>()) {
        share(*shared, farm, writer);
    } else if (const auto* watched = message.get<SceneWatch>()) {
        watch(*watched, store);
    } else if (const auto* edited = message.get<SceneEdit>()) {
        edit(*edited, blobs_of(*edited, message.payload.bytes), store, writer);
    } else if (const auto* wanted = message.get<BlobRequest>()) {
        send_blobs_of(*wanted, store);
    } else if (const auto* view = message.get<View>()) {
        show(*view, farm, store);
    } else if (const auto* ended = message.get<ViewEnd>()) {
        end_view(ended->request);
    } else if (const auto* request = message.get<FrameRequest>()) {
        request->sums_bytes > 0 ? expect_sums(*request) : begin_frame(*request, farm, store);
    } else if (const auto* sums = message.get<SumsChunk>()) {
        add_sums(*sums, message.payload.bytes);
    } else if (const auto* save = message.get<FrameSave>()) {
        save_frame(save->request, farm);
    } else if (const auto* cancel = message.get<FrameCancel>()) {
        cancel_frame(cancel->request, farm);
    } else if (message.get<StatusRequest>()) {
        connection_->send({status_(), {}});
    } else if (const auto* ping = message.get<Ping>()) {
        connection_->send({Pong{ping->stamp}, {}});
    } else if (const auto* pong = message.get<Pong>()) {
        read_up_to(pong->stamp);
    } else {
        throw ProtocolError("sends a message that is not for viewers to send");
    }
}

void ViewerSession::publish_ready_scenes(RenderFarm& farm, SceneStore& store) {
    while (const std::optional<ReadyScene> ready = receiver_.take_ready()) {
        const std::string objection =
            objection_to_scene(limits_, {ready->scene->scene, ready->blobs});
        if (!objection.empty()) {
            receiver_.drop(ready->name);
            fail(0, fmt::format("scene '{}' is not taken: {}", ready->name, objection));
            continue;
        }
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

/// Once it is written, the scene is the viewer's own no longer.
void ViewerSession::share(const SceneShare& share, RenderFarm& farm, SceneWriter& writer) {
    const auto own = scenes_.find(share.scene);
    if (own == scenes_.end())
        return fail(0, fmt::format("there is no scene '{}' to share; upload it first and wait "
                                   "until it is ready",
                                   share.scene));
    ReadyScene scene = own->second->now;
    scene.name = share.scene;
    ++unwritten_;
    writer.open(scene, [self = shared_from_this(), &farm,
                        name = share.scene](const Complaints& complaints) {
        --self->unwritten_;
        self->written_.cancel();
        for (const std::string& complaint : complaints) self->fail(0, complaint);
        const auto held = self->scenes_.find(name);
        if (!complaints.empty() || held == self->scenes_.end()) return;
        if (held->second.use_count() == 1) farm.drop_scene(held->second->now.name);
        self->scenes_.erase(held);
        self->receiver_.drop(name);
    });
}

void ViewerSession::watch(const SceneWatch& watch, SceneStore& store) {
    const ScenePtr scene = store.find_open(watch.scene);
    if (!scene) return fail(0, no_open_scene(watch.scene, store));
    watched_[watch.scene] = {.scene = scene, .sent = std::make_shared<const SceneVersion>()};
    scene->watchers[this] = [this] { news_.cancel(); };
    news_.cancel();
}

void ViewerSession::edit(const SceneEdit& edit, const BlobStore& brought, SceneStore& store,
                         SceneWriter& writer) {
    const ScenePtr scene = store.find_open(edit.scene);
    EditResult result{.request = edit.request, .scene = edit.scene, .complaints = {}};
    if (!may_edit_) {
        result.complaints = {"this viewer's keys are to look, not to edit; use an editor's keys"};
        return connection_->send({std::move(result), {}});
    }
    if (!scene) {
        result.complaints = {no_open_scene(edit.scene, store)};
        return connection_->send({std::move(result), {}});
    }
    if (brought.size() > 0) {
        SceneBundle grown{.scene = {}, .blobs = scene->now.blobs};
        grown.blobs.merge(brought);
        if (const std::string objection = objection_to_scene(limits_, grown); !objection.empty()) {
            result.complaints = {objection};
            return connection_->send({std::move(result), {}});
        }
    }
    ++unwritten_;
    writer.edit(scene, edit.operations, brought,
                [self = shared_from_this(), scene, result](const Complaints& complaints) mutable {
                    --self->unwritten_;
                    self->written_.cancel();
                    result.version = scene->now.scene->version;
                    result.complaints = complaints;
                    self->connection_->send({std::move(result), {}});
                });
}

void ViewerSession::send_blobs_of(const BlobRequest& request, SceneStore& store) {
    const ScenePtr scene = store.find_open(request.scene);
    if (!scene) return fail(0, no_open_scene(request.scene, store));
    if (++blob_requests_ > most_blob_requests) throw ProtocolError("asks for blobs too often");
    asio::co_spawn(connection_->executor(),
                   send_blobs(connection_, scene->now.blobs, request.blobs),
                   [self = shared_from_this()](std::exception_ptr error) {
                       --self->blob_requests_;
                       if (error) self->connection_->close_for("asks for what is not there");
                   });
}

void ViewerSession::show(const View& view, RenderFarm& farm, SceneStore& store) {
    const ScenePtr scene = store.find_open(view.spec.scene);
    if (!scene) return fail(view.request, no_open_scene(view.spec.scene, store));
    if (!views_.contains(view.request) && views_.size() >= limits_.frames)
        return fail(view.request, fmt::format("more than {} views at once; end one (--max-frames)",
                                              limits_.frames));
    const auto before = views_.find(view.request);
    const Shown replaced = before == views_.end() ? Shown{} : before->second;
    if (const std::string objection = objection_to(view.spec, replaced.memory); !objection.empty())
        return fail(view.request, objection);
    auto& [live, memory] = views_[view.request];
    memory = memory_of(view.spec);
    if (!live)
        live = std::make_shared<LiveView>(
            farm, [this] { news_.cancel(); },
            [this, number = view.request](const std::string& reason) { fail(number, reason); });
    live->show(view, scene);
}

void ViewerSession::end_view(std::uint64_t request) {
    const auto found = views_.find(request);
    if (found == views_.end()) return;
    found->second.live->end();
    views_.erase(found);
}

/// A watched scene of which the viewer has an old version, or null.
std::pair<const std::string, ViewerSession::Watched>* ViewerSession::outdated_scene() {
    const auto found = std::find_if(watched_.begin(), watched_.end(), [](const auto& entry) {
        return entry.second.sent != entry.second.scene->now.scene;
    });
    return found == watched_.end() ? nullptr : &*found;
}

/// The newest picture of a view, views in turn, if the viewer keeps up.
std::optional<LivePicture> ViewerSession::next_picture() {
    if (pictures_sent_ - pictures_read_ >= most_unread_pictures) return std::nullopt;
    auto view = views_.upper_bound(last_view_);
    for (std::size_t i = 0; i < views_.size(); ++i, ++view) {
        if (view == views_.end()) view = views_.begin();
        last_view_ = view->first;
        if (auto picture = view->second.live->take()) return picture;
    }
    return std::nullopt;
}

/// Sends newest versions of watched scenes and newest pictures of views, as fast as the viewer
/// reads; what it is too slow for is left out.
asio::awaitable<void> ViewerSession::keep_informed(asio::any_io_executor pool) {
    const auto self = shared_from_this();
    try {
        while (connection_->open()) {
            if (outdated_scene()) {
                co_await connection_->wait_until_drained(chunk_bytes);
                send_newest(*outdated_scene());
            } else if (const auto picture = next_picture()) {
                co_await send_picture(*picture, pool);
            } else {
                boost::system::error_code cancelled;
                news_.expires_at(std::chrono::steady_clock::time_point::max());
                co_await news_.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
            }
        }
    } catch (const std::exception& error) {
        spdlog::info("{}: not told of changes: {}", description_, error.what());
        connection_->close();
    }
}

void ViewerSession::send_newest(std::pair<const std::string, Watched>& entry) {
    auto& [name, watched] = entry;
    const auto newest = watched.scene->now.scene;
    connection_->send({SceneUpdate{name, diff(*watched.sent, *newest)}, {}});
    watched.sent = newest;
}

asio::awaitable<void> ViewerSession::send_picture(LivePicture picture, asio::any_io_executor pool) {
    const int quality =
        picture.view.jpeg_quality > 0 ? int(picture.view.jpeg_quality) : jpeg_quality_;
    const PicturePart part =
        co_await asio::co_spawn(pool, make_part(picture, quality), asio::use_awaitable);
    const std::uint64_t number = ++pictures_sent_;
    travelling_[number] = {.sent = std::chrono::steady_clock::now(),
                           .begun = {},
                           .jpeg = part.whole.format == PictureFormat::jpeg};
    connection_->send_bulk({Ping{2 * number - 1}, {}});
    co_await send_part(part);
    connection_->send_bulk({picture.about, {}});
    connection_->send_bulk({Ping{2 * number}, {}});
}

/// The viewer has read the beginning of a picture, or all of it.
void ViewerSession::read_up_to(std::uint64_t stamp) {
    const auto now = std::chrono::steady_clock::now();
    const auto picture = travelling_.find(stamp / 2 + stamp % 2);
    if (picture == travelling_.end()) return;
    Travelling& way = picture->second;
    if (stamp % 2 == 1) {
        way.begun = now;
        return;
    }
    const auto seconds = [](auto from, auto to) {
        return std::chrono::duration<double>(to - from).count();
    };
    if (way.jpeg && way.begun >= way.sent)
        jpeg_quality_ =
            next_jpeg_quality(jpeg_quality_, seconds(way.begun, now), seconds(way.sent, way.begun));
    pictures_read_ = std::max(pictures_read_, stamp / 2);
    travelling_.erase(travelling_.begin(), std::next(picture));
    news_.cancel();
}

/// Feeds chunks into the bulk lane, as fast as the viewer reads.
asio::awaitable<void> ViewerSession::send_part(const PicturePart& part) {
    for (std::size_t offset = 0; offset < part.whole.total; offset += chunk_bytes) {
        co_await connection_->wait_until_drained(chunk_bytes);
        connection_->send_bulk(chunk_of(part, offset));
    }
}

void ViewerSession::expect_sums(const FrameRequest& request) {
    if (resuming_) throw ProtocolError("sends sums of two frames at once");
    if (request.sums_bytes != FrameSums::saved_bytes(request.spec))
        throw ProtocolError(fmt::format("announces {} bytes of sums for a frame that has {}",
                                        request.sums_bytes, FrameSums::saved_bytes(request.spec)));
    if (const std::string objection = objection_to(request.spec, 0); !objection.empty())
        return fail(request.request, objection);
    resuming_ = {.request = request, .sums = {}};
}

void ViewerSession::add_sums(const SumsChunk& chunk, std::span<const std::byte> bytes) {
    if (!resuming_) return;  // of a frame that was refused
    if (chunk.request != resuming_->request.request ||
        chunk.total != resuming_->request.sums_bytes || chunk.offset != resuming_->sums.size())
        throw ProtocolError("sends sums that no frame waits for");
    resuming_->sums.insert(resuming_->sums.end(), bytes.begin(), bytes.end());
}

asio::awaitable<void> ViewerSession::resume_frame(RenderFarm& farm, SceneStore& store) {
    const Resuming whole = std::move(*resuming_);
    resuming_.reset();
    const auto sums = co_await asio::co_spawn(farm.pool(), resumed(whole.request.spec, whole.sums),
                                              asio::use_awaitable);
    if (sums)
        begin_frame(whole.request, farm, store, sums);
    else
        fail(whole.request.request, "the sums are none of such a frame; begin it anew");
}

/// One at a time, so that what waits to be sent stays bounded.
void ViewerSession::save_frame(std::uint64_t request, RenderFarm& farm) {
    const auto found = frames_.find(request);
    if (found == frames_.end() || frames_.contains(saving_)) return;
    saving_ = request;
    farm.save_frame(found->second.frame, [weak = weak_from_this(), request](SavedFrame saved) {
        const auto self = weak.lock();
        if (!self) return;
        asio::co_spawn(self->connection_->executor(), self->send_sums(request, std::move(saved)),
                       asio::detached);
    });
}

asio::awaitable<void> ViewerSession::send_sums(std::uint64_t request, SavedFrame saved) {
    const auto self = shared_from_this();
    SumsChunk chunk{.request = request,
                    .offset = 0,
                    .total = saved.sums ? saved.sums->size() : 0,
                    .render_seconds = saved.render_seconds,
                    .rays = saved.rays};
    try {
        do {
            const std::size_t size = std::min<std::size_t>(chunk_bytes, chunk.total - chunk.offset);
            const auto bytes = saved.sums ? std::span(*saved.sums).subspan(chunk.offset, size)
                                          : std::span<const std::byte>();
            co_await connection_->wait_until_drained(chunk_bytes);
            connection_->send_bulk({chunk, {saved.sums, bytes}});
            chunk.offset += size;
        } while (chunk.offset < chunk.total);
    } catch (const boost::system::system_error&) {
        // The viewer has gone.
    }
    saving_ = 0;
}

std::string ViewerSession::objection_to(const FrameSpec& spec, std::uint64_t replaced) const {
    if (const std::string objection = objection_to_size(limits_, spec.size); !objection.empty())
        return objection;
    std::uint64_t memory = receiver_.blobs().bytes() + memory_of(spec) - replaced;
    for (const auto& [request, asked] : frames_) memory += asked.memory;
    for (const auto& [request, shown] : views_) memory += shown.memory;
    return objection_to_memory(limits_, memory);
}

void ViewerSession::begin_frame(const FrameRequest& request, RenderFarm& farm, SceneStore& store,
                                std::shared_ptr<FrameSums> sums) {
    const auto own = scenes_.find(request.spec.scene);
    const ScenePtr scene = own != scenes_.end() ? own->second : store.find_open(request.spec.scene);
    if (!scene) return fail(request.request, no_scene(request.spec.scene, store));
    if (frames_.contains(request.request))
        throw ProtocolError(fmt::format("uses request number {} twice", request.request));
    if (frames_.size() >= limits_.frames)
        return fail(request.request, fmt::format("more than {} frames at once; wait for one to "
                                                 "finish or cancel it (--max-frames)",
                                                 limits_.frames));
    if (const std::string objection = objection_to(request.spec, 0); !objection.empty())
        return fail(request.request, objection);
    // The farm outlives the session, but a session that has ended hears nothing more.
    const auto weak = weak_from_this();
    Asked& asked = frames_[request.request];
    asked.memory = memory_of(request.spec);
    asked.frame = farm.begin_frame(
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
             }},
        std::move(sums));
}

void ViewerSession::cancel_frame(std::uint64_t request, RenderFarm& farm) {
    const auto found = frames_.find(request);
    if (found == frames_.end()) return;  // answered in the meantime
    farm.cancel_frame(found->second.frame);
    frames_.erase(found);
}

void ViewerSession::fail(std::uint64_t request, const std::string& reason) {
    spdlog::warn("{}, request {}: {}", description_, request, reason);
    connection_->send({Failure{request, reason}, {}});
}

bool ViewerSession::wants(const FrameRequest& request) const {
    const auto found = frames_.find(request.request);
    return found != frames_.end() && found->second.frame == request.spec.frame;
}

asio::awaitable<void> ViewerSession::send_frame(FinishedFrame frame, asio::any_io_executor pool) {
    const auto self = shared_from_this();
    try {
        const std::vector<PicturePart> parts =
            co_await asio::co_spawn(pool, make_parts(frame), asio::use_awaitable);
        for (const PicturePart& part : parts)
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
