// Laws of relays: the server sends each blob once however many workers ask, nobody passes anything
// on more than twice, and whatever a peer does, the worker has the right bytes or asks the server.

#include "common/relay.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <bit>
#include <limits>

#include "server/relay_plan.h"
#include "tests/loopback.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

// ---- The server's plan --------------------------------------------------------------------------

/// About 100 Mbit/s.
constexpr LinkSpeed thin{12.5e6, 0.2e-3};

struct Asked {
    BlobStore store;
    std::vector<BlobId> ids;

    explicit Asked(std::size_t bytes, int count = 1) {
        for (int i = 0; i < count; ++i) ids.push_back(store.insert(Bytes(bytes, std::byte(i + 1))));
    }
};

TEST(RelayPlan, the_server_sends_once_and_nobody_is_far_from_it) {
    for (const int workers : {2, 3, 16, 100}) {
        RelayPlan plan(RelayMode::automatic);
        for (int i = 1; i <= workers; ++i) plan.add_worker(std::uint64_t(i), true);
        const Asked asked(200000, 3);
        std::map<std::uint64_t, int> hops, passed_on;
        for (int i = 1; i <= workers; ++i) {
            const auto shares = plan.share(std::uint64_t(i), asked.ids, asked.store, thin);
            ASSERT_EQ(shares.size(), 1u);
            EXPECT_EQ(shares[0].blobs, asked.ids);
            EXPECT_EQ(shares[0].bytes, std::vector<std::uint64_t>(3, 200000));
            const std::uint64_t peer = shares[0].peer;
            EXPECT_EQ(peer == 0, i == 1);
            if (peer != 0) {
                ASSERT_TRUE(hops.contains(peer)) << "it has asked before";
                EXPECT_LE(++passed_on[peer], 2);
                hops[std::uint64_t(i)] = hops[peer] + 1;
            } else {
                hops[1] = 0;
            }
            EXPECT_LE(hops[std::uint64_t(i)], std::bit_width(unsigned(workers)) - 1);
        }
    }
}

TEST(RelayPlan, relays_only_where_it_pays) {
    constexpr double infinite = std::numeric_limits<double>::infinity();
    EXPECT_TRUE(relaying_pays(200000, 2, thin));
    EXPECT_TRUE(relaying_pays(200000, 16, thin));
    EXPECT_FALSE(relaying_pays(1000, 16, thin)) << "a small blob";
    EXPECT_FALSE(relaying_pays(200000, 16, {12.5e6, 0.1})) << "peers are far away";
    EXPECT_FALSE(relaying_pays(1u << 30, 1000, {infinite, 0})) << "loopback";
    EXPECT_FALSE(relaying_pays(1u << 30, 1000, {})) << "speed not known";
    EXPECT_FALSE(relaying_pays(1u << 30, 1, thin)) << "nobody to relay";
}

TEST(RelayPlan, asks_only_those_who_are_there_and_can) {
    const auto senders = [](RelayPlan& plan, const Asked& asked, std::uint64_t worker) {
        std::vector<std::uint64_t> out;
        for (const auto& share : plan.share(worker, asked.ids, asked.store, thin))
            out.push_back(share.peer);
        return out;
    };
    using Peers = std::vector<std::uint64_t>;
    const Asked asked(200000);
    RelayPlan plan(RelayMode::on);
    plan.add_worker(1, true);
    plan.add_worker(2, false);
    plan.add_worker(3, true);
    plan.add_worker(4, true);
    EXPECT_EQ(senders(plan, asked, 1), Peers{0});
    EXPECT_EQ(senders(plan, asked, 2), Peers{0}) << "takes no part";
    EXPECT_EQ(senders(plan, asked, 3), Peers{1});
    plan.remove_worker(1);
    EXPECT_EQ(senders(plan, asked, 4), Peers{3});
    RelayPlan off(RelayMode::off);
    off.add_worker(1, true);
    off.add_worker(2, true);
    EXPECT_EQ(senders(off, asked, 1), Peers{0});
    EXPECT_EQ(senders(off, asked, 2), Peers{0});
}

TEST(RelayPlan, nobody_is_sent_twice_to_whom_he_could_not_reach) {
    RelayPlan plan(RelayMode::on);
    for (const std::uint64_t worker : {1, 2, 3}) plan.add_worker(worker, true);
    for (int i = 0; i < 4; ++i) {
        const Asked asked(std::size_t(200000 + i));
        EXPECT_EQ(plan.share(1, asked.ids, asked.store, thin)[0].peer, 0u);
        EXPECT_EQ(plan.share(2, asked.ids, asked.store, thin)[0].peer, i == 0 ? 1u : 0u);
        EXPECT_EQ(plan.share(3, asked.ids, asked.store, thin)[0].peer, 1u);
        if (i == 0) plan.failed(2, 1);
    }
}

