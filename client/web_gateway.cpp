#include "client/web_gateway.h"

#include <fmt/format.h>

#include <algorithm>
#include <boost/beast/core.hpp>
#include <boost/beast/http.hpp>
#include <boost/beast/websocket.hpp>
#include <deque>
#include <memory>
#include <mutex>
#include <set>
#include <string_view>
#include <thread>
#include <utility>

#include "client/web_files.h"
#include "common/check.h"
#include "common/connection.h"
#include "common/log.h"

namespace tessera {
namespace {

namespace beast = boost::beast;
namespace http = beast::http;
namespace websocket = beast::websocket;
using WebSocket = websocket::stream<beast::tcp_stream>;
using Request = http::request<http::string_body>;
using Response = http::response<http::span_body<const char>>;

/// What a page says is short; deeper JSON than this allows is not worth a stack.
constexpr std::size_t most_message_bytes = 4096;
constexpr std::size_t most_unheard = 64;
constexpr std::uint32_t most_header_bytes = 16384;
/// Connections that only fetch files, beside those with views.
constexpr std::size_t most_fetching = 64;
constexpr std::chrono::seconds request_deadline{10}, close_deadline{5}, idle_deadline{30};
constexpr std::chrono::milliseconds patience{250};

// ---- Between the threads ------------------------------------------------------------------------

/// Something that coroutines of one thread wait for.
class Bell {
public:
    explicit Bell(const asio::any_io_executor& executor)
        : timer_(executor, asio::steady_timer::time_point::max()) {}
    void ring() { timer_.cancel(); }
    asio::awaitable<void> wait() {
        boost::system::error_code rung;
        co_await timer_.async_wait(asio::redirect_error(asio::use_awaitable, rung));
    }

private:
    asio::steady_timer timer_;
};

/// A browser's viewer on its thread, and what goes to and fro. All public functions are for the
/// gateway's thread.
class Browser : public std::enable_shared_from_this<Browser> {
public:
    Browser(const asio::any_io_executor& executor, const WebViewerConfig& config)
        : executor_(executor), bell_(executor), config_(config) {
        config_.server.tick = [this] { check_wanted(); };
        config_.server.keep_jpeg = true;
    }
    ~Browser() {
        leave();
        if (thread_.joinable()) thread_.join();
    }

    void start() {
        thread_ = std::thread([this, weak = weak_from_this()] { serve(weak); });
    }
    /// The viewer ends soon.
    void leave() {
        const std::scoped_lock lock(mutex_);
        wanted_ = false;
        if (viewer_) viewer_->wake();
    }

    bool listens() const {
        const std::scoped_lock lock(mutex_);
        return unheard_.size() < most_unheard;
    }
    void say(std::string message) {
        const std::scoped_lock lock(mutex_);
        unheard_.push_back(std::move(message));
        if (viewer_) viewer_->wake();
    }
    std::optional<PageMessage> take() {
        const std::scoped_lock lock(mutex_);
        if (news_.empty()) return std::nullopt;
        PageMessage first = std::move(news_.front());
        news_.pop_front();
        return first;
    }
    /// Why there will be no more news.
    std::optional<std::string> ended() const {
        const std::scoped_lock lock(mutex_);
        return ended_;
    }
    /// Returns when any of these may have changed.
    asio::awaitable<void> wait() { return bell_.wait(); }
    void ring() { bell_.ring(); }

private:
    struct Left {};  ///< thrown where the viewer is no longer wanted

    void check_wanted() const {
        const std::scoped_lock lock(mutex_);
        if (!wanted_) throw Left{};
    }

    void serve(const std::weak_ptr<Browser>& weak) {
        std::string reason;
        try {
            view(weak);
        } catch (const Left&) {
        } catch (const std::exception& error) {
            reason = error.what();
        }
        const std::scoped_lock lock(mutex_);
        ended_ = reason;
        ring_from_here(weak);
    }

