#include "client/render_client.h"

#include <fmt/format.h>

#include <cstring>
#include <exception>
#include <random>
#include <utility>

#include "common/check.h"
#include "common/connection.h"
#include "common/jpeg.h"
#include "common/scene_sync.h"

namespace tessera {
namespace {

constexpr std::chrono::milliseconds tick_interval{100};

/// Collects the chunks of one channel; whatever a broken server sends stays inside the picture.
void place_chunk(const PictureChunk& chunk, std::span<const std::byte> bytes, ImageSize size,
                 RenderedFrame& frame) {
    const auto copy_to = [&](std::span<std::byte> whole) {
        if (chunk.total != whole.size() || chunk.offset > whole.size() ||
            bytes.size() > whole.size() - chunk.offset)
            throw ProtocolError("picture chunk does not fit the picture asked for");
        std::memcpy(whole.data() + chunk.offset, bytes.data(), bytes.size());
    };
    if (chunk.format == PictureFormat::srgb8) {
        frame.srgb8.resize(size.pixels() * 3);
        return copy_to(std::as_writable_bytes(std::span(frame.srgb8)));
    }
    if (chunk.components != 1 && chunk.components != 3)
        throw ProtocolError("picture chunk with neither 1 nor 3 components");
    Image& image = frame.channels[chunk.channel];
    if (image.data.empty()) image = Image(size, int(chunk.components));
    copy_to(std::as_writable_bytes(std::span(image.data)));
}

/// The newest picture of a view as its chunks arrive.
struct PictureAssembly {
    PictureChunk chunk;  ///< the last one
    Bytes bytes;

    void add(const PictureChunk& next, std::span<const std::byte> payload) {
        if (next.offset == 0) bytes.resize(next.total);
        if (next.total != bytes.size() || payload.size() > bytes.size() - next.offset)
            throw ProtocolError("picture chunks that do not belong together");
        chunk = next;
        std::memcpy(bytes.data() + next.offset, payload.data(), payload.size());
    }

    ShownPicture picture(const ViewPicture& about, bool keep_jpeg) const {
        const ImageSize size{int(chunk.width), int(chunk.height)};
        ShownPicture out{.about = about,
                         .shown = chunk.channel,
                         .size = size,
                         .srgb8 = {},
                         .linear = {},
                         .jpeg = {}};
        if (chunk.format == PictureFormat::jpeg && keep_jpeg) {
            out.jpeg = bytes;
        } else if (chunk.format == PictureFormat::jpeg) {
            out.srgb8 = decode_jpeg(bytes, size);
        } else if (chunk.format == PictureFormat::srgb8) {
            out.srgb8.resize(bytes.size());
            std::memcpy(out.srgb8.data(), bytes.data(), bytes.size());
        } else {
            out.linear = Image(size, int(chunk.components));
            std::memcpy(out.linear.data.data(), bytes.data(), bytes.size());
        }
        return out;
    }
};

/// One at a time: what a call that waits has asked for.
struct Rendering {
    FrameRequest request;
    std::function<void(const FrameProgress&)> progress;
    RenderedFrame frame;
    bool done = false;
};

}  // namespace

struct RenderClient::State {
    RenderClientConfig config;
    asio::io_context io;
    std::shared_ptr<Connection> connection;
    std::uint64_t connections = 0;  ///< that the server has let in
    bool connected = false;
    std::map<std::uint64_t, View> views;      ///< to be shown again
    std::optional<std::exception_ptr> ended;  ///< why nothing more will arrive
    std::optional<Welcome> welcome;
    std::uint64_t last_request = std::uint64_t(1) << 32;  ///< views have the numbers below

    // What has arrived and was not taken.
    std::vector<std::string> failures, complaints;
    std::optional<Status> status;
    std::optional<EditResult> edited;
    bool uploaded = false;
    Rendering rendering;
    SavedSums arriving;
    std::optional<SavedSums> sums;
    std::map<std::uint64_t, PictureAssembly> assemblies;
    std::optional<ShownPicture> picture;

    const SceneBundle* uploading = nullptr;
    std::string watched;
    SceneVersion scene;
    SceneReceiver blobs;

    // ---- Receiving ----

    void start() {
        asio::co_spawn(io, serve(), [this](std::exception_ptr error) { ended = error; });
    }

