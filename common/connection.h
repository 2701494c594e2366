// One peer over TCP: messages out through a bounded queue with two lanes, messages in by coroutine.
// A session is a loop over `receive`; writing goes on by itself while anything is queued.
//
// After the C++20 coroutine examples of Boost.Asio (Kohlhoff). Where we differ: the queue towards
// the peer is bounded, and every wait for the peer has an end. What travels is plain, or TLS 1.3
// from the first byte on.
#pragma once

#include <array>
#include <boost/asio.hpp>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "common/framing.h"
#include "common/keys.h"
#include "common/message_codec.h"
#include "common/messages.h"
#include "common/tcp_link.h"

namespace tessera {

namespace asio = boost::asio;
using tcp = asio::ip::tcp;

struct ConnectionConfig {
    /// Nothing is ever dropped from a queue: a peer that gets one more message while more than this
    /// is waiting for it is disconnected. One message alone is never too large for it.
    std::size_t max_queued_bytes = 64u << 20;
    /// Time in which the peer must take the next piece of a write, else it counts as gone.
    std::chrono::steady_clock::duration write_deadline = std::chrono::seconds(30);
};

/// All calls come from the socket's executor (a strand, or an io_context that one thread runs).
/// Made by std::make_shared. The owner may let go of it at any time: what is queued is still sent.
class Connection : public std::enable_shared_from_this<Connection> {
public:
    /// Takes over a connected socket; sets TCP_NODELAY, and keepalive so that a peer whose machine
    /// is gone is noticed within half a minute even if nobody speaks.
    explicit Connection(tcp::socket socket, const ConnectionConfig& config = {},
                        const FrameLimits& limits = {});
    ~Connection();

    /// Speaks TLS from now on; comes before anything is sent or received. Throws
    /// boost::system::system_error when the peer does not prove itself; the connection is closed.
    asio::awaitable<void> secure(const Tls& tls);
    /// Whether the peer, a client, begins with TLS. Returns when its first byte is there; throws
    /// boost::system::system_error when the connection is lost or closed.
    asio::awaitable<bool> peer_begins_tls();
    /// The peer has been let in: from now on its messages have these limits, and it is told why
    /// before it is dropped for a fault of its own.
    void admit(const FrameLimits& limits);
    /// Common name of the certificate that the peer has proven to own; empty when it has none.
    std::string peer_name() const;

    /// The next message. `silence` bounds the time in which not a single byte arrives.
    /// Throws ProtocolError when the peer sends something malformed, reads too slowly or is silent
    /// for too long, boost::system::system_error when the connection is lost or closed. Whatever it
    /// throws, the connection is closed.
    asio::awaitable<Message> receive(
        std::optional<std::chrono::steady_clock::duration> silence = {});
    /// A message that has arrived already, without waiting; throws as `receive` does.
    std::optional<Message> receive_now();

    /// Queues a message; within a lane messages keep their order, and bulk messages go out only
    /// when no control message waits. Never blocks and never throws for the peer's faults; on a
    /// closed connection it does nothing. Bulk data is to be fed while `queued_bytes()` is low, see
    /// wait_until_drained.
    void send(Message message);
    void send_bulk(Message message);

    /// Bytes queued or being written, both lanes.
    std::size_t queued_bytes() const { return queued_bytes_; }
    /// Of all messages so far.
    std::uint64_t bytes_received() const { return bytes_received_; }
    std::uint64_t bytes_sent() const { return bytes_sent_; }
    /// Returns when at most `bytes` wait to be sent; throws boost::system::system_error when the
    /// connection closes first. Any number of coroutines may wait.
    asio::awaitable<void> wait_until_drained(std::size_t bytes);

