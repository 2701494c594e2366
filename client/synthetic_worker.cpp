#include "client/synthetic_worker.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <future>
#include <map>
#include <optional>
#include <random>
#include <set>

#include "common/check.h"
#include "common/log.h"
#include "common/relay.h"

namespace tessera {
namespace {

/// Floats from which all tiles take their pixels: more than the caches nearest to a core hold.
constexpr std::size_t noise_floats = 1u << 18;
/// A message with as many bytes of pixels gets no more tiles.
constexpr std::size_t enough_bytes = 64u << 10;
/// Begins a channel without a palette (common/tile_codec.h).
constexpr std::byte plain_channel{32};

using Noise = std::vector<float>;

std::shared_ptr<const Noise> make_noise() {
    std::mt19937 random(1);
    std::uniform_real_distribution<float> uniform(0, 1);
    Noise noise(noise_floats);
    for (float& value : noise) value = uniform(random);
    return std::make_shared<const Noise>(std::move(noise));
}

/// What a tile takes, in units of the mean; the same in every frame.
double cost_of(const TileTask& task, double spread) {
    std::mt19937 random(task.tile);
    const double whole = std::lognormal_distribution<>(-spread * spread / 2, spread)(random);
    return task.part == 0 ? whole : whole / quarters;
}

/// Appends pixels that depend on tile and pass alone, and not on the number of the frame or on how
/// the tile is cut; packed, but no smaller for it.
std::uint32_t append_pixels(const FrameSpec& spec, const TileTask& task, const Noise& noise,
                            Bytes& out) {
    const Rect tile = tile_rect(spec.size, task.tile), part = rect_of(spec.size, task);
    const std::size_t begin = out.size();
    std::size_t from = (task.tile * 769u + task.first_pass * 131u) % (noise.size() / 2);
    for (int c = 0; c < channel_count; ++c) {
        if (!tile_channels(spec).has(Channel(c))) continue;
        const auto floats = std::size_t(floats_per_pixel(Channel(c)));
        out.push_back(plain_channel);
        for (int y = part.y0; y < part.y1; ++y) {
            const int first = (y - tile.y0) * tile.width() + part.x0 - tile.x0;
            const auto row = std::span(noise).subspan(from + floats * std::size_t(first),
                                                      floats * std::size_t(part.width()));
            const auto bytes = std::as_bytes(row);
            out.insert(out.end(), bytes.begin(), bytes.end());
        }
        from += floats * tile.pixels();
    }
    return std::uint32_t(out.size() - begin);
}

}  // namespace

class SyntheticWorkers::Worker : public std::enable_shared_from_this<Worker> {
public:
    Worker(const SyntheticConfig& config, int number, std::shared_ptr<const Noise> noise)
        : config_(config), number_(number), noise_(std::move(noise)), idle_(config.threads) {}

    asio::awaitable<void> run() {
        const auto self = shared_from_this();
        connection_ = co_await connect(config_.server, config_.credentials.tls);
        if (config_.relays) relay_ = Relay::listen(*connection_, config_.credentials.relay, 0);
        connection_->send({Hello{.role = Role::worker,
                                 .build = TESSERA_VERSION,
                                 .token = config_.credentials.token,
                                 .name = fmt::format("synthetic-{}", number_ + 1),
                                 .threads = config_.threads,
                                 .relay_port = relay_ ? relay_->port() : std::uint16_t(0)},
                           {}});
        for (;;) {
            handle(co_await connection_->receive());
            while (const std::optional<Message> more = connection_->receive_now()) handle(*more);
            if (hangs_) co_return;
        }
    }

    void kill() {
        if (connection_) connection_->close();
        if (relay_) relay_->close();
    }
    void hang() { hangs_ = true; }
    std::uint64_t results() const { return results_; }
    const Connection* connection() const { return connection_.get(); }

private:
    void handle(const Message& message) {
        if (const auto* tasks = message.get<TileTasks>()) {
            waiting_.insert(waiting_.end(), tasks->tasks.begin(), tasks->tasks.end());
            start();
            send_answers();
        } else if (const auto* begin = message.get<FrameBegin>()) {
            frames_[begin->spec.frame] = begin->spec;
        } else if (const auto* end = message.get<FrameEnd>()) {
            frames_.erase(end->frame);
        } else if (const auto* ping = message.get<Ping>()) {
            connection_->send(
                {Pong{.stamp = ping->stamp, .relayed_bytes = relay_ ? relay_->bytes_sent() : 0},
                 {}});
        } else if (const auto* welcome = message.get<Welcome>()) {
            if (relay_)
                relay_->begin(welcome->relay_token, receiver_, connection_,
                              [weak = weak_from_this()] {
                                  if (const auto self = weak.lock()) self->tell_if_whole();
                              });
        } else if (relay_ && keep(message)) {
            tell_if_whole();
        } else if (const auto* update = message.get<SceneUpdate>()) {
            ask_for_blobs(*update);
        } else if (const auto* chunk = message.get<BlobChunk>()) {
            if (chunk->offset + message.payload.bytes.size() == chunk->total) --blobs_missing_;
            tell_if_ready();
        } else if (const auto* refused = message.get<Refused>()) {
            throw UserError(refused->reason);
        }
    }

