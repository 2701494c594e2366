// Two connections over loopback in one io_context: order, precedence, bounds and faults.

#include "common/connection.h"

#include <gtest/gtest.h>

#include <set>

#include "common/check.h"
#include "tests/loopback.h"
#include "tests/random_message.h"

namespace tessera {
namespace {

using namespace std::chrono_literals;

/// A message of `size` payload bytes that carries `number`.
Message bulk(std::uint64_t number, std::size_t size) {
    const auto bytes = std::make_shared<const Bytes>(size);
    BlobChunk chunk{.blob = {}, .offset = 0, .total = size};
    chunk.blob.digest[0] = std::uint8_t(number);
    return {chunk, {bytes, *bytes}};
}

TEST(Connection, every_message_arrives_as_it_was_sent) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        RandomMessage random(1);
        for (int round = 0; round < 20; ++round)
            for (std::size_t kind = 0; kind < RandomMessage::kinds; ++kind) {
                const Message sent = random.make(kind);
                pair.a->send(sent);
                const Message received = co_await pair.b->receive();
                EXPECT_TRUE(received.body == sent.body);
                EXPECT_TRUE(std::ranges::equal(received.payload.bytes, sent.payload.bytes));
            }
    });
}

TEST(Connection, order_holds_within_a_lane_and_control_overtakes_bulk) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        // The first message is on its way before anything else can be queued.
        constexpr std::uint64_t count = 50;
        for (std::uint64_t i = 0; i < count; ++i) pair.a->send_bulk(bulk(i, chunk_bytes));
        for (std::uint64_t i = 0; i < count; ++i) pair.a->send({Ping{i}, {}});
        std::uint64_t pings = 0, chunks = 0, chunks_before_last_ping = 0;
        while (pings + chunks < 2 * count) {
            const Message message = co_await pair.b->receive();
            if (const auto* ping = message.get<Ping>()) {
                EXPECT_EQ(ping->stamp, pings++);
                chunks_before_last_ping = chunks;
            } else {
                EXPECT_EQ(message.get<BlobChunk>()->blob.digest[0], chunks++);
            }
        }
        EXPECT_LE(chunks_before_last_ping, 1u);
    });
}

TEST(Connection, a_peer_that_does_not_read_is_disconnected) {
    run_pair(
        [](Pair pair) -> asio::awaitable<void> {
            for (int i = 0; i < 1000 && pair.a->open(); ++i)
                pair.a->send_bulk(bulk(0, chunk_bytes));
            EXPECT_FALSE(pair.a->open());
            EXPECT_EQ(pair.a->queued_bytes(), 0u);
            EXPECT_THROW(co_await pair.a->receive(), ProtocolError);
            EXPECT_THROW(co_await pair.a->wait_until_drained(0), boost::system::system_error);
            pair.a->send({Ping{1}, {}});
        },
        {.max_queued_bytes = 10u << 20});
}

TEST(Connection, a_single_message_is_never_too_large_for_the_queue) {
    run_pair(
        [](Pair pair) -> asio::awaitable<void> {
            pair.a->send(bulk(7, chunk_bytes));
            const Message message = co_await pair.b->receive();
            EXPECT_EQ(message.payload.bytes.size(), chunk_bytes);
        },
        {.max_queued_bytes = 1000});
}

TEST(Connection, draining_bounds_what_waits) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        constexpr int count = 100;
        const auto feed = [](std::shared_ptr<Connection> to) -> asio::awaitable<void> {
            for (int i = 0; i < count; ++i) {
                co_await to->wait_until_drained(chunk_bytes);
                to->send_bulk(bulk(0, chunk_bytes));
                EXPECT_LE(to->queued_bytes(), 2 * chunk_bytes + 1000);
            }
        };
        asio::co_spawn(co_await asio::this_coro::executor, feed(pair.a), asio::detached);
        for (int i = 0; i < count; ++i) co_await pair.b->receive();
        co_await pair.a->wait_until_drained(0);
        EXPECT_EQ(pair.a->queued_bytes(), 0u);
    });
}

TEST(Connection, silence_ends_the_session) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        EXPECT_THROW(co_await pair.a->receive(1ms), ProtocolError);
        EXPECT_FALSE(pair.a->open());
    });
}

TEST(Connection, a_peer_that_takes_nothing_ends_the_session) {
    run_pair(
        [](Pair pair) -> asio::awaitable<void> {
            for (int i = 0; i < 100; ++i) pair.a->send_bulk(bulk(0, chunk_bytes));
            EXPECT_THROW(co_await pair.a->receive(), ProtocolError);
        },
        {.write_deadline = 1ms});
}

TEST(Connection, garbage_is_a_protocol_error) {
    run_sockets([](tcp::socket a, tcp::socket b) -> asio::awaitable<void> {
        const auto connection = std::make_shared<Connection>(std::move(a));
        const std::string request = "GET / HTTP/1.1\r\nHost: example\r\n\r\n";
        co_await asio::async_write(b, asio::buffer(request), asio::use_awaitable);
        EXPECT_THROW(co_await connection->receive(), ProtocolError);
        EXPECT_FALSE(connection->open());
    });
}