    /// Closes at once; `receive` and `wait_until_drained` end with operation_aborted.
    void close();
    /// Closes at once for the peer's fault; `receive` ends with ProtocolError(complaint).
    void close_for(const std::string& complaint);
    /// Closes for the peer's fault, but tells a peer that was admitted why: the socket lives on for
    /// up to two seconds, in which what still arrives is thrown away, so that the words get
    /// through.
    void dismiss(const std::string& reason);
    /// Closes once everything queued has been sent, or when the peer takes none of it for two
    /// seconds.
    asio::awaitable<void> close_when_sent();
    bool open() const { return socket_.is_open() && !dismissed_; }
    asio::any_io_executor executor() { return socket_.get_executor(); }
    /// "host:port" of the peer, for logs.
    const std::string& remote_address() const { return remote_address_; }
    /// Of this end.
    asio::ip::address local_address() const { return local_address_; }
    /// As it is now; on loopback the speed is infinite.
    LinkSpeed link();

private:
    struct Tunnel;
    using Lane = std::deque<EncodedMessage>;

    void enqueue(Lane& lane, Message message);
    /// Messages that go out with one system call, all of one lane.
    std::vector<EncodedMessage> take_batch();
    /// Runs while anything is queued.
    asio::awaitable<void> write_all();
    asio::awaitable<boost::system::error_code> write(std::span<const EncodedMessage> batch);
    /// Returns when something was sent or the connection closed.
    asio::awaitable<void> progress();
    /// The next message if all of it is here.
    std::optional<Message> take_message();
    /// Makes room in `block_` for a frame of that size at `begin_`.
    void make_room(std::size_t frame_bytes);
    asio::awaitable<void> read_more(std::optional<std::chrono::steady_clock::duration> silence);
    /// By TLS into the room that there is in `block_`, at least a byte.
    asio::awaitable<std::size_t> read_decrypted();
    /// Sends what TLS has to say, and throws what hinders it.
    asio::awaitable<void> flush_tunnel();
    /// Closes and rethrows the current exception, or what we hold against the peer.
    [[noreturn]] void fail_receive();
    asio::awaitable<void> say_last_words();
    /// Lets `timer` close the connection after `time` unless armed again or disarmed before.
    void arm(asio::steady_timer& timer, std::chrono::steady_clock::duration time,
             const char* complaint);

    tcp::socket socket_;
    std::unique_ptr<Tunnel> tunnel_;  ///< TLS over the socket; null: plain
    ConnectionConfig config_;
    FrameLimits limits_;
    std::string remote_address_;
    asio::ip::address local_address_;
    Lane control_;
    Lane bulk_;
    std::size_t queued_bytes_ = 0;
    std::uint64_t bytes_received_ = 0;
    std::uint64_t bytes_sent_ = 0;
    bool writing_ = false;
    bool admitted_ = false;
    bool dismissed_ = false;
    // What has arrived and not been taken: [begin_, end_) of block_. Payloads share the block,
    // which is used again once nobody does.
    std::shared_ptr<std::byte[]> block_;
    std::size_t block_bytes_ = 0;
    std::size_t usual_bytes_;  ///< of a block; grows where much arrives at once
    std::size_t begin_ = 0;
    std::size_t end_ = 0;
    std::string complaint_;  ///< why we closed, when it was the peer's fault
    asio::steady_timer read_timer_;
    asio::steady_timer write_timer_;
    asio::steady_timer drained_;  ///< cancelled whenever queued_bytes_ falls or the socket closes
};

struct Address {
    std::string host;
    std::string port;

    Address() = default;
    // No aggregate, because gcc 12 miscompiles those written in braces inside a co_await.
    Address(std::string h, std::string p) : host(std::move(h)), port(std::move(p)) {}

    bool operator==(const Address&) const = default;
};

/// "host:port" or "[IPv6]:port"; throws UserError that says so for anything else. Port 0 is left to
/// the caller (to listen on a free port).
Address parse_address(const std::string& text);

/// Time to wait after `failures` attempts to connect in a row have failed: doubles from 0.1 s up to
/// 1 s, for a server that is started again shall have its peers back soon; `u` in [0, 1) takes up
/// to half of it away, so that they do not all come back at once.
std::chrono::milliseconds retry_delay(unsigned failures, double u);

/// Connects to the first of the address's endpoints that answers, and speaks TLS where it is given.
/// Throws UserError naming the address, the reason and what to do.
asio::awaitable<std::shared_ptr<Connection>> connect(
    Address address, std::shared_ptr<const Tls> tls = {},
    std::chrono::steady_clock::duration timeout = std::chrono::seconds(5));

}  // namespace tessera
