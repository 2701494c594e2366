// What those who run a server want to know, at a port of its own. No more HTTP than that takes.
//
//   GET /metrics            for Prometheus, in its text format (version 0.0.4)
//   GET /healthz            200 while the server answers at all
//   GET /readyz             200 once it lets peers in; its scenes are loaded by then
//   GET /readyz?workers=N   200 while it also has N workers; else 503
#pragma once

#include <functional>
#include <string>

#include "common/connection.h"

namespace tessera {

/// The status in Prometheus' text format.
std::string metrics_text(const Status& status);

/// The whole answer to a request that begins with this head.
std::string http_answer(const std::string& head, const std::function<Status()>& status);

/// Lives on the server's strand.
class MetricsEndpoint {
public:
    /// Listens at once. Throws UserError naming the address.
    MetricsEndpoint(asio::io_context& io, const std::string& listen,
                    std::function<Status()> status);
    void stop();
    tcp::endpoint address() const { return acceptor_.local_endpoint(); }

private:
    asio::awaitable<void> accept_readers();
    asio::awaitable<void> answer(tcp::socket socket);

    tcp::acceptor acceptor_;
    std::function<Status()> status_;
    int readers_ = 0;
};

}  // namespace tessera
