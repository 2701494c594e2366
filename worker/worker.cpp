#include "worker/worker.h"

#include <fmt/format.h>

#include <algorithm>
#include <random>
#include <utility>

#include "common/check.h"
#include "common/log.h"

namespace tessera {
namespace {

using namespace std::chrono_literals;

/// A server answers Hello at once.
constexpr auto handshake_deadline = 10s;

/// The server will never take this worker as it is.
struct RefusedError : UserError {
    using UserError::UserError;
};

/// Returns the server's token for relays.
asio::awaitable<std::string> shake_hands(Connection& connection, const WorkerConfig& config,
                                         std::uint16_t relay_port) {
    connection.send({Hello{.protocol = protocol_version,
                           .role = Role::worker,
                           .build = TESSERA_VERSION,
                           .token = config.credentials.token,
                           .name = config.name,
                           .threads = config.threads,
                           .relay_port = relay_port},
                     {}});
    const Message answer = co_await connection.receive(handshake_deadline);
    if (const auto* refused = answer.get<Refused>())
        throw RefusedError(fmt::format("{} refuses this worker: {}", connection.remote_address(),
                                       refused->reason));
    const auto* welcome = answer.get<Welcome>();
    if (!welcome) throw ProtocolError("answers Hello with neither Welcome nor Refused");
    spdlog::info("serves {} (version {}) as worker {}", connection.remote_address(), welcome->build,
                 welcome->peer);
    co_return welcome->relay_token;
}

}  // namespace

Worker::Worker(const WorkerConfig& config)
    : config_(config),
      cache_(config.blob_cache.empty()
                 ? nullptr
                 : std::make_shared<BlobCache>(config.blob_cache, config.blob_cache_bytes)),
      pools_(config.threads) {}

asio::awaitable<void> Worker::serve() {
    const auto connection = co_await connect(config_.server, config_.credentials.tls);
    const auto relay =
        config_.relays ? Relay::listen(*connection, config_.credentials.relay, config_.relay_port)
                       : nullptr;
    const std::string relay_token =
        co_await shake_hands(*connection, config_, relay ? relay->port() : std::uint16_t(0));
    failures_ = 0;
    const auto session = std::make_shared<Session>(
        connection, pools_, RendererConfig{int(config_.threads), config_.shaders},
        std::exchange(blobs_, {}), relay, cache_);
    session_ = session;
    if (leaving_) session->leave();
    try {
        co_await session->run(relay_token);
    } catch (...) {
        blobs_ = session->blobs();
        throw;
    }
}

bool Worker::leave() {
    leaving_ = true;
    const auto session = session_.lock();
    if (session) session->leave();
    return session != nullptr;
}

asio::awaitable<void> Worker::run() {
    asio::steady_timer timer(co_await asio::this_coro::executor);
    std::mt19937 random(std::random_device{}());
    const std::string server = config_.server.host + ":" + config_.server.port;
    for (;;) {
        std::string problem;
        try {
            co_await serve();
        } catch (const RefusedError&) {
            throw;
        } catch (const UserError& error) {
            problem = error.what();
        } catch (const ProtocolError& error) {
            problem = fmt::format("{} breaks the protocol: {}", server, error.what());
        } catch (const boost::system::system_error& error) {
            problem = fmt::format("{} is lost: {}", server, error.code().message());
        }
        if (leaving_) co_return;
        ++failures_;
        if (config_.attempts && failures_ >= *config_.attempts)
            throw UserError(fmt::format("{}; gave up after {} attempts", problem, failures_));
        const double u = std::generate_canonical<double, 32>(random);
        const auto delay = retry_delay(failures_ - 1, u);
        spdlog::warn("{}; tries again in {} ms", problem, delay.count());
        timer.expires_after(delay);
        co_await timer.async_wait(asio::use_awaitable);
    }
}

}  // namespace tessera