    [[noreturn]] void view(const std::weak_ptr<Browser>& weak) {
        WebViewer viewer(config_);
        const auto forget = [this](WebViewer*) { set_viewer(nullptr); };
        const std::unique_ptr<WebViewer, decltype(forget)> known(&viewer, forget);
        set_viewer(&viewer);
        for (;;) {
            viewer.hear(take_unheard());
            add(viewer.news(patience));
            ring_from_here(weak);
        }
    }

    void set_viewer(WebViewer* viewer) {
        const std::scoped_lock lock(mutex_);
        viewer_ = viewer;
    }
    std::vector<std::string> take_unheard() {
        const std::scoped_lock lock(mutex_);
        return std::exchange(unheard_, {});
    }
    void add(std::vector<PageMessage> news) {
        const std::scoped_lock lock(mutex_);
        for (PageMessage& message : news) {
            const auto same =
                std::find_if(news_.begin(), news_.end(),
                             [&](const PageMessage& other) { return other.kind == message.kind; });
            if (same == news_.end() || message.kind == PageNews::picture)
                news_.push_back(std::move(message));
            else
                *same = std::move(message);
        }
    }
    void ring_from_here(const std::weak_ptr<Browser>& weak) {
        asio::post(executor_, [weak] {
            if (const auto self = weak.lock()) self->ring();
        });
    }

    asio::any_io_executor executor_;
    Bell bell_;
    WebViewerConfig config_;
    mutable std::mutex mutex_;  ///< guards what follows, but for the thread
    bool wanted_ = true;
    WebViewer* viewer_ = nullptr;
    std::vector<std::string> unheard_;  ///< at most most_unheard
    std::deque<PageMessage> news_;      ///< one of each kind, and few pictures
    std::optional<std::string> ended_;
    std::thread thread_;
};

// ---- HTTP ---------------------------------------------------------------------------------------

std::string_view view_of(boost::core::string_view text) { return {text.data(), text.size()}; }

/// "name" of "name:port", "[::1]:port" and "name".
std::string host_name(std::string_view host) {
    const std::size_t colon = host.rfind(':');
    if (colon != std::string_view::npos && host.find(']', colon) == std::string_view::npos)
        host = host.substr(0, colon);
    if (host.starts_with('[') && host.ends_with(']')) host = host.substr(1, host.size() - 2);
    return std::string(host);
}

/// A page of another site cannot make a browser call us by an address, only by a name whose address
/// it has changed to ours since (DNS rebinding): names must be known.
bool host_is_ours(std::string_view host, const std::vector<std::string>& known) {
    const std::string name = host_name(host);
    boost::system::error_code no_address;
    asio::ip::make_address(name, no_address);
    return !no_address || name == "localhost" ||
           std::find(known.begin(), known.end(), name) != known.end();
}

/// Browsers tell which site a WebSocket is opened from; other sites have no business here.
bool origin_is_ours(const Request& request) {
    const std::string_view origin = view_of(request[http::field::origin]);
    const std::string_view host = view_of(request[http::field::host]);
    return origin == fmt::format("http://{}", host) || origin == fmt::format("https://{}", host);
}

Response answer(const Request& request, http::status status, std::string_view type,
                std::string_view body) {
    Response response{status, request.version()};
    response.set(http::field::server, "tessera-web " TESSERA_VERSION);
    response.set(http::field::content_type, {type.data(), type.size()});
    response.set(http::field::cache_control, "no-cache");
    response.set("X-Content-Type-Options", "nosniff");
    response.set("Referrer-Policy", "no-referrer");
    response.set("Content-Security-Policy",
                 "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'");
    response.body() = {body.data(), body.size()};
    response.keep_alive(request.keep_alive());
    response.prepare_payload();
    if (request.method() == http::verb::head) response.body() = {};
    return response;
}

Response answer(const Request& request, const std::vector<std::string>& hosts) {
    const auto refuse = [&](http::status status, std::string_view reason) {
        return answer(request, status, "text/plain; charset=utf-8", reason);
    };
    if (!host_is_ours(view_of(request[http::field::host]), hosts))
        return refuse(http::status::misdirected_request,
                      "tessera-web does not go by this name: start it with --host NAME\n");
    if (request.method() != http::verb::get && request.method() != http::verb::head)
        return refuse(http::status::method_not_allowed, "only GET and HEAD\n");
    const std::string_view target = view_of(request.target());
    const std::string_view path = target.substr(0, target.find('?'));
    for (const WebFile& file : web_files)
        if (path == file.path) return answer(request, http::status::ok, file.type, file.content);
    return refuse(http::status::not_found, "no such page; there is one at /\n");
}

// ---- The gateway --------------------------------------------------------------------------------

class Gateway {
public:
    Gateway(asio::io_context& io, const WebGatewayConfig& config)
        : io_(io), acceptor_(io), config_(config) {
        const Address address = parse_address(config.listen);
        boost::system::error_code error;
        const auto found =
            tcp::resolver(io).resolve(address.host, address.port, tcp::resolver::passive, error);
        if (error) fail(error.message());
        const tcp::endpoint endpoint = *found.begin();
        if (!config.beyond_loopback && !endpoint.address().is_loopback())
            fail(
                "that is beyond loopback, where anybody could look and edit with this gateway's "
                "keys; if that is meant, add --public");
        acceptor_.open(endpoint.protocol());
        acceptor_.set_option(tcp::acceptor::reuse_address(true));
        if (acceptor_.bind(endpoint, error)) fail(error.message());
        if (acceptor_.listen(asio::socket_base::max_listen_connections, error))
            fail(error.message());
    }