TEST(Connection, a_stranger_gets_no_memory) {
    run_sockets([](tcp::socket a, tcp::socket b) -> asio::awaitable<void> {
        const auto connection = std::make_shared<Connection>(
            std::move(a), ConnectionConfig{},
            FrameLimits{.message_bytes = max_hello_bytes, .payload_bytes = 0});
        const auto header = encode(FrameHeader{.kind = 1, .message_bytes = max_hello_bytes + 1});
        co_await asio::async_write(b, asio::buffer(header), asio::use_awaitable);
        EXPECT_THROW(co_await connection->receive(), ProtocolError);
    });
}

TEST(Connection, who_was_let_in_hears_why_he_is_dropped) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        pair.a->admit({.message_bytes = 10, .payload_bytes = 100, .option = "--max-words"});
        pair.b->send({FrameEnd{1}, {}});
        EXPECT_TRUE((co_await pair.a->receive()).get<FrameEnd>());
        pair.b->send({Failure{.request = 0, .reason = std::string(20, 'x')}, {}});
        // More than fits the buffers of a socket, so that the peer is still writing when it hears.
        for (int i = 0; i < 100; ++i) pair.b->send_bulk(bulk(0, chunk_bytes));
        EXPECT_THROW(co_await pair.a->receive(), ProtocolError);
        EXPECT_FALSE(pair.a->open());
        pair.a->close();
        const Message last = co_await pair.b->receive();
        const auto* refused = last.get<Refused>();
        EXPECT_TRUE(refused);
        if (!refused) co_return;
        EXPECT_NE(refused->reason.find("--max-words"), std::string::npos) << refused->reason;
    });
}

TEST(Connection, a_peer_that_leaves_is_a_lost_connection) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        pair.b->close();
        EXPECT_THROW(co_await pair.a->receive(), boost::system::system_error);
        EXPECT_FALSE(pair.a->open());
    });
}

TEST(Connection, closing_ends_a_receive_that_waits) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        asio::post(co_await asio::this_coro::executor, [&] { pair.a->close(); });
        EXPECT_THROW(co_await pair.a->receive(), boost::system::system_error);
    });
}

TEST(Connection, last_words_are_sent_before_closing) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        for (int i = 0; i < 20; ++i) pair.a->send_bulk(bulk(0, chunk_bytes));
        pair.a->send({Refused{"go away"}, {}});
        asio::co_spawn(co_await asio::this_coro::executor, pair.a->close_when_sent(),
                       asio::detached);
        bool refused = false;
        for (int i = 0; i < 21; ++i)
            if ((co_await pair.b->receive()).get<Refused>()) refused = true;
        EXPECT_TRUE(refused);
        EXPECT_THROW(co_await pair.b->receive(), boost::system::system_error);
        EXPECT_FALSE(pair.a->open());
    });
}

TEST(Connection, what_is_queued_is_sent_after_its_owner_let_go) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        for (std::uint64_t i = 0; i < 100; ++i) pair.a->send_bulk(bulk(i, chunk_bytes));
        pair.a.reset();
        for (std::uint64_t i = 0; i < 100; ++i)
            EXPECT_EQ((co_await pair.b->receive()).get<BlobChunk>()->blob.digest[0], i);
    });
}

TEST(Connection, nobody_listening_is_a_clear_user_error) {
    asio::io_context io;
    tcp::acceptor closed(io, {asio::ip::address_v4::loopback(), 0});
    const std::string port = std::to_string(closed.local_endpoint().port());
    closed.close();
    run(io, [&]() -> asio::awaitable<void> {
        try {
            co_await connect({"127.0.0.1", port});
            ADD_FAILURE();
        } catch (const UserError& error) {
            EXPECT_EQ(error.what(), "cannot reach 127.0.0.1:" + port +
                                        ": Connection refused; is tessera-server running there?");
        }
    });
}

TEST(Connection, connect_reaches_a_listener) {
    asio::io_context io;
    tcp::acceptor acceptor(io, {asio::ip::address_v4::loopback(), 0});
    const std::string port = std::to_string(acceptor.local_endpoint().port());
    run(io, [&]() -> asio::awaitable<void> {
        const auto out = co_await connect({"localhost", port});
        const auto in =
            std::make_shared<Connection>(co_await acceptor.async_accept(asio::use_awaitable));
        EXPECT_EQ(out->remote_address(), "127.0.0.1:" + port);
        out->send({Ping{5}, {}});
        EXPECT_EQ((co_await in->receive()).get<Ping>()->stamp, 5u);
    });
}

TEST(Address, parses_hosts_names_and_ipv6) {
    EXPECT_EQ(parse_address("localhost:9100"), (Address{"localhost", "9100"}));
    EXPECT_EQ(parse_address("10.0.0.1:0"), (Address{"10.0.0.1", "0"}));
    EXPECT_EQ(parse_address("[::1]:65535"), (Address{"::1", "65535"}));
    for (const char* bad : {"", "host", "host:", ":80", "host:http", "host:65536", "::1:80",
                            "host:-1", "host:123456", "[]:80"})
        EXPECT_THROW(parse_address(bad), UserError) << bad;
}

}  // namespace
}  // namespace tessera
