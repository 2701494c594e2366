// Keys and TLS: what one side says the other hears, and who has not proven himself hears nothing.

#include "common/keys.h"

#include <gtest/gtest.h>

#include "common/check.h"
#include "tests/loopback.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;

/// Keys made once: for all tests, and those of a stranger.
class KeysTest : public testing::Test {
protected:
    static void SetUpTestSuite() {
        temp_ = new TempDir;
        make_keys(ours());
        make_keys(theirs());
    }
    static void TearDownTestSuite() { delete temp_; }

    static fs::path ours() { return temp_->file("ours"); }
    static fs::path theirs() { return temp_->file("theirs"); }

    static std::string failure_of(const std::function<void()>& action) {
        try {
            action();
        } catch (const UserError& error) {
            return error.what();
        }
        return "nothing failed";
    }

private:
    static inline TempDir* temp_;
};

/// Whether both sides of a connection come to speak TLS.
bool agree(const fs::path& server, const fs::path& client) {
    bool agreed = true;
    run_pair([&](Pair pair) -> asio::awaitable<void> {
        const Tls tls_of_server(server, Tls::Side::server),
            tls_of_client(client, Tls::Side::client);
        const auto attempt = [&agreed](std::shared_ptr<Connection> connection,
                                       const Tls& tls) -> asio::awaitable<void> {
            try {
                co_await connection->secure(tls);
                connection->send({Ping{1}, {}});
                co_await connection->receive();
            } catch (const boost::system::system_error&) {
                agreed = false;
            }
        };
        asio::co_spawn(pair.a->executor(), attempt(pair.a, tls_of_server), asio::detached);
        co_await attempt(pair.b, tls_of_client);
        while (pair.a.use_count() > 1) co_await asio::post(pair.a->executor(), asio::use_awaitable);
    });
    return agreed;
}

TEST_F(KeysTest, only_those_of_one_authority_and_each_on_its_side_agree) {
    EXPECT_TRUE(agree(ours() / "server", ours() / "worker"));
    EXPECT_TRUE(agree(ours() / "server", ours() / "viewer"));
    EXPECT_FALSE(agree(ours() / "server", theirs() / "worker"));
    EXPECT_FALSE(agree(ours() / "server", theirs() / "viewer"));
    EXPECT_FALSE(agree(ours() / "worker", ours() / "viewer"));  // a worker that plays the server
}

TEST_F(KeysTest, a_server_that_hangs_up_is_busy_and_one_of_other_keys_a_stranger) {
    asio::io_context io;
    tcp::acceptor acceptor(io, {asio::ip::address_v4::loopback(), 0});
    const std::string port = std::to_string(acceptor.local_endpoint().port());
    const auto tls = std::make_shared<const Tls>(ours() / "viewer", Tls::Side::client);
    const auto complaint = [&]() -> asio::awaitable<std::string> {
        try {
            co_await connect({"127.0.0.1", port}, tls);
        } catch (const UserError& error) {
            co_return error.what();
        }
        co_return "connected";
    };
    run(io, [&]() -> asio::awaitable<void> {
        asio::co_spawn(
            io,
            [&]() -> asio::awaitable<void> { co_await acceptor.async_accept(asio::use_awaitable); },
            asio::detached);
        const std::string busy = co_await complaint();
        EXPECT_NE(busy.find("busy"), std::string::npos) << busy;
        EXPECT_EQ(busy.find("these keys"), std::string::npos) << busy;

        const Tls other(theirs() / "server", Tls::Side::server);
        asio::co_spawn(
            io,
            [&]() -> asio::awaitable<void> {
                const auto peer = std::make_shared<Connection>(
                    co_await acceptor.async_accept(asio::use_awaitable));
                co_await peer->secure(other);
            },
            [](std::exception_ptr) {});
        const std::string stranger = co_await complaint();
        EXPECT_NE(stranger.find("these keys"), std::string::npos) << stranger;
    });
}

TEST_F(KeysTest, messages_arrive_as_they_were_sent) {
    run_pair([&](Pair pair) -> asio::awaitable<void> {
        const Tls tls_of_server(ours() / "server", Tls::Side::server);
        const Tls tls_of_worker(ours() / "worker", Tls::Side::client);
        asio::co_spawn(pair.b->executor(), pair.b->secure(tls_of_worker), asio::detached);
        EXPECT_TRUE(co_await pair.a->peer_begins_tls());
        co_await pair.a->secure(tls_of_server);
        EXPECT_EQ(pair.a->peer_name(), worker_common_name);
        const auto pixels = std::make_shared<std::vector<std::byte>>(200'000, std::byte{7});
        pair.a->send({Ping{5}, {}});
        pair.a->send(
            {BlobChunk{.blob = {}, .offset = 3, .total = 1'000'000}, {pixels, std::span(*pixels)}});
        const Message ping = co_await pair.b->receive();
        EXPECT_TRUE(ping.get<Ping>() && ping.get<Ping>()->stamp == 5);
        const Message chunk = co_await pair.b->receive();
        EXPECT_TRUE(chunk.get<BlobChunk>() && chunk.get<BlobChunk>()->offset == 3);
        EXPECT_TRUE(std::ranges::equal(chunk.payload.bytes, *pixels));
    });
}

TEST_F(KeysTest, plain_peers_are_told_apart) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        pair.b->send({Ping{1}, {}});
        EXPECT_FALSE(co_await pair.a->peer_begins_tls());
        const Message message = co_await pair.a->receive();
        EXPECT_TRUE(message.get<Ping>());
    });
}

TEST_F(KeysTest, tokens_of_folders_are_those_of_the_server) {
    const ServerKeys server = load_server_keys(ours() / "server");
    EXPECT_EQ(server.tokens.size(), std::size(grant_names));
    for (const Grant grant : {Grant::worker, Grant::viewer, Grant::editor}) {
        const Credentials own = load_credentials(ours() / grant_names[int(grant)]);
        EXPECT_EQ(server.tokens.at(own.token), grant);
        EXPECT_FALSE(
            server.tokens.contains(load_credentials(theirs() / grant_names[int(grant)]).token));
    }
}

TEST_F(KeysTest, nobody_else_can_read_them) {
    for (const auto& entry : fs::recursive_directory_iterator(ours()))
        EXPECT_EQ(entry.status().permissions() & (fs::perms::group_all | fs::perms::others_all),
                  fs::perms::none)
            << entry.path();
}

TEST_F(KeysTest, a_key_that_others_can_read_is_refused) {
    const TempDir temp;
    const fs::path folder = temp.file("worker");
    fs::copy(ours() / "worker", folder);
    fs::permissions(folder / "private.key", fs::perms::others_read, fs::perm_options::add);
    const std::string reason = failure_of([&] { load_credentials(folder); });
    EXPECT_NE(reason.find("chmod 600"), std::string::npos) << reason;
}

TEST_F(KeysTest, what_is_missing_is_named) {
    const TempDir temp;
    const std::string folder = failure_of([&] { load_credentials(temp.file("none")); });
    EXPECT_NE(folder.find("none/token"), std::string::npos) << folder;
    const std::string twice = failure_of([] { make_keys(ours()); });
    EXPECT_NE(twice.find("exists already"), std::string::npos) << twice;
    temp.write("tokens", "king 123\n");
    fs::permissions(temp.file("tokens"), fs::perms::owner_all);
    const std::string role = failure_of([&] { load_server_keys(temp.file("")); });
    EXPECT_NE(role.find("no role 'king'"), std::string::npos) << role;
}

}  // namespace
}  // namespace tessera
