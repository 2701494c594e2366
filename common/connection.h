// One peer over TCP: messages out through a bounded queue with two lanes, messages in by coroutine.
#pragma once

#include <boost/asio.hpp>
#include <chrono>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>

#include "common/framing.h"
#include "common/messages.h"

namespace tessera {

namespace asio = boost::asio;
using tcp = asio::ip::tcp;

/// All calls from one executor (strand); `run_writer` and `receive` are its two loops.
class Connection : public std::enable_shared_from_this<Connection> {
public:
    explicit Connection(tcp::socket socket);  ///< sets TCP_NODELAY

    /// Reads the next message; `deadline` bounds the wait for its first byte.
    /// Throws ProtocolError (peer's fault) or boost::system::system_error (connection lost, timed
    /// out).
    asio::awaitable<Message> receive(
        std::optional<std::chrono::steady_clock::duration> deadline = {},
        const FrameLimits& limits = {});

    /// Queues a message. Bulk messages go out only when no control message waits. Policy: nothing
    /// is ever dropped; a peer that lets more than `max_queued_bytes` pile up is disconnected. Bulk
    /// data is therefore to be fed while `queued_bytes()` is low; see wait_until_drained.
    void send(Message message);
    void send_bulk(Message message);

    std::size_t queued_bytes() const;
    /// Returns when at most `bytes` wait to be sent; throws when the connection closes first.
    asio::awaitable<void> wait_until_drained(std::size_t bytes);

    /// Closes at once; receive and the writer end with operation_aborted.
    void close();
    /// Closes once everything queued has been sent, or after two seconds.
    asio::awaitable<void> close_when_sent();
    bool open() const;
    std::string remote_address() const;
};

/// "host:port" -> endpoints; throws UserError when it cannot be parsed or resolved.
struct Address {
    std::string host;
    std::string port;
};
Address parse_address(const std::string& text);

}  // namespace tessera
