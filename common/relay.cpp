#include "common/relay.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "common/check.h"
#include "common/log.h"

namespace tessera {
namespace {

using boost::system::error_code;

/// Others that are served at once, and blobs that one of them may wait for.
constexpr std::size_t most_takers = 64, most_wanted = 1u << 20;
/// Of a peer's messages: a request for most_wanted blobs, at 36 bytes each.
constexpr std::uint32_t request_bytes = 40u << 20;

Address address_of(const BlobSource& source) {
    try {
        return parse_address(source.address);
    } catch (const UserError& error) {
        throw ProtocolError(error.what());
    }
}

}  // namespace

std::shared_ptr<Relay> Relay::listen(Connection& server, const RelayKeys& keys, std::uint16_t port,
                                     const RelayPatience& patience) {
    const tcp::endpoint here(server.local_address(), port);
    if (!keys.accept && !here.address().is_loopback()) return nullptr;
    tcp::acceptor acceptor(server.executor());
    try {
        acceptor.open(here.protocol());
        acceptor.set_option(tcp::acceptor::reuse_address(true));
        acceptor.bind(here);
        acceptor.listen();
    } catch (const boost::system::system_error& error) {
        spdlog::warn("has no meshes and textures for other workers: port {}: {}", port,
                     error.code().message());
        return nullptr;
    }
    return std::make_shared<Relay>(std::move(acceptor), keys, patience);
}

Relay::Relay(tcp::acceptor acceptor, const RelayKeys& keys, const RelayPatience& patience)
    : acceptor_(std::move(acceptor)),
      keys_(keys),
      patience_(patience),
      port_(acceptor_.local_endpoint().port()),
      news_(acceptor_.get_executor(), std::chrono::steady_clock::time_point::max()) {}

void Relay::begin(const std::string& token, std::shared_ptr<SceneReceiver> receiver,
                  std::shared_ptr<Connection> server, std::function<void()> more) {
    receiver_ = std::move(receiver);
    server_ = std::move(server);
    more_ = std::move(more);
    token_ = token;
    if (token.empty()) return acceptor_.close();
    asio::co_spawn(
        acceptor_.get_executor(), [self = shared_from_this()] { return self->accept_takers(); },
        asio::detached);
}

void Relay::close() {
    error_code ignored;
    acceptor_.close(ignored);
    for (const auto& taker : takers_) taker->close();
    for (const auto& [peer, giver] : givers_) {
        giver->deadline.cancel();
        if (giver->connection) giver->connection->close();
    }
    givers_.clear();
    receiver_.reset();
    server_.reset();
    more_ = {};
    news_.cancel();
}

// ---- For others ---------------------------------------------------------------------------------

asio::awaitable<void> Relay::accept_takers() {
    const auto self = shared_from_this();
    error_code error;
    while (acceptor_.is_open() && !error) {
        tcp::socket socket =
            co_await acceptor_.async_accept(asio::redirect_error(asio::use_awaitable, error));
        if (error || takers_.size() >= most_takers) continue;
        const auto connection = std::make_shared<Connection>(
            std::move(socket), ConnectionConfig{},
            FrameLimits{.message_bytes = max_hello_bytes, .payload_bytes = 0});
        takers_.insert(connection);
        asio::co_spawn(
            acceptor_.get_executor(), [self, connection] { return self->serve(connection); },
            [self, connection](std::exception_ptr) {
                connection->close();
                self->takers_.erase(connection);
            });
    }
}

asio::awaitable<void> Relay::serve(std::shared_ptr<Connection> connection) {
    co_await admit(connection);
    const auto taker = std::make_shared<Taker>(connection);
    for (;;) {
        const Message message = co_await connection->receive();
        const auto* request = message.get<BlobRequest>();
        if (!request || taker->wanted.size() + request->blobs.size() > most_wanted)
            throw ProtocolError("asks for something else than blobs, or for too many");
        taker->wanted.insert(taker->wanted.end(), request->blobs.begin(), request->blobs.end());
        if (std::exchange(taker->sending, true)) continue;
        asio::co_spawn(
            connection->executor(),
            [self = shared_from_this(), taker] { return self->send_wanted(taker); },
            asio::detached);
    }
}

/// Throws when the peer is none of this server's workers.
asio::awaitable<void> Relay::admit(std::shared_ptr<Connection> connection) {
    asio::steady_timer deadline(connection->executor(), patience_.handshake);
    deadline.async_wait([weak = std::weak_ptr(connection)](const error_code& cancelled) {
        const auto self = weak.lock();
        if (!cancelled && self) self->close();
    });
    if (keys_.accept) co_await connection->secure(*keys_.accept);
    const Message message = co_await connection->receive();
    const auto* hello = message.get<Hello>();
    const bool known = hello && hello->protocol == protocol_version &&
                       same_token(hello->token, token_) &&
                       (!keys_.accept || connection->peer_name() == worker_common_name);
    if (!known) throw ProtocolError("is no worker of the same server");
    connection->admit({.message_bytes = request_bytes, .payload_bytes = 0});
    connection->send({Welcome{.peer = 0, .build = TESSERA_VERSION, .scenes = {}}, {}});
}

asio::awaitable<void> Relay::send_wanted(std::shared_ptr<Taker> taker) {
    const auto self = shared_from_this();
    try {
        while (!taker->wanted.empty()) {
            const BlobId id = taker->wanted.front();
            taker->wanted.pop_front();
            co_await send_blob(taker->connection, id);
        }
    } catch (const ProtocolError& error) {
        taker->connection->dismiss(error.what());
    } catch (const boost::system::system_error&) {
        // serve() hears of it, too.
    }
    taker->sending = false;
}

/// What is here, and what comes as it comes.
asio::awaitable<void> Relay::send_blob(std::shared_ptr<Connection> to, BlobId id) {
    for (std::uint64_t offset = 0;;) {
        co_await to->wait_until_drained(chunk_bytes);
        const auto part = receiver_ ? receiver_->part(id) : std::nullopt;
        if (!part) throw ProtocolError(fmt::format("blob {} is not here", short_name(id)));
        const bool whole = part->bytes.size() == part->total;
        if (part->begun && (part->bytes.size() > offset || whole)) {
            const auto rest = part->bytes.subspan(offset);
            const auto bytes = rest.first(std::min<std::size_t>(rest.size(), chunk_bytes));
            const auto copy = std::make_shared<Bytes>(bytes.begin(), bytes.end());
            to->send_bulk(
                {BlobChunk{.blob = id, .offset = offset, .total = part->total}, {copy, *copy}});
            offset += bytes.size();
            bytes_sent_ += bytes.size();
            if (offset == part->total) co_return;
        } else {
            error_code cancelled;
            co_await news_.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
        }
    }
}

// ---- From others --------------------------------------------------------------------------------

void Relay::pull(const BlobSource& source) {
    if (!receiver_) return;
    const auto known = givers_.find(source.peer);
    const bool stranger = known == givers_.end();
    const auto giver = stranger ? std::make_shared<Giver>(source.peer, address_of(source),
                                                          acceptor_.get_executor())
                                : known->second;
    givers_[source.peer] = giver;
    for (std::size_t i = 0; i < source.blobs.size(); ++i)
        giver->expected[source.blobs[i]] = source.bytes[i];
    if (giver->connection) {
        giver->connection->send({BlobRequest{.scene = {}, .blobs = source.blobs}, {}});
        arm(giver);
    }
    if (stranger)
        asio::co_spawn(
            acceptor_.get_executor(),
            [self = shared_from_this(), giver] { return self->take_from(giver); }, asio::detached);
}

asio::awaitable<void> Relay::take_from(std::shared_ptr<Giver> giver) {
    const auto self = shared_from_this();
    std::string reason;
    try {
        co_await enter(giver);
        while (receiver_) {
            take(*giver, co_await giver->connection->receive());
            while (const std::optional<Message> next = giver->connection->receive_now())
                take(*giver, *next);
            arm(giver);
            arrived();
            if (more_) more_();
        }
        co_return;
    } catch (const boost::system::system_error& error) {
        reason = error.code().message();
    } catch (const std::exception& error) {
        reason = error.what();
    }
    failed(*giver, reason);
}

asio::awaitable<void> Relay::enter(std::shared_ptr<Giver> giver) {
    const auto connection = co_await connect(giver->address, keys_.connect, patience_.handshake);
    if (!receiver_) co_return;
    if (keys_.connect && connection->peer_name() != worker_common_name)
        throw ProtocolError("shows no worker's certificate");
    Hello hello;
    hello.role = Role::worker;
    hello.build = TESSERA_VERSION;
    hello.token = token_;
    connection->send({hello, {}});
    const Message answer = co_await connection->receive(patience_.handshake);
    if (!answer.get<Welcome>()) throw ProtocolError("lets nobody in");
    connection->admit({.message_bytes = max_hello_bytes});
    if (!receiver_) co_return;
    giver->connection = connection;
    BlobRequest request;
    for (const auto& [id, bytes] : giver->expected) request.blobs.push_back(id);
    connection->send({std::move(request), {}});
    arm(giver);
}

void Relay::take(Giver& giver, const Message& message) {
    if (!receiver_) return;
    if (const auto* refused = message.get<Refused>()) throw ProtocolError(refused->reason);
    const auto* chunk = message.get<BlobChunk>();
    const auto wanted = chunk ? giver.expected.find(chunk->blob) : giver.expected.end();
    if (wanted == giver.expected.end() || wanted->second != chunk->total)
        throw ProtocolError("sends something else than was asked for");
    receiver_->add(*chunk, message.payload.bytes);
    if (chunk->offset + message.payload.bytes.size() == chunk->total) giver.expected.erase(wanted);
}

/// A giver from whom nothing is expected may be silent.
void Relay::arm(const std::shared_ptr<Giver>& giver) {
    if (giver->expected.empty()) {
        giver->deadline.cancel();
        return;
    }
    giver->deadline.expires_after(patience_.silence);
    giver->deadline.async_wait([giver](const error_code& cancelled) {
        if (!cancelled && giver->deadline.expiry() <= std::chrono::steady_clock::now())
            giver->connection->close_for("sends nothing");
    });
}

void Relay::failed(Giver& giver, const std::string& reason) {
    giver.deadline.cancel();
    if (giver.connection) giver.connection->close();
    if (!receiver_) return;
    std::vector<BlobId> ids;
    for (const auto& [id, bytes] : giver.expected) ids.push_back(id);
    if (!ids.empty())
        spdlog::warn("worker {} at {}:{} does not send {} blobs: {}; asks the server", giver.peer,
                     giver.address.host, giver.address.port, ids.size(), reason);
    givers_.erase(giver.peer);
    for (BlobRequest& request : receiver_->ask_again(ids)) {
        request.failed_peer = giver.peer;
        server_->send({std::move(request), {}});
    }
}

}  // namespace tessera
