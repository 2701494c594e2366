#include "client/render_client.h"

#include <fmt/format.h>

#include <cstring>
#include <exception>

#include "common/check.h"
#include "common/connection.h"
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

}  // namespace

struct RenderClient::State {
    RenderClientConfig config;
    asio::io_context io;
    std::shared_ptr<Connection> connection;
    Welcome welcome;
    std::uint64_t last_request = 0;

    /// Runs the network until `work` is done, with a tick in between.
    void wait_for(asio::awaitable<void> work) {
        bool finished = false;
        std::exception_ptr failure;
        asio::co_spawn(io, std::move(work), [&](std::exception_ptr error) {
            finished = true;
            failure = error;
        });
        while (!finished) {
            io.restart();
            io.run_one_for(tick_interval);
            io.poll();
            config.tick();
        }
        if (!failure) return;
        try {
            std::rethrow_exception(failure);
        } catch (const boost::system::system_error& error) {
            // The embedded server's own end says more than the connection's.
            config.tick();
            throw UserError(
                fmt::format("lost the server at {}: {}", config.address, error.code().message()));
        } catch (const ProtocolError& error) {
            throw UserError(fmt::format("the server at {} broke the protocol: {}", config.address,
                                        error.what()));
        }
    }

    /// The next message that is about this client's work; failures become UserError.
    asio::awaitable<Message> receive() {
        for (;;) {
            Message message = co_await connection->receive();
            if (const auto* ping = message.get<Ping>()) {
                connection->send({Pong{.stamp = ping->stamp}, {}});
                continue;
            }
            if (const auto* failure = message.get<Failure>()) throw UserError(failure->reason);
            if (const auto* refused = message.get<Refused>())
                throw UserError(
                    fmt::format("the server at {} refuses: {}", config.address, refused->reason));
            co_return message;
        }
    }

    asio::awaitable<void> shake_hands() {
        connection = co_await connect(parse_address(config.address), config.credentials.tls);
        connection->send({Hello{.role = Role::viewer,
                                .build = TESSERA_VERSION,
                                .token = config.credentials.token,
                                .name = "tessera"},
                          {}});
        const Message answer = co_await receive();
        if (!answer.get<Welcome>()) throw ProtocolError("no welcome after the hello");
        welcome = *answer.get<Welcome>();
    }

    asio::awaitable<void> upload(const std::string& name, const SceneBundle& bundle) {
        const SceneVersion uploaded{.version = 1, .scene = bundle.scene};
        connection->send({SceneUpdate{.scene = name, .delta = diff(SceneVersion{}, uploaded)}, {}});
        for (;;) {
            const Message message = co_await receive();
            if (const auto* request = message.get<BlobRequest>())
                co_await send_blobs(connection, bundle.blobs, request->blobs);
            else if (message.get<SceneReady>())
                co_return;
        }
    }

    asio::awaitable<void> render(const FrameRequest& request,
                                 const std::function<void(const FrameProgress&)>& progress,
                                 RenderedFrame& frame) {
        connection->send({request, {}});
        for (;;) {
            const Message message = co_await receive();
            if (const auto* report = message.get<FrameProgress>()) {
                progress(*report);
            } else if (const auto* chunk = message.get<PictureChunk>()) {
                place_chunk(*chunk, message.payload.bytes, request.spec.size, frame);
            } else if (const auto* done = message.get<FrameDone>()) {
                frame.statistics = done->statistics;
                co_return;
            }
        }
    }

    asio::awaitable<void> ask_status(Status& status) {
        connection->send({StatusRequest{}, {}});
        for (;;) {
            const Message message = co_await receive();
            if (!message.get<Status>()) continue;
            status = *message.get<Status>();
            co_return;
        }
    }
};

RenderClient::RenderClient(const RenderClientConfig& config) : state_(std::make_unique<State>()) {
    state_->config = config;
    state_->wait_for(state_->shake_hands());
}

RenderClient::~RenderClient() = default;

const Welcome& RenderClient::welcome() const { return state_->welcome; }

void RenderClient::upload_scene(const std::string& name, const SceneBundle& bundle) {
    state_->wait_for(state_->upload(name, bundle));
}

RenderedFrame RenderClient::render(const FrameRequest& request,
                                   const std::function<void(const FrameProgress&)>& progress) {
    FrameRequest numbered = request;
    numbered.request = ++state_->last_request;
    RenderedFrame frame;
    state_->wait_for(state_->render(numbered, progress, frame));
    return frame;
}

Status RenderClient::status() {
    Status status;
    state_->wait_for(state_->ask_status(status));
    return status;
}

}  // namespace tessera
