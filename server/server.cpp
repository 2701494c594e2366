#include "server/server.h"

#include <fmt/format.h>

#include <utility>

#include "common/check.h"
#include "common/clock.h"
#include "common/log.h"
#include "common/process.h"

namespace tessera {
namespace {

using boost::system::error_code;
using Clock = std::chrono::steady_clock;

/// Pause after a failed accept: file handles may be free again by then.
constexpr auto accept_pause = std::chrono::milliseconds(100);

std::string describe(const tcp::endpoint& endpoint) {
    const bool is_ipv6 = endpoint.address().is_v6();
    return fmt::format(fmt::runtime(is_ipv6 ? "[{}]:{}" : "{}:{}"), endpoint.address().to_string(),
                       endpoint.port());
}

tcp::endpoint resolve(asio::io_context& io, const std::string& listen) {
    const Address address = parse_address(listen);
    error_code error;
    const auto found =
        tcp::resolver(io).resolve(address.host, address.port, tcp::resolver::passive, error);
    if (error || found.empty())
        throw UserError(fmt::format("--listen {}: {}; name an address of this machine", listen,
                                    error.message()));
    return found.begin()->endpoint();
}

/// Opens the port.
void listen_on(tcp::acceptor& acceptor, const tcp::endpoint& endpoint) {
    error_code error;
    const auto check = [&](const char* advice) {
        if (error)
            throw UserError(
                fmt::format("--listen {}: {}; {}", describe(endpoint), error.message(), advice));
    };
    acceptor.open(endpoint.protocol(), error);
    check("choose another address");
    acceptor.set_option(tcp::acceptor::reuse_address(true));
    acceptor.bind(endpoint, error);
    check("is a server running there already? Choose another port, or 0 for any free one");
    acceptor.listen(asio::socket_base::max_listen_connections, error);
    check("choose another port, or 0 for any free one");
}

/// Compares with every token, so that the time tells nothing.
std::optional<Grant> grant_of(const std::string& token, const ServerKeys& keys) {
    std::optional<Grant> out;
    for (const auto& [known, grant] : keys.tokens)
        if (same_token(token, known)) out = grant;
    return out;
}

/// Runs a session to its end. Whatever a peer does wrong ends here, with its own session.
template <class Session>
asio::awaitable<void> hold_session(std::shared_ptr<Session> session, asio::awaitable<void> run,
                                   RenderFarm& farm) {
    try {
        co_await std::move(run);
    } catch (const ProtocolError& error) {
        spdlog::warn("{} is dropped: it {}", session->description(), error.what());
        session->dismiss(error.what());
    } catch (const boost::system::system_error& error) {
        spdlog::info("{} leaves: {}", session->description(), error.code().message());
    } catch (const std::exception& error) {
        spdlog::error("{} is dropped: {}", session->description(), error.what());
    }
    session->leave(farm);
}

}  // namespace

Server::Server(asio::io_context& io, const ServerConfig& config)
    : config_(config),
      io_(io),
      acceptor_(io),
      started_(Clock::now()),
      farm_(io.get_executor(), config.fold_threads, config.trace, config.relays),
      relay_token_(config.relays == RelayMode::off ? "" : random_token()) {
    const tcp::endpoint endpoint = resolve(io, config.listen);
    if (!config.keys.empty()) keys_ = load_server_keys(config.keys);
    if (!keys_ && !endpoint.address().is_loopback())
        throw UserError(fmt::format(
            "--listen {}: without keys everybody who reaches this address could use the server and "
            "read what it sends; make some with `tessera keys FOLDER` and give this server "
            "--keys FOLDER/server, or listen on 127.0.0.1",
            config.listen));
    listen_on(acceptor_, endpoint);
    writer_.emplace(scenes_, farm_,
                    config.journal.empty() ? nullptr : std::make_unique<Journal>(config.journal));
    if (!config.metrics.empty()) metrics_.emplace(io, config.metrics, [this] { return status(); });
}

void Server::add_scene(const std::string& name, const SceneBundle& bundle) {
    if (const std::string objection = objection_to_scene(config_.limits, bundle);
        !objection.empty())
        throw UserError(fmt::format("{}: {}", name, objection));
    writer_->open_now(name, bundle);
}

std::string Server::address() const { return describe(acceptor_.local_endpoint()); }

void Server::start() { asio::co_spawn(io_, accept_peers(), asio::detached); }

void Server::stop() {
    error_code ignored;
    acceptor_.close(ignored);
    if (metrics_) metrics_->stop();
    farm_.stop();
    for (const auto& [id, connection] : connections_) connection->close();
}

asio::awaitable<void> Server::accept_peers() {
    while (acceptor_.is_open()) {
        error_code error;
        tcp::socket socket =
            co_await acceptor_.async_accept(asio::redirect_error(asio::use_awaitable, error));
        if (!acceptor_.is_open()) break;
        if (error) {
            spdlog::error("cannot accept a connection: {}", error.message());
            asio::steady_timer pause(io_, accept_pause);
            co_await pause.async_wait(asio::use_awaitable);
        } else if (strangers_ < config_.limits.handshakes) {
            asio::co_spawn(io_, serve(std::move(socket)), asio::detached);
        } else {
            turn_away(std::move(socket));
        }
    }
}

/// Costs no memory and no wait. Who expects TLS takes being hung up on for the same.
void Server::turn_away(tcp::socket socket) {
    if (keys_) return;
    const EncodedMessage words =
        encode({Refused{fmt::format("the server is busy with {} newcomers; try again in a while "
                                    "(--max-handshakes)",
                                    config_.limits.handshakes)},
                {}});
    error_code ignored;
    socket.non_blocking(true, ignored);
    socket.write_some(asio::buffer(words.head), ignored);
}

/// One peer from its first byte to its last.
asio::awaitable<void> Server::serve(tcp::socket socket) {
    const auto connection = std::make_shared<Connection>(
        std::move(socket), ConnectionConfig{},
        FrameLimits{.message_bytes = max_hello_bytes, .payload_bytes = 0});
    const std::uint64_t peer = ++last_peer_;
    connections_[peer] = connection;
    ++strangers_;
    std::optional<Hello> hello;
    try {
        hello = co_await handshake(connection);
    } catch (const std::exception& error) {
        spdlog::info("{} is not let in: {}", connection->remote_address(), error.what());
    }
    --strangers_;
    if (hello) {
        connection->admit({.message_bytes = config_.limits.message_bytes,
                           .option = "the server's --max-message"});
        connection->send({Welcome{peer, TESSERA_VERSION, scenes_.open_names(),
                                  hello->role == Role::worker ? relay_token_ : ""},
                          {}});
        if (hello->role == Role::worker) {
            const auto worker = std::make_shared<WorkerSession>(peer, *hello, connection);
            co_await hold_session(worker, worker->run(farm_), farm_);
        } else {
            ++viewers_;
            const auto viewer = std::make_shared<ViewerSession>(
                *hello, connection, may_edit(*hello), config_.limits, [this] { return status(); });
            co_await hold_session(viewer, viewer->run(farm_, scenes_, *writer_), farm_);
            --viewers_;
        }
    }
    connections_.erase(peer);
}

/// Throws when the peer is not to be let in; it then knows why.
asio::awaitable<Hello> Server::handshake(std::shared_ptr<Connection> connection) {
    // Bounds the whole handshake, also for a peer that sends byte by byte.
    asio::steady_timer deadline(io_, config_.handshake_deadline);
    deadline.async_wait([weak = std::weak_ptr(connection)](const error_code& cancelled) {
        const auto self = weak.lock();
        if (!cancelled && self) self->close();
    });
    const bool secured = keys_ && co_await connection->peer_begins_tls();
    if (secured) co_await connection->secure(*keys_->tls);
    const Message message = co_await connection->receive(config_.handshake_deadline);
    const auto* hello = message.get<Hello>();
    if (!hello) throw ProtocolError("does not say hello first");
    const std::string reason = keys_ && !secured
                                   ? "this server speaks TLS; give --keys FOLDER or set "
                                     "TESSERA_KEYS, with keys that its operator hands out"
                                   : objection(*hello, connection->peer_name());
    if (reason.empty()) co_return *hello;
    connection->send({Refused{reason}, {}});
    co_await connection->close_when_sent();
    throw ProtocolError(reason);
}

/// Why the peer is not let in, as a sentence for its user; empty when it is.
std::string Server::objection(const Hello& hello, const std::string& peer_name) const {
    if (hello.protocol != protocol_version)
        return fmt::format(
            "it speaks protocol version {} (build {}), this server version {} (build {}); install "
            "the same release on both",
            hello.protocol, hello.build, protocol_version, TESSERA_VERSION);
    if (const std::string reason = objection_to_token(hello, peer_name); !reason.empty())
        return reason;
    if (connections_.size() - strangers_ >= config_.limits.sessions)
        return fmt::format("the server is full with {} sessions; try again later (--max-sessions)",
                           config_.limits.sessions);
    return {};
}

std::string Server::objection_to_token(const Hello& hello, const std::string& peer_name) const {
    if (!keys_) {
        const bool right = config_.token.empty() || same_token(hello.token, config_.token);
        return right ? "" : "wrong token; set TESSERA_TOKEN to the same value as on the server";
    }
    const std::optional<Grant> grant = grant_of(hello.token, *keys_);
    if (!grant)
        return "wrong token; use a folder of the same `tessera keys` as the server's, for --keys";
    const bool works = hello.role == Role::worker;
    if (works != (*grant == Grant::worker))
        return fmt::format("its token is for a {}, and it comes as a {}; use the keys of its role",
                           grant_names[int(*grant)], works ? "worker" : "viewer");
    if (works && peer_name != worker_common_name)
        return "it shows no worker's certificate; use the folder `worker` that `tessera keys` made";
    return {};
}

bool Server::may_edit(const Hello& hello) const {
    return !keys_ || grant_of(hello.token, *keys_) == Grant::editor;
}

Status Server::status() const {
    Status out{.build = TESSERA_VERSION,
               .uptime_seconds = seconds_since(started_),
               .viewers = viewers_,
               .frames_in_flight = farm_.frames_in_flight(),
               .frames_done = farm_.frames_done(),
               .scenes = {},
               .workers = farm_.worker_status(),
               .memory_bytes = resident_bytes(),
               .worker_bytes = farm_.worker_bytes()};
    for (const ScenePtr& scene : scenes_.all())
        out.scenes.push_back({.name = scene->now.name,
                              .version = scene->now.scene->version,
                              .instances = scene->now.scene->scene.instances.size(),
                              .bytes = scene->bytes});
    return out;
}

}  // namespace tessera
