#include "worker/session.h"

#include <fmt/format.h>

#include <algorithm>
#include <exception>
#include <iterator>
#include <set>
#include <utility>

#include "common/log.h"
#include "common/message_codec.h"
#include "common/process.h"
#include "common/tile_codec.h"

namespace tessera {
namespace {

/// Tasks that may wait for render threads: far more than any server prefetches.
constexpr std::size_t max_tasks = 16384;
/// Frames that may be in flight at once.
constexpr std::size_t max_frames = 256;
/// A message with as many bytes of pixels gets no more tiles.
constexpr std::size_t enough_bytes = 64u << 10;
/// Versions of a scene kept: the newest, and the one that frames still in flight may ask for.
constexpr std::size_t kept_versions = 2;
/// Updates whose blobs are looked for on disk at once, and scenes that wait to be written: a disk
/// that does not keep up is not waited for.
constexpr std::size_t max_reads = 256, max_writes = 4;

/// Runs `work`; returns what went wrong, or nothing.
template <class Work>
std::string error_of(Work work) {
    try {
        work();
        return {};
    } catch (const std::exception& error) {
        return error.what();
    }
}

}  // namespace

WorkerPools::WorkerPools(unsigned render_threads)
    : render(render_threads, max_tasks),
      scenes(1, max_frames),
      frames(1, 2 * max_frames),
      reads(1, max_reads),
      writes(1, max_writes) {}

Session::Session(std::shared_ptr<Connection> connection, WorkerPools& pools,
                 const RendererConfig& config, const BlobStore& known, std::shared_ptr<Relay> relay,
                 std::shared_ptr<BlobCache> cache)
    : connection_(std::move(connection)),
      executor_(connection_->executor()),
      pools_(pools),
      renderer_config_(config),
      relay_(std::move(relay)),
      cache_(std::move(cache)) {
    receiver_->know(known);
}

Session::~Session() {
    connection_->close();
    if (relay_) relay_->close();
    for (const auto& [number, frame] : frames_) frame->ended = true;
}

asio::awaitable<void> Session::run(const std::string& relay_token) {
    if (relay_)
        relay_->begin(relay_token, receiver_, connection_, [weak = weak_from_this()] {
            if (const auto self = weak.lock()) self->build_next_scene();
        });
    for (;;) {
        handle(co_await connection_->receive());
        while (const std::optional<Message> more = connection_->receive_now()) handle(*more);
    }
}

void Session::handle(const Message& message) {
    if (const auto* chunk = message.get<BlobChunk>()) {
        receiver_->add(*chunk, message.payload.bytes);
        if (relay_) relay_->arrived();
        return build_next_scene();
    }
    std::visit(
        [this](const auto& body) {
            if constexpr (requires { this->on(body); })
                on(body);
            else
                throw ProtocolError("sends a message that is not for workers");
        },
        message.body);
}

template <class Work, class Done>
void Session::run_in(ThreadPool& pool, Work work, Done done) {
    if (!try_run_in(pool, std::move(work), std::move(done)))
        throw ProtocolError("hands out more work than can wait");
}

template <class Work, class Done>
bool Session::try_run_in(ThreadPool& pool, Work work, Done done) {
    auto job = [weak = weak_from_this(), executor = executor_, work = std::move(work),
                done = std::move(done)] {
        auto result = work();
        asio::post(executor, [weak, done, result = std::move(result)]() mutable {
            const auto self = weak.lock();
            if (!self) return;
            try {
                done(*self, std::move(result));
            } catch (const ProtocolError& error) {
                self->connection_->close_for(error.what());
            }
        });
    };
    return pool.try_post(std::move(job));
}

// ---- Scenes -------------------------------------------------------------------------------------

void Session::on(const SceneUpdate& update) {
    const BlobRequest request = receiver_->update(update);
    tracers_[update.scene] = update.tracer;
    if (request.blobs.empty() || !look_on_disk(request)) connection_->send({request, {}});
    build_next_scene();
}

bool Session::look_on_disk(const BlobRequest& request) {
    if (!cache_) return false;
    return try_run_in(
        pools_.reads,
        [cache = cache_, &ending = pools_.ending, ids = request.blobs] {
            BlobStore found;
            for (const BlobId& id : ids) {
                if (ending) break;
                if (auto blob = cache->find(id)) found.insert(id, std::move(blob));
            }
            return found;
        },
        [request](Session& self, BlobStore found) {
            self.looked_on_disk(request, std::move(found));
        });
}

/// Asks for what was not there, if a scene still needs it.
void Session::looked_on_disk(const BlobRequest& request, BlobStore found) {
    if (found.size() > 0)
        spdlog::info("scene '{}': {} of {} meshes and textures, {:.1f} MB, are on disk",
                     request.scene, found.size(), request.blobs.size(),
                     1e-6 * double(found.bytes()));
    receiver_->supply(std::move(found));
    std::vector<BlobRequest> rest = receiver_->ask_again(request.blobs);
    if (rest.empty()) rest.push_back({.scene = request.scene, .blobs = {}});
    for (BlobRequest& next : rest) connection_->send({std::move(next), {}});
    if (relay_) relay_->arrived();
    build_next_scene();
}

/// Meshes and textures; shapes, of which every version may bring others, are not worth a disk.
void Session::keep_on_disk(const ReadyScene& ready) {
    if (!cache_) return;
    const Scene& scene = ready.scene->scene;
    std::set<BlobId> ids(scene.meshes.begin(), scene.meshes.end());
    ids.insert(scene.textures.begin(), scene.textures.end());
    std::vector<BlobId>& kept = kept_[ready.name];
    std::vector<BlobId> fresh;
    std::ranges::set_difference(ids, kept, std::back_inserter(fresh));
    if (fresh.empty()) return;
    const bool posted = pools_.writes.try_post(
        [cache = cache_, &ending = pools_.ending, fresh, blobs = ready.blobs] {
            for (const BlobId& id : fresh)
                if (ending || !cache->put(id, *blobs.find(id))) break;
        });
    if (posted) kept.assign(ids.begin(), ids.end());
}

void Session::on(const BlobSource& source) {
    if (!relay_) throw ProtocolError("names another worker to one that takes nothing from others");
    relay_->pull(source);
}

/// Versions that come faster than they can be built are left out: `receiver_` knows the newest.
void Session::build_next_scene() {
    if (building_) return;
    const auto scene = receiver_->take_ready();
    if (!scene) return;
    keep_on_disk(*scene);
    building_ = true;
    struct Built {
        std::shared_ptr<Renderer> renderer;
        std::string error;
    };
    run_in(
        pools_.scenes,
        [scene = *scene, tracer = tracers_[scene->name], config = renderer_config_,
         before = newest_renderer(scene->name)] {
            Built built;
            built.error = error_of([&] {
                built.renderer = std::make_shared<Renderer>(scene.scene->scene, scene.blobs, config,
                                                            before.get());
                built.renderer->prepare(tracer);
            });
            return built;
        },
        [scene = *scene](Session& self, Built built) {
            self.scene_built(scene, std::move(built.renderer), built.error);
        });
}

void Session::scene_built(const ReadyScene& scene, std::shared_ptr<Renderer> renderer,
                          const std::string& error) {
    building_ = false;
    const std::uint64_t version = scene.scene->version;
    if (!error.empty()) {
        fail(0, fmt::format("scene '{}' version {}: {}", scene.name, version, error));
    } else if (receiver_->find(scene.name)) {
        report_ready(scene.name, version, *renderer);
        std::deque<BuiltVersion>& versions = renderers_[scene.name];
        versions.push_back({version, std::move(renderer)});
        if (versions.size() > kept_versions) versions.pop_front();
    }
    build_next_scene();
}

void Session::report_ready(const std::string& scene, std::uint64_t version,
                           const Renderer& renderer) {
    spdlog::info("scene '{}' version {} is ready, {:.2f} s spent building", scene, version,
                 renderer.build_seconds());
    connection_->send({SceneReady{.scene = scene,
                                  .version = version,
                                  .build_seconds = renderer.build_seconds(),
                                  .modelled = renderer.plan().modelled,
                                  .left_out = renderer.plan().left_out},
                       {}});
}

void Session::on(const SceneDrop& drop) {
    receiver_->drop(drop.scene);
    tracers_.erase(drop.scene);
    kept_.erase(drop.scene);
    renderers_.erase(drop.scene);
}

std::shared_ptr<Renderer> Session::newest_renderer(const std::string& scene) const {
    const auto it = renderers_.find(scene);
    return it == renderers_.end() || it->second.empty() ? nullptr : it->second.back().renderer;
}

std::shared_ptr<Renderer> Session::find_renderer(const std::string& scene,
                                                 std::uint64_t version) const {
    const auto it = renderers_.find(scene);
    if (it == renderers_.end()) return nullptr;
    const auto built = std::find_if(it->second.rbegin(), it->second.rend(),
                                    [&](const BuiltVersion& b) { return b.version == version; });
    return built == it->second.rend() ? nullptr : built->renderer;
}

// ---- Frames -------------------------------------------------------------------------------------

void Session::on(const FrameBegin& begin) {
    const FrameSpec& spec = begin.spec;
    if (frames_.size() >= max_frames) throw ProtocolError("begins more frames than it ends");
    if (frames_.contains(spec.frame))
        throw ProtocolError(fmt::format("begins frame {} twice", spec.frame));
    const auto renderer = find_renderer(spec.scene, spec.version);
    if (!renderer)
        return fail(spec.frame,
                    fmt::format("scene '{}' version {} is not held", spec.scene, spec.version));
    const auto frame = std::make_shared<Frame>();
    frame->spec = spec;
    frame->renderer = renderer;
    frames_[spec.frame] = frame;
    run_in(
        pools_.frames,
        [frame] {
            return frame->ended ? std::string()
                                : error_of([&] { frame->renderer->begin_frame(frame->spec); });
        },
        [frame, built_before = frame->renderer->build_seconds()](Session& self,
                                                                 const std::string& error) {
            if (frame->renderer->build_seconds() != built_before)
                self.report_ready(frame->spec.scene, frame->spec.version, *frame->renderer);
            self.frame_ready(frame, error);
        });
}

void Session::frame_ready(const std::shared_ptr<Frame>& frame, const std::string& error) {
    if (frame->ended) return;
    if (!error.empty()) {
        frames_.erase(frame->spec.frame);
        return fail(frame->spec.frame, error);
    }
    frame->ready = true;
    for (const TileTask& task : std::exchange(frame->waiting, {})) render(frame, task);
}

void Session::on(const FrameEnd& end) {
    const auto it = frames_.find(end.frame);
    if (it == frames_.end()) return;
    const std::shared_ptr<Frame> frame = it->second;
    frames_.erase(it);
    frame->ended = true;
    run_in(
        pools_.frames,
        [frame] {
            frame->renderer->end_frame(frame->spec.frame);
            return true;
        },
        [](Session&, bool) {});
}

void Session::on(const TileTasks& tasks) {
    for (const TileTask& task : tasks.tasks) take(task);
}

void Session::take(const TileTask& task) {
    const auto it = frames_.find(task.frame);
    if (it == frames_.end()) {
        spdlog::debug("ignores tile {} of frame {}, which is not begun", task.tile, task.frame);
        return;
    }
    const std::shared_ptr<Frame>& frame = it->second;
    if (task.tile >= tile_count(frame->spec.size))
        throw ProtocolError(
            fmt::format("asks for tile {} of {}", task.tile, tile_count(frame->spec.size)));
    if (task.part > 0 && !can_be_cut(frame->spec.size, task.tile))
        throw ProtocolError(
            fmt::format("asks for a quarter of tile {}, which has none", task.tile));
    if (frame->ready) return render(frame, task);
    if (frame->waiting.size() >= max_tasks)
        throw ProtocolError("hands out more work than can wait");
    frame->waiting.push_back(task);
}

void Session::render(const std::shared_ptr<Frame>& frame, const TileTask& task) {
    run_in(
        pools_.render,
        [frame, task]() -> FinishedTile {
            auto result = frame->ended ? std::nullopt : frame->renderer->render(task);
            if (!result) return {};
            const ChannelSet channels = tile_channels(frame->spec);
            const auto pixels = result->data.size() / std::size_t(floats_per_pixel(channels));
            FinishedTile tile;
            tile.pixels = pack_tile(channels, pixels, result->data);
            tile.report.task = task;
            tile.report.rays = result->rays;
            tile.report.sanitised = result->sanitised;
            tile.report.seconds = result->seconds;
            tile.report.pixel_bytes = std::uint32_t(tile.pixels.size());
            tile.report.lights = std::move(result->lights);
            tile.report.active_lights = result->active_lights;
            return tile;
        },
        [frame](Session& self, FinishedTile tile) {
            if (tile.pixels.empty() || frame->ended) return;
            self.finished_.push_back(std::move(tile));
            if (std::exchange(self.sending_, true)) return;
            // Later, when what else is done already has been heard of.
            asio::post(self.executor_, [session = self.shared_from_this()] {
                asio::co_spawn(
                    session->executor_, [session] { return session->send_finished(); },
                    asio::detached);
            });
        });
}

asio::awaitable<void> Session::send_finished() {
    try {
        while (!finished_.empty()) {
            // In the bulk lane, so that answers to pings pass the pixels.
            connection_->send_bulk(take_finished());
            co_await connection_->wait_until_drained(0);
        }
    } catch (const boost::system::system_error&) {
        finished_.clear();  // run() hears of it, too
    }
    sending_ = false;
}

Message Session::take_finished() {
    TileResults results;
    const auto pixels = std::make_shared<Bytes>();
    while (!finished_.empty() && results.tiles.size() < max_tiles_together &&
           pixels->size() < enough_bytes) {
        const FinishedTile& tile = finished_.front();
        results.tiles.push_back(tile.report);
        pixels->insert(pixels->end(), tile.pixels.begin(), tile.pixels.end());
        finished_.pop_front();
    }
    return {std::move(results), {pixels, *pixels}};
}

void Session::on(const Ping& ping) {
    connection_->send({Pong{.stamp = ping.stamp,
                            .memory_bytes = resident_bytes(),
                            .relayed_bytes = relay_ ? relay_->bytes_sent() : 0},
                       {}});
}

void Session::fail(std::uint64_t frame, const std::string& reason) {
    spdlog::warn("{}", reason);
    connection_->send({Failure{.request = frame, .reason = reason}, {}});
}

}  // namespace tessera
