#include "client/fault_proxy.h"

#include <fmt/format.h>

#include <deque>
#include <vector>

#include "common/clock.h"
#include "common/log.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr std::size_t piece_bytes = 64 << 10;
/// On their way in one direction; a sender that is ahead of the link by more has to wait.
constexpr std::size_t most_bytes = 4 << 20;

double seconds_of(Clock::time_point time) {
    return std::chrono::duration<double>(time.time_since_epoch()).count();
}

Clock::time_point time_of(double seconds) { return Clock::time_point(from_seconds(seconds)); }

/// Waits for the timer; that it was cancelled is what is waited for.
asio::awaitable<void> wait(asio::steady_timer& timer) {
    boost::system::error_code ignored;
    co_await timer.async_wait(asio::redirect_error(asio::use_awaitable, ignored));
}

}  // namespace

struct FaultProxy::Direction {
    struct Piece {
        Clock::time_point arrival;
        std::vector<std::byte> bytes;
    };

    Direction(tcp::socket& source, tcp::socket& sink, const LinkConfig& config)
        : from(source), to(sink), link(config), changed(source.get_executor()) {
        changed.expires_at(Clock::time_point::max());
    }

    tcp::socket& from;
    tcp::socket& to;
    LinkModel link;
    std::deque<Piece> pieces;
    std::size_t bytes = 0;
    bool ended = false;          ///< `from` sends no more
    asio::steady_timer changed;  ///< cancelled whenever one of the above changes
};

struct FaultProxy::Relay {
    Relay(tcp::socket accepted, const LinkConfig& in, const LinkConfig& out)
        : peer(std::move(accepted)),
          server(peer.get_executor()),
          inward(peer, server, in),
          outward(server, peer, out) {}

    void close() {
        boost::system::error_code ignored;
        peer.close(ignored);
        server.close(ignored);
        inward.changed.cancel();
        outward.changed.cancel();
    }

    tcp::socket peer;
    tcp::socket server;
    Direction inward;
    Direction outward;
};

FaultProxy::FaultProxy(const Address& server, const LinkConfig& link)
    : server_(server),
      link_(link),
      acceptor_(io_, tcp::endpoint(asio::ip::address_v4::loopback(), 0)),
      address_(fmt::format("127.0.0.1:{}", acceptor_.local_endpoint().port())) {
    asio::co_spawn(io_, accept(), asio::detached);
    thread_ = std::thread([this] { io_.run(); });
}

FaultProxy::~FaultProxy() {
    io_.stop();
    thread_.join();
}

asio::awaitable<void> FaultProxy::accept() {
    for (;;) {
        tcp::socket socket = co_await acceptor_.async_accept(asio::use_awaitable);
        LinkConfig in = link_, out = link_;
        in.seed += links_++;
        out.seed += links_++;
        asio::co_spawn(io_, connect(std::make_shared<Relay>(std::move(socket), in, out)),
                       asio::detached);
    }
}

asio::awaitable<void> FaultProxy::connect(std::shared_ptr<Relay> relay) {
    tcp::resolver resolver(io_);
    boost::system::error_code error;
    const auto endpoints = co_await resolver.async_resolve(
        server_.host, server_.port, asio::redirect_error(asio::use_awaitable, error));
    if (!error)
        co_await asio::async_connect(relay->server, endpoints,
                                     asio::redirect_error(asio::use_awaitable, error));
    if (error) {
        spdlog::debug("fault proxy: {}", error.message());
        co_return;
    }
    relay->peer.set_option(tcp::no_delay(true));
    relay->server.set_option(tcp::no_delay(true));
    for (Direction* direction : {&relay->inward, &relay->outward}) {
        asio::co_spawn(io_, take(relay, *direction), asio::detached);
        asio::co_spawn(io_, deliver(relay, *direction), asio::detached);
    }
}

asio::awaitable<void> FaultProxy::take(std::shared_ptr<Relay> /*relay*/, Direction& direction) {
    std::vector<std::byte> buffer(piece_bytes);
    for (;;) {
        while (direction.bytes > most_bytes && direction.from.is_open())
            co_await wait(direction.changed);
        boost::system::error_code error;
        const std::size_t count = co_await direction.from.async_read_some(
            asio::buffer(buffer), asio::redirect_error(asio::use_awaitable, error));
        if (error) break;
        const double arrival = direction.link.arrival(seconds_of(Clock::now()), count);
        direction.pieces.push_back(
            {time_of(arrival), {buffer.begin(), buffer.begin() + std::ptrdiff_t(count)}});
        direction.bytes += count;
        direction.changed.cancel();
    }
    direction.ended = true;
    direction.changed.cancel();
}

asio::awaitable<void> FaultProxy::deliver(std::shared_ptr<Relay> relay, Direction& direction) {
    asio::steady_timer arrival(io_);
    boost::system::error_code error;
    while (!error) {
        while (direction.pieces.empty() && !direction.ended) co_await wait(direction.changed);
        if (direction.pieces.empty()) break;
        arrival.expires_at(direction.pieces.front().arrival);
        co_await wait(arrival);
        const Direction::Piece piece = std::move(direction.pieces.front());
        direction.pieces.pop_front();
        if (!cut_)
            co_await asio::async_write(direction.to, asio::buffer(piece.bytes),
                                       asio::redirect_error(asio::use_awaitable, error));
        direction.bytes -= piece.bytes.size();
        direction.changed.cancel();
    }
    if (!cut_) relay->close();
}

}  // namespace tessera