    std::string url() const {
        const tcp::endpoint endpoint = acceptor_.local_endpoint();
        const std::string address = endpoint.address().to_string();
        const std::string host = endpoint.address().is_v6() ? "[" + address + "]" : address;
        return fmt::format("http://{}:{}/", host, endpoint.port());
    }

    void start() {
        asio::co_spawn(io_, accept(), [](std::exception_ptr error) {
            if (error) std::rethrow_exception(error);
        });
    }
    void stop() {
        acceptor_.close();
        for (WebSocket* socket : sockets_) beast::get_lowest_layer(*socket).close();
    }

private:
    [[noreturn]] void fail(const std::string& reason) const {
        throw UserError(fmt::format("--listen {}: {}", config_.listen, reason));
    }

    asio::awaitable<void> accept() {
        while (acceptor_.is_open()) {
            boost::system::error_code error;
            tcp::socket socket =
                co_await acceptor_.async_accept(asio::redirect_error(asio::use_awaitable, error));
            // Of too many, the last finds the door closed.
            if (!error) socket.set_option(tcp::no_delay(true), error);
            if (error || sockets_.size() >= config_.browsers + most_fetching) continue;
            asio::co_spawn(io_, serve(std::move(socket)), asio::detached);
        }
    }

    /// One connection: files, and possibly a view at the end.
    asio::awaitable<void> serve(tcp::socket socket) {
        WebSocket stream(std::move(socket));
        sockets_.insert(&stream);
        try {
            co_await serve_files(stream);
        } catch (const boost::system::system_error&) {
            // The browser has gone, or talks no HTTP.
        } catch (const std::exception& error) {
            spdlog::error("a connection ends: {}", error.what());
        }
        sockets_.erase(&stream);
    }

    asio::awaitable<void> serve_files(WebSocket& stream) {
        beast::tcp_stream& tcp_stream = stream.next_layer();
        beast::flat_buffer buffer;
        for (;;) {
            http::request_parser<http::string_body> parser;
            parser.header_limit(most_header_bytes);
            parser.body_limit(0);
            tcp_stream.expires_after(request_deadline);
            co_await http::async_read(tcp_stream, buffer, parser, asio::use_awaitable);
            const Request request = parser.release();
            if (websocket::is_upgrade(request)) co_return co_await serve_view(stream, request);
            Response response = answer(request, config_.hosts);
            co_await http::async_write(tcp_stream, response, asio::use_awaitable);
            if (!response.keep_alive()) co_return;
        }
    }

