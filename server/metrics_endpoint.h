// What Prometheus wants to know, at a port of its own: GET /metrics answers in its text format
// (version 0.0.4). No more HTTP than that takes.
#pragma once

#include <functional>
#include <string>

#include "common/connection.h"

namespace tessera {

/// The status in Prometheus' text format.
std::string metrics_text(const Status& status);

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