    asio::awaitable<void> serve() {
        std::minstd_rand random(std::random_device{}());
        asio::steady_timer pause(io);
        for (unsigned attempts = 0;; ++attempts) {
            const std::exception_ptr lost = co_await serve_once();
            if (!config.reconnects || connections == 0) std::rethrow_exception(lost);
            if (std::exchange(connected, false)) {
                attempts = 0;
                complaints.push_back(
                    fmt::format("lost the server at {}: connects again", config.address));
            }
            pause.expires_after(retry_delay(attempts, std::generate_canonical<double, 32>(random)));
            co_await pause.async_wait(asio::use_awaitable);
        }
    }

    /// One connection; returns how it was lost, or could not be had. Throws what is for good.
    asio::awaitable<std::exception_ptr> serve_once() {
        bool reached = false;
        try {
            connection = co_await connect(parse_address(config.address), config.credentials.tls);
            reached = true;
            connection->send({Hello{.role = Role::viewer,
                                    .build = TESSERA_VERSION,
                                    .token = config.credentials.token,
                                    .name = "tessera"},
                              {}});
            for (;;) handle(co_await connection->receive());
        } catch (const boost::system::system_error&) {
            co_return std::current_exception();
        } catch (const UserError&) {
            if (reached) throw;
            co_return std::current_exception();
        }
    }

    void handle(const Message& message) {
        std::visit(
            [&](const auto& body) {
                if constexpr (requires { this->on(body, message.payload.bytes); })
                    on(body, message.payload.bytes);
                else if constexpr (requires { this->on(body); })
                    on(body);
            },
            message.body);
    }

    void on(const Welcome& body) {
        welcome = body;
        connected = true;
        if (++connections == 1) return;
        // Say again what the server has forgotten.
        complaints.push_back(fmt::format("connected to {} again", config.address));
        assemblies.clear();
        blobs = SceneReceiver();
        if (!watched.empty()) connection->send({SceneWatch{watched}, {}});
        for (const auto& [number, view] : views) {
            assemblies.try_emplace(number);
            connection->send({view, {}});
        }
    }
    void on(const Refused& body) {
        throw UserError(fmt::format("the server at {} refuses: {}", config.address, body.reason));
    }
    void on(const Ping& body) { connection->send({Pong{.stamp = body.stamp}, {}}); }
    void on(const Failure& body) {
        (assemblies.contains(body.request) ? complaints : failures).push_back(body.reason);
    }
    void on(const Status& body) { status = body; }
    void on(const EditResult& body) {
        complaints.insert(complaints.end(), body.complaints.begin(), body.complaints.end());
        edited = body;
    }
    void on(const SceneReady&) { uploaded = true; }
    void on(const BlobRequest& body) {
        if (uploading)
            asio::co_spawn(io, send_blobs(connection, uploading->blobs, body.blobs),
                           [this](std::exception_ptr error) {
                               if (error) connection->close();
                           });
    }
    void on(const SceneUpdate& body) {
        if (body.scene != watched) return;
        try {
            scene = apply(body.delta.base_version == 0 ? SceneVersion{} : scene, body.delta);
        } catch (const std::runtime_error& error) {
            throw ProtocolError(error.what());
        }
    }
    void on(const BlobChunk& body, std::span<const std::byte> bytes) { blobs.add(body, bytes); }
    void on(const FrameProgress& body) {
        if (body.request == rendering.request.request) rendering.progress(body);
    }
    void on(const PictureChunk& body, std::span<const std::byte> bytes) {
        if (const auto view = assemblies.find(body.request); view != assemblies.end())
            view->second.add(body, bytes);
        else if (body.request == rendering.request.request)
            place_chunk(body, bytes, rendering.request.spec.size, rendering.frame);
    }
    void on(const ViewPicture& body) {
        const auto view = assemblies.find(body.request);
        if (view == assemblies.end() || view->second.bytes.empty()) return;
        try {
            picture = view->second.picture(body, config.keep_jpeg);
        } catch (const std::runtime_error& error) {
            throw ProtocolError(error.what());
        }
    }
    void on(const SumsChunk& body, std::span<const std::byte> bytes) {
        if (body.request != rendering.request.request) return;
        if (body.offset == 0) arriving = {};
        if (body.offset != arriving.sums.size())
            throw ProtocolError("sums that do not come in order");
        arriving.sums.insert(arriving.sums.end(), bytes.begin(), bytes.end());
        arriving.render_seconds = body.render_seconds;
        arriving.rays = body.rays;
        if (arriving.sums.size() == body.total) sums = std::exchange(arriving, {});
    }
    void on(const FrameDone& body) {
        if (body.request != rendering.request.request) return;
        rendering.frame.statistics = body.statistics;
        rendering.done = true;
    }

