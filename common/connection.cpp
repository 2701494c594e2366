#include "common/connection.h"

#include <fmt/format.h>
#include <netinet/tcp.h>
#include <sys/socket.h>

#include <algorithm>
#include <boost/asio/ssl/context.hpp>
#include <boost/asio/ssl/error.hpp>
#include <limits>
#include <utility>

#include "common/check.h"

namespace tessera {
namespace {

using boost::system::error_code;
using Clock = std::chrono::steady_clock;

/// Messages share one system call up to this size; a larger one goes alone.
constexpr std::size_t batch_bytes = 256u << 10;
/// What one read takes at most, unless a frame is larger: for most peers, and for those that fill
/// it.
constexpr std::size_t least_block_bytes = 64u << 10, most_block_bytes = 256u << 10;
/// Time for the last words of a session, counted from the peer's last sign of reading.
constexpr auto closing_deadline = std::chrono::seconds(2);
/// What a TLS client sends first: a record of the handshake.
constexpr std::uint8_t tls_handshake_record = 22;

/// Notices after 10 + 3 * 5 seconds that a peer's machine is gone.
void keep_alive(tcp::socket& socket) {
    const auto set = [&](int level, int option, int value) {
        ::setsockopt(socket.native_handle(), level, option, &value, sizeof value);
    };
    set(SOL_SOCKET, SO_KEEPALIVE, 1);
    set(IPPROTO_TCP, TCP_KEEPIDLE, 10);
    set(IPPROTO_TCP, TCP_KEEPINTVL, 5);
    set(IPPROTO_TCP, TCP_KEEPCNT, 3);
}

std::string describe(const Address& address) {
    const bool is_ipv6 = address.host.find(':') != std::string::npos;
    return fmt::format(fmt::runtime(is_ipv6 ? "[{}]:{}" : "{}:{}"), address.host, address.port);
}

std::string describe_peer(const tcp::socket& socket) {
    error_code error;
    const auto endpoint = socket.remote_endpoint(error);
    if (error) return "a peer already gone";
    return describe({endpoint.address().to_string(), std::to_string(endpoint.port())});
}

/// Certificates that do not agree are one fault, a server that hangs up before it shows its own is
/// another.
std::string why_no_tls(const error_code& error) {
    if (error.category() == asio::error::get_ssl_category())
        return fmt::format(
            "no TLS with it: {}; does it run with --keys, and are these keys from the same "
            "`tessera keys`?",
            error.message());
    return fmt::format(
        "it {} before TLS began; it may be busy and turn newcomers away, so try again in a while, "
        "or run without --keys",
        error == asio::error::operation_aborted ? "does not answer" : "hangs up");
}

}  // namespace

/// OpenSSL between buffers of our own: asio's stream moves no more than a record of 16 KiB with a
/// system call.
struct Connection::Tunnel {
    std::unique_ptr<SSL, decltype(&SSL_free)> ssl;
    std::unique_ptr<std::byte[]> received;  ///< encrypted; OpenSSL reads it where it is
    std::size_t received_bytes;

    Tunnel(const Tls& tls, std::size_t block_bytes)
        : ssl(SSL_new(tls.context().native_handle()), SSL_free), received_bytes(0) {
        CHECK(ssl);
        SSL_set_bio(ssl.get(), BIO_new(BIO_s_mem()), BIO_new(BIO_s_mem()));
        tls.side() == Tls::Side::server ? SSL_set_accept_state(ssl.get())
                                        : SSL_set_connect_state(ssl.get());
        make_room(block_bytes);
    }

    void make_room(std::size_t bytes) {
        if (bytes == received_bytes) return;
        received = std::make_unique_for_overwrite<std::byte[]>(bytes);
        received_bytes = bytes;
    }

    /// To be called when OpenSSL has read all that it was given.
    void give(std::size_t bytes) {
        BIO* in = BIO_new_mem_buf(received.get(), int(bytes));
        BIO_set_mem_eof_return(in, -1);  // more will come
        SSL_set0_rbio(ssl.get(), in);
    }