TEST(RelayPlan, three_failures_are_enough) {
    RelayPlan plan(RelayMode::on);
    for (const std::uint64_t worker : {1, 2, 3, 4, 5}) plan.add_worker(worker, true);
    for (int i = 0; i < 4; ++i) {
        const Asked asked(std::size_t(200000 + i));
        const auto asks = std::uint64_t(2 + i);
        EXPECT_EQ(plan.share(1, asked.ids, asked.store, thin)[0].peer, 0u);
        EXPECT_EQ(plan.share(asks, asked.ids, asked.store, thin)[0].peer, i < 3 ? 1u : 0u);
        plan.failed(asks, 1);
        plan.failed(asks, 77);  // gone already
    }
}

// ---- The workers' side --------------------------------------------------------------------------

using namespace std::chrono_literals;

/// A worker's relay and what it holds; the connection is the one to its server.
struct Node {
    std::shared_ptr<Connection> server;
    std::shared_ptr<SceneReceiver> receiver = std::make_shared<SceneReceiver>();
    std::shared_ptr<Relay> relay;
    asio::steady_timer changed;

    Node(std::shared_ptr<Connection> connection, const std::string& token,
         const RelayKeys& keys = {}, const RelayPatience& patience = {})
        : server(std::move(connection)),
          relay(Relay::listen(*server, keys, 0, patience)),
          changed(server->executor(), std::chrono::steady_clock::time_point::max()) {
        relay->begin(token, receiver, server, [this] { changed.cancel(); });
    }
    ~Node() {
        relay->close();
        server->close();
    }

    asio::awaitable<void> change() {
        boost::system::error_code cancelled;
        co_await changed.async_wait(asio::redirect_error(asio::use_awaitable, cancelled));
    }
};

/// A scene of one mesh, which is a blob of several chunks.
struct OneMesh {
    BlobStore blobs;
    BlobId id;
    SceneVersion version;

    OneMesh() : id(blobs.insert(noise())), version{.version = 1, .scene = {}} {
        version.scene.meshes.push_back(id);
    }
    static Bytes noise() {
        Bytes bytes(3 * chunk_bytes - 100);
        for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = std::byte(i * i >> 5);
        return bytes;
    }
    SceneUpdate update() const { return {.scene = "s", .delta = diff(SceneVersion{}, version)}; }
    std::vector<Message> chunks() const { return chunks_of(id, blobs.find(id)); }
    BlobSource source(std::uint16_t port) const {
        return {.peer = 7,
                .address = "127.0.0.1:" + std::to_string(port),
                .blobs = {id},
                .bytes = {blobs.find(id)->size()}};
    }
};

void feed(Node& node, const Message& chunk) {
    node.receiver->add(*chunk.get<BlobChunk>(), chunk.payload.bytes);
    node.relay->arrived();
}

TEST(Relay, passes_on_what_is_still_coming) {
    const OneMesh scene;
    run_pair([&](Pair pair) -> asio::awaitable<void> {
        Node giver(pair.b, "token"), taker(pair.a, "token");
        giver.receiver->update(scene.update());
        taker.receiver->update(scene.update());
        const std::vector<Message> chunks = scene.chunks();
        taker.relay->pull(scene.source(giver.relay->port()));
        feed(giver, chunks[0]);
        while (taker.receiver->part(scene.id)->bytes.size() < chunk_bytes) co_await taker.change();
        EXPECT_FALSE(taker.receiver->take_ready());
        feed(giver, chunks[1]);
        feed(giver, chunks[2]);
        std::optional<ReadyScene> ready;
        while (!(ready = taker.receiver->take_ready())) co_await taker.change();
        EXPECT_EQ(*ready->blobs.find(scene.id), *scene.blobs.find(scene.id));
        EXPECT_EQ(giver.relay->bytes_sent(), ready->blobs.bytes());
    });
}

enum class Fault { nobody_there, other_token, not_held, liar, rambler, dies, mute, silent };

/// Takes everything and says nothing, until the other side has had enough.
asio::awaitable<void> listen_only(std::shared_ptr<Connection> peer) {
    for (;;) co_await peer->receive();
}

/// A peer that lets in whoever comes and then breaks the rules.
asio::awaitable<void> misbehave(tcp::acceptor& acceptor, Fault fault, const OneMesh& scene) {
    const auto peer =
        std::make_shared<Connection>(co_await acceptor.async_accept(asio::use_awaitable));
    if (fault == Fault::mute) co_await listen_only(peer);
    co_await peer->receive();
    Welcome welcome;
    peer->send({welcome, {}});
    if (fault == Fault::silent) co_await listen_only(peer);
    co_await peer->receive();
    std::vector<Message> chunks = scene.chunks();
    if (fault == Fault::liar) {
        const auto wrong = std::make_shared<Bytes>(chunks[1].payload.bytes.size());
        chunks[1].payload = {wrong, *wrong};
    }
    if (fault == Fault::rambler) std::swap(chunks[0], chunks[1]);
    if (fault == Fault::dies) chunks.pop_back();
    for (const Message& chunk : chunks) peer->send_bulk(chunk);
    co_await peer->close_when_sent();
}

