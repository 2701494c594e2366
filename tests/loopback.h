// Coroutines under test: two peers over loopback TCP, both in one io_context on this thread.
#pragma once

#include <gtest/gtest.h>

#include <exception>
#include <utility>

#include "common/connection.h"

namespace tessera {

/// Runs `body()`, a coroutine, and everything it starts; rethrows what it throws. A test that hangs
/// is ended by ctest's time limit.
template <class Body>
void run(asio::io_context& io, Body body) {
    std::exception_ptr failure;
    asio::co_spawn(io, std::move(body), [&](std::exception_ptr error) { failure = error; });
    io.run();
    if (failure) std::rethrow_exception(failure);
}

/// Runs `body(a, b)` with the two ends of a TCP connection.
template <class Body>
void run_sockets(Body body) {
    asio::io_context io;
    tcp::acceptor acceptor(io, {asio::ip::address_v4::loopback(), 0});
    tcp::socket a(io);
    a.connect(acceptor.local_endpoint());
    tcp::socket b = acceptor.accept();
    run(io, [&] { return body(std::move(a), std::move(b)); });
}

struct Pair {
    std::shared_ptr<Connection> a, b;
};

/// Runs `body(pair)` with two connections that talk to each other.
template <class Body>
void run_pair(Body body, const ConnectionConfig& config = {}) {
    run_sockets([&](tcp::socket a, tcp::socket b) {
        return body(Pair{std::make_shared<Connection>(std::move(a), config),
                         std::make_shared<Connection>(std::move(b), config)});
    });
}

}  // namespace tessera