    asio::awaitable<void> serve_view(WebSocket& stream, const Request& request) {
        if (!host_is_ours(view_of(request[http::field::host]), config_.hosts) ||
            !origin_is_ours(request)) {
            Response response = answer(request, http::status::forbidden, "text/plain",
                                       "views are for tessera-web's own page\n");
            co_await http::async_write(stream.next_layer(), response, asio::use_awaitable);
            co_return;
        }
        stream.next_layer().expires_never();
        stream.set_option(websocket::stream_base::timeout{.handshake_timeout = close_deadline,
                                                          .idle_timeout = idle_deadline,
                                                          .keep_alive_pings = true});
        stream.read_message_max(most_message_bytes);
        co_await stream.async_accept(request, asio::use_awaitable);
        if (browsers_ >= config_.browsers) {
            const websocket::close_reason full(
                websocket::close_code::try_again_later,
                fmt::format("all {} places are taken", config_.browsers));
            co_return co_await stream.async_close(full, asio::use_awaitable);
        }
        const auto browser = std::make_shared<Browser>(io_.get_executor(), config_.viewer);
        browser->start();
        ++browsers_;
        spdlog::info("a browser joins: {} of {}", browsers_, config_.browsers);
        bool told = false;
        Bell told_bell(io_.get_executor());
        asio::co_spawn(io_, tell(stream, *browser), [&](std::exception_ptr error) {
            if (error) beast::get_lowest_layer(stream).close();
            told = true;
            told_bell.ring();
            browser->ring();
        });
        try {
            co_await hear(stream, *browser);
        } catch (const boost::system::system_error&) {
            // It has gone, or said too much at once.
        }
        // Both ends of the view come to their end before it goes.
        beast::get_lowest_layer(stream).close();
        browser->leave();
        while (!told) {
            browser->ring();
            co_await told_bell.wait();
        }
        while (!browser->ended()) co_await browser->wait();
        --browsers_;
        spdlog::info("a browser leaves: {}", browsers_);
    }

    asio::awaitable<void> hear(WebSocket& stream, Browser& browser) {
        beast::flat_buffer buffer;
        for (;;) {
            co_await stream.async_read(buffer, asio::use_awaitable);
            while (!browser.listens() && !browser.ended()) co_await browser.wait();
            // What comes while the close frame is under way has no one to hear it.
            if (!browser.ended()) browser.say(beast::buffers_to_string(buffer.data()));
            buffer.clear();
        }
    }

    asio::awaitable<void> tell(WebSocket& stream, Browser& browser) {
        for (;;) {
            if (const auto message = browser.take()) {
                const bool picture = message->kind == PageNews::picture;
                if (picture) {
                    const std::string coming =
                        fmt::format("{{\"coming\": {}}}", message->bytes.size());
                    stream.binary(false);
                    co_await stream.async_write(asio::buffer(coming), asio::use_awaitable);
                }
                stream.binary(picture);
                co_await stream.async_write(asio::buffer(message->bytes), asio::use_awaitable);
            } else if (const auto reason = browser.ended()) {
                co_return co_await say_goodbye(stream, *reason);
            } else {
                co_await browser.wait();
            }
        }
    }

    asio::awaitable<void> say_goodbye(WebSocket& stream, std::string reason) {
        if (!reason.empty()) spdlog::info("a browser's view ends: {}", reason);
        // What a close frame holds: little text, and UTF-8.
        if (reason.size() > 120) reason = reason.substr(0, 117) + "...";
        for (char& c : reason)
            if (c < ' ' || c > '~') c = '?';
        const websocket::close_reason farewell(websocket::close_code::policy_error, reason);
        co_await stream.async_close(farewell, asio::use_awaitable);
    }

    asio::io_context& io_;
    tcp::acceptor acceptor_;
    WebGatewayConfig config_;
    std::set<WebSocket*> sockets_;
    std::size_t browsers_ = 0;
};

}  // namespace

void run_web_gateway(const WebGatewayConfig& config,
                     const std::function<void(const std::string& url)>& listening) {
    asio::io_context io(1);
    Gateway gateway(io, config);
    asio::signal_set signals(io, SIGINT, SIGTERM);
    signals.async_wait([&](const boost::system::error_code&, int) { gateway.stop(); });
    gateway.start();
    listening(gateway.url());
    io.run();
}

}  // namespace tessera