    /// Takes a message about scenes as a real worker does; returns whether it was one.
    bool keep(const Message& message) {
        if (const auto* update = message.get<SceneUpdate>()) {
            connection_->send({receiver_->update(*update), {}});
        } else if (const auto* chunk = message.get<BlobChunk>()) {
            receiver_->add(*chunk, message.payload.bytes);
            relay_->arrived();
        } else if (const auto* source = message.get<BlobSource>()) {
            relay_->pull(*source);
        } else if (const auto* drop = message.get<SceneDrop>()) {
            receiver_->drop(drop->scene);
        } else {
            return false;
        }
        return true;
    }

    void tell_if_whole() {
        while (const auto ready = receiver_->take_ready())
            connection_->send({SceneReady{.scene = ready->name,
                                          .version = ready->scene->version,
                                          .modelled = {},
                                          .left_out = {}},
                               {}});
    }

    /// All that the update brings anew: what is thrown away is asked for again when it comes back.
    void ask_for_blobs(const SceneUpdate& update) {
        std::set<BlobId> blobs;
        for (const auto* table :
             {&update.delta.meshes, &update.delta.textures, &update.delta.shapes})
            for (const auto& [index, blob] : table->changed) blobs.insert(blob);
        blobs_missing_ += blobs.size();
        updated_ = {update.scene, update.delta.next_version};
        connection_->send({BlobRequest{update.scene, {blobs.begin(), blobs.end()}}, {}});
        tell_if_ready();
    }

    void tell_if_ready() {
        if (blobs_missing_ > 0 || !updated_) return;
        connection_->send({SceneReady{.scene = updated_->first,
                                      .version = updated_->second,
                                      .modelled = {},
                                      .left_out = {}},
                           {}});
        updated_.reset();
    }

    void start() {
        while (idle_ > 0 && !waiting_.empty()) {
            const TileTask task = waiting_.front();
            waiting_.pop_front();
            const double seconds =
                config_.tile_seconds > 0 ? config_.tile_seconds * cost_of(task, config_.spread) : 0;
            if (seconds == 0) {
                answer(task, seconds);
                continue;
            }
            --idle_;
            const auto timer = std::make_shared<asio::steady_timer>(connection_->executor());
            timer->expires_after(std::chrono::duration_cast<std::chrono::steady_clock::duration>(
                std::chrono::duration<double>(seconds)));
            timer->async_wait([self = shared_from_this(), timer, task,
                               seconds](const boost::system::error_code&) {
                ++self->idle_;
                self->answer(task, seconds);
                self->start();
                self->send_answers();
            });
        }
    }

    void answer(const TileTask& task, double seconds) {
        const auto frame = frames_.find(task.frame);
        if (hangs_ || frame == frames_.end()) return;
        if (!pixels_) pixels_ = std::make_shared<Bytes>();
        const std::uint32_t bytes = append_pixels(frame->second, task, *noise_, *pixels_);
        answers_.tiles.push_back({.task = task, .seconds = float(seconds), .pixel_bytes = bytes});
        ++results_;
        if (pixels_->size() >= enough_bytes) send_answers();
    }

    void send_answers() {
        if (answers_.tiles.empty()) return;
        const auto pixels = std::exchange(pixels_, {});
        connection_->send_bulk({std::exchange(answers_, {}), {pixels, *pixels}});
    }

    SyntheticConfig config_;
    int number_;
    std::shared_ptr<const Noise> noise_;
    std::shared_ptr<Connection> connection_;
    std::shared_ptr<Relay> relay_;  ///< null: keeps nothing
    std::shared_ptr<SceneReceiver> receiver_ = std::make_shared<SceneReceiver>();
    std::map<std::uint64_t, FrameSpec> frames_;
    std::deque<TileTask> waiting_;
    std::size_t blobs_missing_ = 0;
    std::optional<std::pair<std::string, std::uint64_t>> updated_;  ///< scene that is not ready yet
    std::uint32_t idle_;
    TileResults answers_;            ///< not sent yet
    std::shared_ptr<Bytes> pixels_;  ///< of them
    std::uint64_t results_ = 0;
    bool hangs_ = false;
};

SyntheticWorkers::SyntheticWorkers(const SyntheticConfig& config) {
    const auto noise = make_noise();
    for (int i = 0; i < config.workers; ++i) {
        workers_.push_back(std::make_shared<Worker>(config, i, noise));
        asio::co_spawn(io_, workers_.back()->run(), [](std::exception_ptr failure) {
            try {
                if (failure) std::rethrow_exception(failure);
            } catch (const UserError& error) {
                spdlog::error("synthetic worker: {}", error.what());
            } catch (const std::exception& error) {
                spdlog::debug("synthetic worker: {}", error.what());
            }
        });
    }
    thread_ = std::thread([this] {
        const auto work = asio::make_work_guard(io_);
        io_.run();
    });
}

SyntheticWorkers::~SyntheticWorkers() {
    io_.stop();
    thread_.join();
}

template <class F>
auto SyntheticWorkers::ask(F f) {
    return asio::post(io_, std::packaged_task<decltype(f())()>(std::move(f))).get();
}

void SyntheticWorkers::kill(int worker) {
    ask([this, worker] { workers_.at(std::size_t(worker))->kill(); });
}

void SyntheticWorkers::hang(int worker) {
    ask([this, worker] { workers_.at(std::size_t(worker))->hang(); });
}

SyntheticTraffic SyntheticWorkers::traffic() {
    return ask([this] {
        SyntheticTraffic sum;
        for (const auto& worker : workers_) {
            sum.results += worker->results();
            if (!worker->connection()) continue;
            sum.bytes_in += worker->connection()->bytes_received();
            sum.bytes_out += worker->connection()->bytes_sent();
        }
        return sum;
    });
}

}  // namespace tessera
