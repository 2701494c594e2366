#include "server/metrics_endpoint.h"

#include <fmt/format.h>
#include <prometheus/text_serializer.h>

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

using prometheus::ClientMetric;
using prometheus::MetricFamily;
using prometheus::MetricType;

MetricFamily family(const char* name, MetricType type, const char* help) {
    return {.name = name, .help = help, .type = type, .metric = {}};
}

/// The library reads the field of the family's type.
ClientMetric metric(double value) {
    ClientMetric out;
    out.gauge.value = out.counter.value = value;
    return out;
}

MetricFamily one(const char* name, MetricType type, const char* help, double value) {
    MetricFamily out = family(name, type, help);
    out.metric.push_back(metric(value));
    return out;
}

template <class F>
MetricFamily of_each_worker(const Status& status, const char* name, MetricType type,
                            const char* help, const F& value_of) {
    MetricFamily out = family(name, type, help);
    for (const WorkerStatus& worker : status.workers) {
        out.metric.push_back(metric(double(value_of(worker))));
        out.metric.back().label = {{"peer", std::to_string(worker.peer)}, {"worker", worker.name}};
    }
    return out;
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

struct Reply {
    const char* code = "200 OK";
    std::string body;
};

Reply answer_to(std::string_view path, const std::function<Status()>& status) {
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
    using W = const WorkerStatus&;
    return prometheus::TextSerializer().Serialize({
        one("tessera_uptime_seconds", MetricType::Gauge, "Since the server started.",
            status.uptime_seconds),
        one("tessera_viewers", MetricType::Gauge, "Viewers connected.", double(status.viewers)),
        one("tessera_workers", MetricType::Gauge, "Workers connected.",
            double(status.workers.size())),
        one("tessera_frames_in_flight", MetricType::Gauge, "Frames asked for and not finished.",
            double(status.frames_in_flight)),
        one("tessera_frames_done_total", MetricType::Counter, "Frames finished.",
            double(status.frames_done)),
        one("tessera_memory_bytes", MetricType::Gauge, "The server's resident memory.",
            double(status.memory_bytes)),
        of_each_worker(status, "tessera_worker_threads", MetricType::Gauge, "Render threads.",
                       [](W w) { return w.threads; }),
        of_each_worker(status, "tessera_worker_leases", MetricType::Gauge,
                       "Tiles handed out and not returned.", [](W w) { return w.leases; }),
        of_each_worker(status, "tessera_worker_prefetch", MetricType::Gauge,
                       "Tiles that it may hold.", [](W w) { return w.prefetch; }),
        of_each_worker(status, "tessera_worker_tiles_total", MetricType::Counter,
                       "Tiles returned and used.", [](W w) { return w.tiles; }),
        of_each_worker(status, "tessera_worker_rays_total", MetricType::Counter,
                       "Rays traced for them.", [](W w) { return w.rays; }),
        of_each_worker(status, "tessera_worker_busy_seconds_total", MetricType::Counter,
                       "Of its threads, spent on tiles.", [](W w) { return w.busy_seconds; }),
        of_each_worker(status, "tessera_worker_round_trip_seconds", MetricType::Gauge,
                       "Of the last ping.", [](W w) { return w.round_trip_seconds; }),
        of_each_worker(status, "tessera_worker_task_seconds", MetricType::Gauge,
                       "What a tile takes a thread.", [](W w) { return w.task_seconds; }),
        of_each_worker(status, "tessera_worker_relayed_bytes_total", MetricType::Counter,
                       "Of meshes and textures, sent to other workers.",
                       [](W w) { return double(w.relayed_bytes); }),
        of_each_worker(status, "tessera_worker_sent_bytes_total", MetricType::Counter,
                       "Sent to it by the server.", [](W w) { return double(w.sent_bytes); }),
        of_each_worker(status, "tessera_worker_memory_bytes", MetricType::Gauge, "Resident memory.",
                       [](W w) { return w.memory_bytes; }),
        of_each_worker(status, "tessera_worker_overdue", MetricType::Gauge,
                       "1: has let a lease expire.", [](W w) { return int(w.overdue); }),
    });
}

std::string http_answer(const std::string& head, const std::function<Status()>& status) {
    const Reply answer = answer_to(path_of(head), status);
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
