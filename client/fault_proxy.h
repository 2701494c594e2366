// A relay on loopback that makes a bad network out of a good one: what passes is delayed as
// LinkModel says, or does not pass at all any more.
#pragma once

#include <atomic>
#include <string>
#include <thread>

#include "client/link_model.h"
#include "common/connection.h"

namespace tessera {

class FaultProxy {
public:
    /// Listens at once and relays whoever comes to `server`, on a network thread of its own. Both
    /// directions of each connection are links with chances of their own.
    FaultProxy(const Address& server, const LinkConfig& link);
    ~FaultProxy();
    FaultProxy(const FaultProxy&) = delete;
    FaultProxy& operator=(const FaultProxy&) = delete;

    /// Where to connect, in place of the server.
    const std::string& address() const { return address_; }
    /// From now on nothing passes, as if a cable were pulled: nobody is told.
    void cut() { cut_ = true; }

private:
    struct Direction;
    struct Relay;

    asio::awaitable<void> accept();
    asio::awaitable<void> connect(std::shared_ptr<Relay> relay);
    // Both hold the relay, whose direction they serve.
    asio::awaitable<void> take(std::shared_ptr<Relay> relay, Direction& direction);
    asio::awaitable<void> deliver(std::shared_ptr<Relay> relay, Direction& direction);

    asio::io_context io_{1};
    Address server_;
    LinkConfig link_;
    tcp::acceptor acceptor_;
    std::string address_;
    std::uint32_t links_ = 0;  ///< so far
    std::atomic<bool> cut_ = false;
    std::thread thread_;
};

}  // namespace tessera