    // ---- Waiting ----

    /// Runs the network for a while: until something has happened and nothing more is there.
    void run_for(std::chrono::milliseconds time) {
        io.restart();
        io.run_one_for(time);
        io.poll();
        config.tick();
        if (ended) rethrow(*ended);
    }

    [[noreturn]] void rethrow(std::exception_ptr error) {
        try {
            std::rethrow_exception(error);
        } catch (const boost::system::system_error& lost) {
            // The embedded server's own end says more than the connection's.
            config.tick();
            throw UserError(
                fmt::format("lost the server at {}: {}", config.address, lost.code().message()));
        } catch (const ProtocolError& broken) {
            throw UserError(fmt::format("the server at {} broke the protocol: {}", config.address,
                                        broken.what()));
        }
    }

    /// Throws UserError when the server says that what was asked for cannot be done, ServerLost
    /// when it is another connection by now.
    template <class Condition>
    void wait_until(const Condition& condition) {
        const std::uint64_t asked_of = connections;
        while (!condition()) {
            run_for(tick_interval);
            if (asked_of != 0 && connections != asked_of)
                throw ServerLost(
                    fmt::format("the server at {} was lost and is back", config.address));
            if (failures.empty()) continue;
            const std::string reason = failures.front();
            failures.clear();
            throw UserError(reason);
        }
    }

    /// Does what can as well be done twice, again if need be.
    template <class Ask>
    auto persist(const Ask& ask) {
        for (;;) {
            try {
                return ask();
            } catch (const ServerLost&) {
                failures.clear();
            }
        }
    }

    /// Sums follow their request as fast as the server reads.
    asio::awaitable<void> send_sums(std::uint64_t request, std::shared_ptr<const Bytes> bytes) {
        SumsChunk chunk{.request = request, .offset = 0, .total = bytes->size()};
        while (chunk.offset < chunk.total) {
            const std::size_t size = std::min<std::size_t>(chunk_bytes, chunk.total - chunk.offset);
            co_await connection->wait_until_drained(chunk_bytes);
            connection->send_bulk({chunk, {bytes, std::span(*bytes).subspan(chunk.offset, size)}});
            chunk.offset += size;
        }
    }