TEST(Relay, whatever_a_peer_does_the_server_is_asked) {
    const OneMesh scene;
    for (const Fault fault : {Fault::nobody_there, Fault::other_token, Fault::not_held, Fault::liar,
                              Fault::rambler, Fault::dies, Fault::mute, Fault::silent}) {
        RelayPatience patience;
        if (fault == Fault::mute) patience.handshake = 20ms;
        if (fault == Fault::silent) patience.silence = 20ms;
        run_pair([&](Pair pair) -> asio::awaitable<void> {
            Node giver(pair.b, fault == Fault::other_token ? "other" : "token");
            Node taker(pair.a, "token", {}, patience);
            tcp::acceptor acceptor(pair.a->executor(), {asio::ip::address_v4::loopback(), 0});
            std::uint16_t port = acceptor.local_endpoint().port();
            if (fault == Fault::nobody_there) acceptor.close();
            if (fault == Fault::other_token || fault == Fault::not_held)
                port = giver.relay->port();
            else if (fault != Fault::nobody_there)
                asio::co_spawn(pair.a->executor(), misbehave(acceptor, fault, scene),
                               [](std::exception_ptr) {});
            taker.receiver->update(scene.update());
            taker.relay->pull(scene.source(port));
            const Message asked = co_await pair.b->receive();
            const BlobRequest expected{.scene = "s", .blobs = {scene.id}, .failed_peer = 7};
            if (!asked.get<BlobRequest>()) throw std::runtime_error("a request was expected");
            EXPECT_EQ(*asked.get<BlobRequest>(), expected) << int(fault);
            for (const Message& chunk : scene.chunks()) feed(taker, chunk);
            const auto ready = taker.receiver->take_ready();
            if (!ready) throw std::runtime_error("the scene is not whole");
            EXPECT_EQ(*ready->blobs.find(scene.id), *scene.blobs.find(scene.id));
        });
    }
}

/// Takes a mesh by relay; returns whether it came, else the server was asked for it.
bool relays(const RelayKeys& givers, const RelayKeys& takers) {
    const OneMesh scene;
    bool came = false, asked = false;
    run_pair([&](Pair pair) -> asio::awaitable<void> {
        Node giver(pair.b, "token", givers), taker(pair.a, "token", takers);
        giver.receiver->know(scene.blobs);
        taker.receiver->update(scene.update());
        const auto server = [&]() -> asio::awaitable<void> {
            co_await pair.b->receive();
            asked = true;
            taker.changed.cancel();
        };
        asio::co_spawn(pair.b->executor(), server, [](std::exception_ptr) {});
        taker.relay->pull(scene.source(giver.relay->port()));
        while (!came && !asked) {
            co_await taker.change();
            came = taker.receiver->take_ready().has_value();
        }
        EXPECT_EQ(giver.relay->bytes_sent(), came ? scene.blobs.bytes() : 0);
    });
    return came;
}

TEST(Relay, only_workers_of_the_same_keys_give_and_get) {
    const TempDir temp;
    make_keys(temp.file("ours"));
    make_keys(temp.file("theirs"));
    const RelayKeys ours = load_credentials(temp.file("ours/worker")).relay,
                    theirs = load_credentials(temp.file("theirs/worker")).relay;
    const auto server_of_ours =
        std::make_shared<const Tls>(temp.file("ours/server"), Tls::Side::peer);
    EXPECT_TRUE(relays(ours, ours));
    EXPECT_FALSE(relays(ours, theirs));
    EXPECT_FALSE(relays(theirs, ours));
    EXPECT_FALSE(relays(ours, {})) << "no certificate";
    EXPECT_FALSE(relays({}, ours));
    EXPECT_FALSE(relays(ours, {nullptr, server_of_ours})) << "of our authority, but no worker's";
}

TEST(Relay, what_no_scene_needs_any_more_is_not_asked_for) {
    const OneMesh scene;
    SceneReceiver receiver;
    receiver.update(scene.update());
    SceneVersion empty{.version = 2, .scene = {}};
    receiver.update({.scene = "s", .delta = diff(scene.version, empty)});
    EXPECT_TRUE(receiver.ask_again(std::vector{scene.id}).empty());
    EXPECT_FALSE(receiver.part(scene.id));
}

}  // namespace
}  // namespace tessera
