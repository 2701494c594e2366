#include "server/metrics_endpoint.h"

#include <fmt/format.h>

#include <charconv>
#include <memory>
#include <optional>
#include <string_view>

#include "common/check.h"
#include "common/log.h"

namespace tessera {
namespace {

using boost::system::error_code;

/// Readers at a time; more are turned away.
constexpr int most_readers = 16;
constexpr std::size_t max_request_bytes = 8u << 10;
/// For asking and answering together.
constexpr auto reader_deadline = std::chrono::seconds(5);

std::string escaped(const std::string& label) {
    std::string out;
    for (const char c : label) {
        if (c == '"' || c == '\\') out += '\\';
        out += c;
    }
    return out;
}

void describe(std::string& out, const char* name, const char* type, const char* help) {
    out += fmt::format("# HELP {} {}\n# TYPE {} {}\n", name, help, name, type);
}

template <class T>
void add(std::string& out, const char* name, const char* type, const char* help, T value) {
    describe(out, name, type, help);
    out += fmt::format("{} {}\n", name, value);
}

/// One line for each worker.
template <class F>
void add_each(std::string& out, const Status& status, const char* name, const char* type,
              const char* help, const F& value_of) {
    describe(out, name, type, help);
    for (const WorkerStatus& worker : status.workers)
        out += fmt::format("{}{{peer=\"{}\",worker=\"{}\"}} {}\n", name, worker.peer,
                           escaped(worker.name), value_of(worker));
}

/// The path that a GET asks for; empty when the head is something else.
std::string_view path_of(std::string_view head) {
    constexpr std::string_view get = "GET ";
    if (!head.starts_with(get)) return {};
    head.remove_prefix(get.size());
    return head.substr(0, head.find(' '));
}

/// The number after "/readyz?workers=", if that is what the path is.
std::optional<std::uint32_t> workers_asked_for(std::string_view path) {
    constexpr std::string_view question = "/readyz?workers=";
    if (!path.starts_with(question)) return std::nullopt;
    path.remove_prefix(question.size());
    std::uint32_t count = 0;
    const auto [end, error] = std::from_chars(path.data(), path.data() + path.size(), count);
    if (error != std::errc{} || end != path.data() + path.size()) return std::nullopt;
    return count;
}

struct Answer {
    const char* code = "200 OK";
    std::string body;
};

Answer answer_to(std::string_view path, const std::function<Status()>& status) {
    if (path == "/metrics" || path == "/") return {.body = metrics_text(status())};
    // Whoever is answered has come to a server that runs its loop: it listens, its scenes are
    // there.
    if (path == "/healthz" || path == "/readyz") return {.body = "ok\n"};
    if (const auto wanted = workers_asked_for(path)) {
        const std::size_t here = status().workers.size();
        return {here >= *wanted ? "200 OK" : "503 Service Unavailable",
                fmt::format("{} workers of {}\n", here, *wanted)};
    }
    return {"404 Not Found", "there are /metrics, /healthz, /readyz and /readyz?workers=N\n"};
}

}  // namespace

std::string metrics_text(const Status& status) {
    std::string out;
    add(out, "tessera_uptime_seconds", "gauge", "Since the server started.", status.uptime_seconds);
    add(out, "tessera_viewers", "gauge", "Viewers connected.", status.viewers);
    add(out, "tessera_workers", "gauge", "Workers connected.", status.workers.size());
    add(out, "tessera_frames_in_flight", "gauge", "Frames asked for and not finished.",
        status.frames_in_flight);
    add(out, "tessera_frames_done_total", "counter", "Frames finished.", status.frames_done);
    add(out, "tessera_memory_bytes", "gauge", "The server's resident memory.", status.memory_bytes);
    using W = const WorkerStatus&;
    add_each(out, status, "tessera_worker_threads", "gauge", "Render threads.",
             [](W w) { return w.threads; });
    add_each(out, status, "tessera_worker_leases", "gauge", "Tiles handed out and not returned.",
             [](W w) { return w.leases; });
    add_each(out, status, "tessera_worker_prefetch", "gauge", "Tiles that it may hold.",
             [](W w) { return w.prefetch; });
    add_each(out, status, "tessera_worker_tiles_total", "counter", "Tiles returned and used.",
             [](W w) { return w.tiles; });
    add_each(out, status, "tessera_worker_rays_total", "counter", "Rays traced for them.",
             [](W w) { return w.rays; });
    add_each(out, status, "tessera_worker_round_trip_seconds", "gauge", "Of the last ping.",
             [](W w) { return w.round_trip_seconds; });
    add_each(out, status, "tessera_worker_task_seconds", "gauge", "What a tile takes a thread.",
             [](W w) { return w.task_seconds; });
    add_each(out, status, "tessera_worker_memory_bytes", "gauge", "Resident memory.",
             [](W w) { return w.memory_bytes; });
    add_each(out, status, "tessera_worker_overdue", "gauge", "1: has let a lease expire.",
             [](W w) { return int(w.overdue); });
    return out;
}

std::string http_answer(const std::string& head, const std::function<Status()>& status) {
    const Answer answer = answer_to(path_of(head), status);
    return fmt::format(
        "HTTP/1.1 {}\r\nContent-Type: text/plain; version=0.0.4\r\nContent-Length: {}\r\n"
        "Connection: close\r\n\r\n{}",
        answer.code, answer.body.size(), answer.body);
}

MetricsEndpoint::MetricsEndpoint(asio::io_context& io, const std::string& listen,
                                 std::function<Status()> status)
    : acceptor_(io), status_(std::move(status)) {
    const Address address = parse_address(listen);
    try {
        const auto found =
            tcp::resolver(io).resolve(address.host, address.port, tcp::resolver::passive);
        acceptor_ = tcp::acceptor(io, found.begin()->endpoint());
    } catch (const boost::system::system_error& error) {
        throw UserError(fmt::format("--metrics {}: {}; choose another address or port", listen,
                                    error.code().message()));
    }
    asio::co_spawn(io, accept_readers(), asio::detached);
}

void MetricsEndpoint::stop() {
    error_code ignored;
    acceptor_.close(ignored);
}

asio::awaitable<void> MetricsEndpoint::accept_readers() {
    while (acceptor_.is_open()) {
        error_code error;
        tcp::socket socket =
            co_await acceptor_.async_accept(asio::redirect_error(asio::use_awaitable, error));
        if (error || readers_ >= most_readers) continue;
        asio::co_spawn(acceptor_.get_executor(), answer(std::move(socket)), asio::detached);
    }
}

asio::awaitable<void> MetricsEndpoint::answer(tcp::socket socket) {
    ++readers_;
    // Shared with the timer, which may fire when this coroutine is over.
    const auto reader = std::make_shared<tcp::socket>(std::move(socket));
    asio::steady_timer deadline(reader->get_executor(), reader_deadline);
    deadline.async_wait([reader](const error_code& cancelled) {
        error_code ignored;
        if (!cancelled) reader->close(ignored);
    });
    error_code error;
    std::string head;
    co_await asio::async_read_until(*reader, asio::dynamic_buffer(head, max_request_bytes),
                                    "\r\n\r\n", asio::redirect_error(asio::use_awaitable, error));
    if (!error) {
        const std::string text = http_answer(head, status_);
        co_await asio::async_write(*reader, asio::buffer(text),
                                   asio::redirect_error(asio::use_awaitable, error));
    }
    reader->close(error);
    --readers_;
}

}  // namespace tessera