    /// The server answers in order: failures of what was sent before are here by then.
    Status ask_status() {
        status.reset();
        connection->send({StatusRequest{}, {}});
        wait_until([&] { return status.has_value(); });
        return *std::exchange(status, {});
    }
};

RenderClient::RenderClient(const RenderClientConfig& config) : state_(std::make_unique<State>()) {
    state_->config = config;
    state_->start();
    state_->wait_until([&] { return state_->welcome.has_value(); });
}

RenderClient::~RenderClient() {
    // Lets the coroutines come to their ends while all they use is there.
    if (!state_->connection) return;
    state_->config.reconnects = false;
    state_->connection->close();
    state_->io.restart();
    state_->io.poll();
}

bool RenderClient::connected() const { return state_->connected; }

const Welcome& RenderClient::welcome() const { return *state_->welcome; }

void RenderClient::upload_scene(const std::string& name, const SceneBundle& bundle) {
    const SceneVersion version{.version = 1, .scene = bundle.scene};
    state_->uploading = &bundle;
    state_->persist([&] {
        state_->uploaded = false;
        state_->connection->send(
            {SceneUpdate{.scene = name, .delta = diff(SceneVersion{}, version)}, {}});
        state_->wait_until([&] { return state_->uploaded; });
    });
    state_->uploading = nullptr;
}

RenderedFrame RenderClient::render(const FrameRequest& request,
                                   const std::function<void(const FrameProgress&)>& progress,
                                   const SavedSums& begun) {
    state_->rendering = {.request = request, .progress = progress, .frame = {}};
    state_->rendering.request.request = ++state_->last_request;
    state_->rendering.request.sums_bytes = begun.sums.size();
    state_->sums.reset();
    state_->connection->send({state_->rendering.request, {}});
    asio::co_spawn(state_->io,
                   state_->send_sums(state_->rendering.request.request,
                                     std::make_shared<const Bytes>(begun.sums)),
                   asio::detached);
    state_->wait_until([&] { return state_->rendering.done; });
    return std::move(state_->rendering.frame);
}

void RenderClient::ask_sums() {
    state_->connection->send({FrameSave{state_->rendering.request.request}, {}});
}

std::optional<SavedSums> RenderClient::take_sums() { return std::exchange(state_->sums, {}); }

Status RenderClient::status() {
    return state_->persist([&] { return state_->ask_status(); });
}

void RenderClient::share_scene(const std::string& name) {
    state_->connection->send({SceneShare{name}, {}});
    state_->ask_status();
}

void RenderClient::watch(const std::string& scene) {
    state_->watched = scene;
    state_->scene = {};
    state_->connection->send({SceneWatch{scene}, {}});
    // A connection that is new watches by itself.
    state_->persist([&] { state_->wait_until([&] { return state_->scene.version > 0; }); });
}

const SceneVersion& RenderClient::scene() const { return state_->scene; }

EditResult RenderClient::edit(const std::string& scene,
                              const std::vector<EditOperation>& operations,
                              const BlobStore& blobs) {
    state_->persist([&] {
        state_->edited.reset();
        send_edit(scene, operations, blobs);
        state_->wait_until(
            [&] { return state_->edited && state_->edited->request == state_->last_request; });
    });
    state_->complaints.clear();
    return *std::exchange(state_->edited, {});
}

BlobStore RenderClient::fetch_blobs(const std::string& scene, const std::vector<BlobId>& blobs) {
    // A scene of nothing but these, so that the receiver knows what to wait for.
    SceneVersion wanted{.version = 1, .scene = {}};
    wanted.scene.meshes = blobs;
    return state_->persist([&] {
        BlobRequest request =
            state_->blobs.update({.scene = scene, .delta = diff(SceneVersion{}, wanted)});
        state_->connection->send({std::move(request), {}});
        std::optional<ReadyScene> ready;
        state_->wait_until([&] {
            ready = state_->blobs.take_ready();
            return ready.has_value();
        });
        return ready->blobs;
    });
}

void RenderClient::poll(std::chrono::milliseconds patience) {
    state_->run_for(patience);
    state_->complaints.insert(state_->complaints.end(), state_->failures.begin(),
                              state_->failures.end());
    state_->failures.clear();
}

void RenderClient::wait_until(std::chrono::steady_clock::time_point time) {
    using namespace std::chrono;
    while (steady_clock::now() < time)
        poll(std::clamp(ceil<milliseconds>(time - steady_clock::now()), milliseconds(0),
                        tick_interval));
}

void RenderClient::wake() {
    asio::post(state_->io, [] {});
}

void RenderClient::show(const View& view) {
    state_->assemblies.try_emplace(view.request);
    state_->views[view.request] = view;
    state_->connection->send({view, {}});
}

std::optional<ShownPicture> RenderClient::take_picture() {
    return std::exchange(state_->picture, {});
}

void RenderClient::send_edit(const std::string& scene, std::vector<EditOperation> operations,
                             const BlobStore& blobs) {
    if (!state_->connected) state_->complaints.push_back("not connected: the change is lost");
    SceneEdit edit{++state_->last_request, scene, std::move(operations)};
    const auto payload = std::make_shared<Bytes>();
    for (const EditOperation& operation : edit.operations) {
        const auto named = blob_of(operation);
        const auto blob = named ? blobs.find(*named) : nullptr;
        if (!blob) continue;
        edit.blob_bytes.push_back(blob->size());
        payload->insert(payload->end(), blob->begin(), blob->end());
    }
    if (payload->size() > max_payload_bytes)
        throw UserError(fmt::format("meshes of one edit take {} MB, it carries {} at most",
                                    payload->size() >> 20, max_payload_bytes >> 20));
    state_->connection->send({std::move(edit), {payload, *payload}});
}

void RenderClient::ask_status() { state_->connection->send({StatusRequest{}, {}}); }

std::optional<Status> RenderClient::take_status() { return std::exchange(state_->status, {}); }

std::vector<std::string> RenderClient::take_complaints() {
    return std::exchange(state_->complaints, {});
}

}  // namespace tessera
