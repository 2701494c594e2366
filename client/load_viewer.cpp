#include "client/load_viewer.h"

#include <algorithm>
#include <cstring>

#include "common/check.h"
#include "common/clock.h"
#include "common/scene_sync.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

std::uint64_t different_pixels(const std::vector<std::uint8_t>& a,
                               const std::vector<std::uint8_t>& b) {
    if (a.size() != b.size()) return std::max(a.size(), b.size()) / 3;
    if (std::memcmp(a.data(), b.data(), a.size()) == 0) return 0;
    std::uint64_t different = 0;
    for (std::size_t i = 0; i < a.size(); i += 3) different += std::memcmp(&a[i], &b[i], 3) != 0;
    return different;
}

}  // namespace

asio::awaitable<Message> LoadViewer::receive() {
    for (;;) {
        Message message = co_await connection_->receive();
        if (const auto* failure = message.get<Failure>()) throw UserError(failure->reason);
        if (const auto* refused = message.get<Refused>()) throw UserError(refused->reason);
        if (const auto* ping = message.get<Ping>())
            connection_->send({Pong{ping->stamp}, {}});
        else
            co_return message;
    }
}

asio::awaitable<void> LoadViewer::run(const SceneBundle& bundle) {
    const auto self = shared_from_this();
    connection_ = co_await connect(parse_address(config_.address), config_.credentials.tls);
    connection_->send({Hello{.role = Role::viewer,
                             .build = TESSERA_VERSION,
                             .token = config_.credentials.token,
                             .name = "load",
                             .threads = 0},
                       {}});
    const SceneVersion uploaded{.version = 1, .scene = bundle.scene};
    connection_->send({SceneUpdate{.scene = script_->views.front().spec.scene,
                                   .delta = diff(SceneVersion{}, uploaded)},
                       {}});
    for (;;) {
        const Message message = co_await receive();
        if (const auto* request = message.get<BlobRequest>())
            co_await send_blobs(connection_, bundle.blobs, request->blobs);
        else if (message.get<SceneReady>())
            for (unsigned i = 0; i < in_flight_; ++i) ask();
        else if (const auto* chunk = message.get<PictureChunk>())
            place(*chunk, message.payload.bytes);
        else if (const auto* done = message.get<FrameDone>())
            finish(done->request);
    }
}

void LoadViewer::stop() {
    in_flight_ = 0;
    if (connection_) connection_->close();
}

void LoadViewer::ask() {
    Pending pending;
    pending.view = next_view_++ % script_->views.size();
    pending.frame.asked = Clock::now();
    FrameRequest request = script_->views[pending.view];
    request.request = ++last_request_;
    connection_->send({request, {}});
    pending_[request.request] = std::move(pending);
}

void LoadViewer::place(const PictureChunk& chunk, std::span<const std::byte> bytes) {
    const auto found = pending_.find(chunk.request);
    if (found == pending_.end() || chunk.channel != Channel::radiance) return;
    Pending& pending = found->second;
    if (!pending.begun) pending.frame.first = seconds_since(pending.frame.asked);
    pending.begun = true;
    pending.pixels.resize(chunk.total);
    std::memcpy(pending.pixels.data() + chunk.offset, bytes.data(), bytes.size());
}

void LoadViewer::finish(std::uint64_t request) {
    const auto found = pending_.find(request);
    if (found == pending_.end()) return;
    Pending& pending = found->second;
    pending.frame.done = Clock::now();
    pending.frame.final = seconds_since(pending.frame.asked);
    pending.frame.wrong_pixels = different_pixels(pending.pixels, script_->expected[pending.view]);
    frames_.push_back(pending.frame);
    pending_.erase(found);
    if (in_flight_ > 0) ask();
}

}  // namespace tessera