    /// What is to be sent.
    Bytes take() {
        BIO* out = SSL_get_wbio(ssl.get());
        Bytes bytes(BIO_ctrl_pending(out));
        if (!bytes.empty())
            CHECK_EQ(BIO_read(out, bytes.data(), int(bytes.size())), int(bytes.size()));
        return bytes;
    }

    /// After a call that returned `result`: whether more must be received. Throws what went wrong.
    bool wants_more(int result) const {
        const int error = SSL_get_error(ssl.get(), result);
        if (error == SSL_ERROR_WANT_READ) return true;
        if (error == SSL_ERROR_NONE) return false;
        if (error == SSL_ERROR_ZERO_RETURN) throw boost::system::system_error(asio::error::eof);
        throw boost::system::system_error(
            error_code(int(ERR_get_error()), asio::error::get_ssl_category()));
    }
};

Connection::Connection(tcp::socket socket, const ConnectionConfig& config,
                       const FrameLimits& limits)
    : socket_(std::move(socket)),
      config_(config),
      limits_(limits),
      remote_address_(describe_peer(socket_)),
      usual_bytes_(least_block_bytes),
      read_timer_(socket_.get_executor()),
      write_timer_(socket_.get_executor()),
      drained_(socket_.get_executor(), Clock::time_point::max()) {
    // Either fails only when the peer is gone already, which the first read tells.
    error_code ignored;
    socket_.set_option(tcp::no_delay(true), ignored);
    keep_alive(socket_);
    const tcp::endpoint here = socket_.local_endpoint(ignored);
    local_address_ = here.address();
}

Connection::~Connection() = default;

asio::awaitable<void> Connection::secure(const Tls& tls) {
    const auto self = shared_from_this();
    tunnel_ = std::make_unique<Tunnel>(tls, usual_bytes_);
    try {
        for (;;) {
            ERR_clear_error();
            const int result = SSL_do_handshake(tunnel_->ssl.get());
            co_await flush_tunnel();  // the last words of one that fails, too
            if (!tunnel_->wants_more(result)) co_return;
            tunnel_->give(co_await socket_.async_read_some(
                asio::buffer(tunnel_->received.get(), tunnel_->received_bytes),
                asio::use_awaitable));
        }
    } catch (...) {
        close();
        throw;
    }
}

asio::awaitable<void> Connection::flush_tunnel() {
    const Bytes bytes = tunnel_->take();
    if (!bytes.empty())
        co_await asio::async_write(socket_, asio::buffer(bytes), asio::use_awaitable);
}

asio::awaitable<bool> Connection::peer_begins_tls() {
    const auto self = shared_from_this();
    std::uint8_t first = 0;
    co_await socket_.async_receive(asio::buffer(&first, 1), tcp::socket::message_peek,
                                   asio::use_awaitable);
    co_return first == tls_handshake_record;
}

void Connection::admit(const FrameLimits& limits) {
    limits_ = limits;
    admitted_ = true;
}

std::string Connection::peer_name() const {
    if (!tunnel_) return {};
    const std::unique_ptr<X509, decltype(&X509_free)> certificate(
        SSL_get1_peer_certificate(tunnel_->ssl.get()), X509_free);
    if (!certificate) return {};
    char name[256] = "";
    X509_NAME_get_text_by_NID(X509_get_subject_name(certificate.get()), NID_commonName, name,
                              sizeof name);
    return name;
}

LinkSpeed Connection::link() {
    if (!socket_.is_open()) return {};
    LinkSpeed link = link_speed(socket_.native_handle());
    if (local_address_.is_loopback())
        link.bytes_per_second = std::numeric_limits<double>::infinity();
    return link;
}

asio::awaitable<Message> Connection::receive(std::optional<Clock::duration> silence) {
    const auto self = shared_from_this();
    try {
        for (;;) {
            if (std::optional<Message> message = take_message()) co_return std::move(*message);
            co_await read_more(silence);
        }
    } catch (...) {
        fail_receive();
    }
}

std::optional<Message> Connection::receive_now() {
    try {
        return take_message();
    } catch (...) {
        fail_receive();
    }
}

void Connection::fail_receive() {
    try {
        throw;
    } catch (const ProtocolError& error) {
        dismiss(error.what());
        throw;
    } catch (...) {
        close();
        if (!complaint_.empty()) throw ProtocolError(complaint_);
        throw;
    }
}

std::optional<Message> Connection::take_message() {
    if (!open()) throw boost::system::system_error(asio::error::operation_aborted);
    const std::span<const std::byte> here(block_.get() + begin_, end_ - begin_);
    if (here.size() < frame_header_bytes) {
        make_room(frame_header_bytes);
        return std::nullopt;
    }
    const FrameHeader header = decode_header(here.first<frame_header_bytes>(), limits_);
    const std::size_t size =
        frame_header_bytes + std::size_t(header.message_bytes) + header.payload_bytes;
    if (here.size() < size) {
        make_room(size);
        return std::nullopt;
    }
    begin_ += size;
    bytes_received_ += size;
    const std::span<const std::byte> body = here.first(size).subspan(frame_header_bytes);
    return decode(header, body.first(header.message_bytes),
                  {block_, body.subspan(header.message_bytes)});
}

void Connection::make_room(std::size_t frame_bytes) {
    const std::size_t held = end_ - begin_;
    const std::size_t size = std::max(usual_bytes_, frame_bytes);
    const bool shared = block_.use_count() > 1;
    if (held == 0 && !shared) begin_ = end_ = 0;
    // Half a block at least, so that pieces stay large; a block of unusual size is for one frame.
    const std::size_t wanted = std::max(frame_bytes, held + usual_bytes_ / 2);
    if (size == block_bytes_ && begin_ + wanted <= size) return;
    if (shared || size != block_bytes_) {
        // Not initialised: memory that a peer announces costs nothing until the peer fills it.
        const auto block = std::make_shared_for_overwrite<std::byte[]>(size);
        std::copy_n(block_.get() + begin_, held, block.get());
        block_ = block;
        block_bytes_ = size;
    } else {
        std::copy(block_.get() + begin_, block_.get() + end_, block_.get());
    }
    begin_ = 0;
    end_ = held;
}

asio::awaitable<void> Connection::read_more(std::optional<Clock::duration> silence) {
    if (silence) arm(read_timer_, *silence, "is silent for too long");
    const std::size_t room = block_bytes_ - end_;
    std::size_t size = 0;
    if (tunnel_)
        size = co_await read_decrypted();
    else
        size = co_await socket_.async_read_some(asio::buffer(block_.get() + end_, room),
                                                asio::use_awaitable);
    end_ += size;
    if (size == room) usual_bytes_ = std::min(2 * usual_bytes_, most_block_bytes);
    if (silence) read_timer_.expires_at(Clock::time_point::max());
}

asio::awaitable<std::size_t> Connection::read_decrypted() {
    std::size_t size = 0;
    for (;;) {
        ERR_clear_error();
        const int result = SSL_read(tunnel_->ssl.get(), block_.get() + end_ + size,
                                    int(block_bytes_ - end_ - size));
        if (result > 0) size += std::size_t(result);
        if (end_ + size == block_bytes_) co_return size;
        if (result > 0 || !tunnel_->wants_more(result)) continue;
        if (size > 0) co_return size;
        tunnel_->make_room(usual_bytes_);
        tunnel_->give(co_await socket_.async_read_some(
            asio::buffer(tunnel_->received.get(), tunnel_->received_bytes), asio::use_awaitable));
    }
}

void Connection::send(Message message) { enqueue(control_, std::move(message)); }

void Connection::send_bulk(Message message) { enqueue(bulk_, std::move(message)); }

void Connection::enqueue(Lane& lane, Message message) {
    if (!open()) return;
    if (queued_bytes_ > config_.max_queued_bytes)
        return close_for(
            fmt::format("reads too slowly: {} MB wait to be sent", queued_bytes_ >> 20));
    lane.push_back(encode(std::move(message)));
    queued_bytes_ += lane.back().size();
    if (std::exchange(writing_, true)) return;
    asio::co_spawn(
        socket_.get_executor(), [self = shared_from_this()] { return self->write_all(); },
        asio::detached);
}

std::vector<EncodedMessage> Connection::take_batch() {
    Lane& lane = control_.empty() ? bulk_ : control_;
    std::vector<EncodedMessage> batch;
    for (std::size_t bytes = 0; !lane.empty() && bytes < batch_bytes; lane.pop_front()) {
        bytes += lane.front().size();
        batch.push_back(std::move(lane.front()));
    }
    return batch;
}

asio::awaitable<void> Connection::write_all() {
    while (queued_bytes_ > 0) {
        const std::vector<EncodedMessage> batch = take_batch();
        std::size_t size = 0;
        for (const EncodedMessage& message : batch) size += message.size();
        if (co_await write(batch)) close();
        if (!socket_.is_open()) break;
        queued_bytes_ -= size;
        bytes_sent_ += size;
        drained_.cancel();
    }
    write_timer_.expires_at(Clock::time_point::max());
    writing_ = false;
}

asio::awaitable<error_code> Connection::write(std::span<const EncodedMessage> batch) {
    const auto next_piece = [&](const error_code& error, std::size_t) -> std::size_t {
        arm(write_timer_, config_.write_deadline, "does not read");
        return error ? 0 : chunk_bytes;
    };
    std::vector<asio::const_buffer> buffers;
    for (const EncodedMessage& message : batch) {
        buffers.push_back(asio::buffer(message.head));
        buffers.emplace_back(message.payload.bytes.data(), message.payload.bytes.size());
    }
    Bytes encrypted;
    if (tunnel_) {
        // One piece, or TLS would make a record of every buffer.
        Bytes joined(asio::buffer_size(buffers));
        asio::buffer_copy(asio::buffer(joined), buffers);
        ERR_clear_error();
        if (SSL_write(tunnel_->ssl.get(), joined.data(), int(joined.size())) <= 0)
            co_return asio::error::broken_pipe;
        encrypted = tunnel_->take();
        buffers = {asio::buffer(encrypted)};
    }
    error_code error;
    co_await asio::async_write(socket_, buffers, next_piece,
                               asio::redirect_error(asio::use_awaitable, error));
    co_return error;
}

asio::awaitable<void> Connection::progress() {
    error_code cancelled;
    co_await drained_.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
}

asio::awaitable<void> Connection::wait_until_drained(std::size_t bytes) {
    const auto self = shared_from_this();
    while (queued_bytes_ > bytes) co_await progress();
    if (!open()) throw boost::system::system_error(asio::error::operation_aborted);
}

asio::awaitable<void> Connection::close_when_sent() {
    const auto self = shared_from_this();
    config_.write_deadline = closing_deadline;
    if (writing_) arm(write_timer_, closing_deadline, "does not read");
    while (queued_bytes_ > 0) co_await progress();
    close();
}

void Connection::close() {
    if (dismissed_) return;  // it closes when its last words are sent
    error_code ignored;
    socket_.close(ignored);
    control_.clear();
    bulk_.clear();
    queued_bytes_ = 0;
    for (asio::steady_timer* timer : {&read_timer_, &write_timer_, &drained_}) timer->cancel();
}

void Connection::close_for(const std::string& complaint) {
    if (!open()) return;
    complaint_ = complaint;
    close();
}

void Connection::dismiss(const std::string& reason) {
    if (!admitted_) return close();
    if (!open()) return;
    for (Lane* lane : {&control_, &bulk_}) {
        for (const EncodedMessage& message : *lane) queued_bytes_ -= message.size();
        lane->clear();
    }
    send({Refused{reason}, {}});
    dismissed_ = true;
    drained_.cancel();
    asio::co_spawn(
        socket_.get_executor(), [self = shared_from_this()] { return self->say_last_words(); },
        asio::detached);
}

asio::awaitable<void> Connection::say_last_words() {
    const auto end = [self = shared_from_this()](const error_code& cancelled) {
        if (cancelled) return;
        self->dismissed_ = false;
        self->close();
    };
    asio::steady_timer deadline(socket_.get_executor(), closing_deadline);
    deadline.async_wait(end);
    while (queued_bytes_ > 0) co_await progress();
    error_code error;
    socket_.shutdown(tcp::socket::shutdown_send, error);
    // A socket that is closed while something arrives takes back what it has sent: read to the end.
    std::array<std::byte, 4096> rest;
    while (!error)
        co_await socket_.async_read_some(asio::buffer(rest),
                                         asio::redirect_error(asio::use_awaitable, error));
    end({});
}

void Connection::arm(asio::steady_timer& timer, Clock::duration time, const char* complaint) {
    timer.expires_after(time);
    timer.async_wait([weak = weak_from_this(), &timer, complaint](const error_code& error) {
        const auto self = weak.lock();
        // A wait that ended just before it was cancelled still comes here: the expiry tells.
        if (!error && self && timer.expiry() <= Clock::now()) self->close_for(complaint);
    });
}

Address parse_address(const std::string& text) {
    const std::size_t colon = text.rfind(':');
    const auto fail = [&](const char* problem) {
        return UserError(fmt::format("address '{}': {}; write HOST:PORT", text, problem));
    };
    if (colon == std::string::npos) throw fail("no port");
    Address address(text.substr(0, colon), text.substr(colon + 1));
    if (address.host.starts_with('[') && address.host.ends_with(']'))
        address.host = address.host.substr(1, address.host.size() - 2);
    else if (address.host.find(':') != std::string::npos)
        throw fail("an IPv6 address goes in [brackets]");
    if (address.host.empty()) throw fail("no host");
    const auto is_digit = [](char c) { return c >= '0' && c <= '9'; };
    if (address.port.empty() || address.port.size() > 5 ||
        !std::all_of(address.port.begin(), address.port.end(), is_digit) ||
        std::stoi(address.port) > 65535)
        throw fail("the port is no number from 0 to 65535");
    return address;
}

std::chrono::milliseconds retry_delay(unsigned failures, double u) {
    using std::chrono::milliseconds;
    const auto longest = std::min(milliseconds(100 << std::min(failures, 4u)), milliseconds(1000));
    return milliseconds(std::int64_t(double(longest.count()) * (1 - u / 2)));
}

asio::awaitable<std::shared_ptr<Connection>> connect(Address address,
                                                     std::shared_ptr<const Tls> tls,
                                                     Clock::duration timeout) {
    const auto executor = co_await asio::this_coro::executor;
    const auto fail = [&](const std::string& reason) {
        return UserError(fmt::format("cannot reach {}: {}", describe(address), reason));
    };
    constexpr const char* question = "; is tessera-server running there?";
    error_code error;
    tcp::resolver resolver(executor);
    const auto endpoints = co_await resolver.async_resolve(
        address.host, address.port, asio::redirect_error(asio::use_awaitable, error));
    if (error) throw fail(error.message() + question);
    // Shared with the timer, which may fire when this coroutine is over.
    const auto socket = std::make_shared<tcp::socket>(executor);
    asio::steady_timer timer(executor, timeout);
    timer.async_wait([socket](const error_code& cancelled) {
        if (!cancelled) socket->close();
    });
    co_await asio::async_connect(*socket, endpoints,
                                 asio::redirect_error(asio::use_awaitable, error));
    if (error == asio::error::operation_aborted) throw fail(std::string("no answer") + question);
    if (error) throw fail(error.message() + question);
    timer.cancel();
    const auto connection = std::make_shared<Connection>(std::move(*socket));
    if (!tls) co_return connection;

    asio::steady_timer handshake_timer(executor, timeout);
    handshake_timer.async_wait([connection](const error_code& cancelled) {
        if (!cancelled) connection->close();
    });
    try {
        co_await connection->secure(*tls);
    } catch (const boost::system::system_error& failure) {
        throw fail(why_no_tls(failure.code()));
    }
    co_return connection;
}

}  // namespace tessera
