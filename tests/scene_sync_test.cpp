// Laws of scene transfer: any scene reaches the other side equal, each blob once; whatever a peer
// does out of order is refused.

#include "common/scene_sync.h"

#include <gtest/gtest.h>

#include <random>

#include "tests/loopback.h"

namespace tessera {
namespace {

/// A version of a scene whose meshes are blobs drawn from a small pool, so that versions share
/// some.
struct Version {
    SceneVersion scene;
    BlobStore blobs;
};

class RandomVersions {
public:
    explicit RandomVersions(unsigned seed) : random_(seed) {}

    Version make(std::uint64_t version) {
        Version out{.scene = {.version = version, .scene = {}}, .blobs = {}};
        const std::uint32_t meshes = 1 + below(5);
        for (std::uint32_t i = 0; i < meshes; ++i) {
            out.scene.scene.meshes.push_back(out.blobs.insert(blob(below(20))));
            out.scene.scene.objects.push_back({.name = "object", .mesh = i, .materials = {}});
        }
        for (std::uint32_t i = below(9); i > 0; --i)
            out.scene.scene.instances.push_back({.name = "i", .object = below(meshes)});
        return out;
    }

private:
    /// Of up to three chunks, the last one of any length; number 0 is empty.
    static Bytes blob(std::uint32_t number) {
        return Bytes(std::size_t(number) * chunk_bytes / 7, std::byte(number));
    }
    std::uint32_t below(std::uint32_t n) { return std::uint32_t(random_() % n); }
    std::mt19937 random_;
};

SceneUpdate update_between(const SceneVersion& base, const SceneVersion& next) {
    return {.scene = "scene", .delta = diff(base, next)};
}

void deliver(SceneReceiver& receiver, const BlobStore& from, const BlobId& id) {
    for (const Message& m : chunks_of(id, from.find(id)))
        receiver.add(*m.get<BlobChunk>(), m.payload.bytes);
}

void deliver(SceneReceiver& receiver, const BlobStore& from, const BlobRequest& request) {
    for (const BlobId& id : request.blobs) deliver(receiver, from, id);
}

TEST(SceneSync, every_version_arrives_whole_and_each_blob_once) {
    RandomVersions random(1);
    SceneReceiver receiver;
    SceneVersion held;
    std::set<BlobId> sent;
    for (std::uint64_t version = 1; version <= 200; ++version) {
        const Version next = random.make(version);
        const BlobRequest request = receiver.update(update_between(held, next.scene));
        for (const BlobId& id : request.blobs) EXPECT_TRUE(sent.insert(id).second);
        EXPECT_EQ(receiver.take_ready().has_value(), request.blobs.empty());
        deliver(receiver, next.blobs, request);
        if (const auto ready = receiver.take_ready()) {
            EXPECT_EQ(*ready->scene, next.scene);
            EXPECT_EQ(ready->blobs.size(), blobs_of(next.scene.scene).size());
            for (const BlobId& id : blobs_of(next.scene.scene))
                EXPECT_EQ(*ready->blobs.find(id), *next.blobs.find(id));
        }
        EXPECT_EQ(*receiver.find("scene"), next.scene);
        EXPECT_FALSE(receiver.take_ready());
        held = next.scene;
    }
}

TEST(SceneSync, an_overtaken_version_is_never_reported) {
    RandomVersions random(2);
    SceneReceiver receiver;
    const Version first = random.make(1);
    const Version second = random.make(2);
    const BlobRequest one = receiver.update(update_between({}, first.scene));
    const BlobRequest two = receiver.update(update_between(first.scene, second.scene));
    deliver(receiver, first.blobs, one);
    deliver(receiver, second.blobs, two);
    const auto ready = receiver.take_ready();
    ASSERT_TRUE(ready);
    EXPECT_EQ(ready->scene->version, 2u);
    EXPECT_FALSE(receiver.take_ready());
}

TEST(SceneSync, scenes_share_blobs_on_their_way) {
    RandomVersions random(3);
    SceneReceiver receiver;
    const Version version = random.make(1);
    const SceneDelta delta = diff({}, version.scene);
    const BlobRequest request = receiver.update({.scene = "one", .delta = delta});
    EXPECT_TRUE(receiver.update({.scene = "two", .delta = delta}).blobs.empty());
    deliver(receiver, version.blobs, request);
    EXPECT_EQ(receiver.take_ready()->name, "one");
    EXPECT_EQ(receiver.take_ready()->name, "two");
}

TEST(SceneSync, a_held_scene_is_continued_without_its_blobs) {
    RandomVersions random(4);
    const Version held = random.make(5);
    Version next = held;
    next.scene.version = 6;
    next.scene.scene.objects[0].name = "renamed";
    SceneReceiver receiver;
    receiver.hold("scene", held.scene, held.blobs);
    EXPECT_FALSE(receiver.take_ready());
    EXPECT_TRUE(receiver.update(update_between(held.scene, next.scene)).blobs.empty());
    EXPECT_EQ(*receiver.take_ready()->scene, next.scene);
}

TEST(SceneSync, a_delta_from_version_zero_replaces_the_scene) {
    RandomVersions random(5);
    SceneReceiver receiver;
    const Version first = random.make(7);
    const Version second = random.make(3);
    deliver(receiver, first.blobs, receiver.update(update_between({}, first.scene)));
    deliver(receiver, second.blobs, receiver.update(update_between({}, second.scene)));
    EXPECT_EQ(*receiver.take_ready()->scene, second.scene);
}

TEST(SceneSync, a_delta_from_another_version_is_refused) {
    RandomVersions random(6);
    SceneReceiver receiver;
    const Version first = random.make(7);
    receiver.update(update_between({}, first.scene));
    const SceneUpdate wrong = update_between(random.make(6).scene, random.make(8).scene);
    EXPECT_THROW(receiver.update(wrong), ProtocolError);
}

/// A receiver that waits for one blob of three chunks.
struct Waiting {
    SceneReceiver receiver;
    std::shared_ptr<const Bytes> blob;
    BlobId id;
    std::vector<Message> chunks;

    explicit Waiting(const SceneLimits& limits = {}) : receiver(limits) {
        BlobStore store;
        id = store.insert(Bytes(2 * chunk_bytes + 5, std::byte(3)));
        blob = store.find(id);
        chunks = chunks_of(id, blob);
        SceneVersion next{.version = 1, .scene = {}};
        next.scene.meshes.push_back(id);
        EXPECT_EQ(receiver.update(update_between({}, next)).blobs, std::vector{id});
    }
    void add(std::size_t chunk) {
        receiver.add(*chunks[chunk].get<BlobChunk>(), chunks[chunk].payload.bytes);
    }
};

TEST(SceneSync, chunks_cover_the_blob_without_copies) {
    const Waiting waiting;
    ASSERT_EQ(waiting.chunks.size(), 3u);
    std::size_t offset = 0;
    for (const Message& chunk : waiting.chunks) {
        EXPECT_EQ(chunk.get<BlobChunk>()->offset, offset);
        EXPECT_EQ(chunk.payload.bytes.data(), waiting.blob->data() + offset);
        offset += chunk.payload.bytes.size();
    }
    EXPECT_EQ(offset, waiting.blob->size());
}

TEST(SceneSync, chunks_out_of_order_are_refused) {
    EXPECT_THROW(Waiting().add(1), ProtocolError);
    Waiting repeated;
    repeated.add(0);
    EXPECT_THROW(repeated.add(0), ProtocolError);
    Waiting skipped;
    skipped.add(0);
    EXPECT_THROW(skipped.add(2), ProtocolError);
}

TEST(SceneSync, wrong_content_is_refused) {
    Waiting waiting;
    const Bytes wrong(10, std::byte(9));
    const BlobChunk chunk{.blob = waiting.id, .offset = 0, .total = 10};
    EXPECT_THROW(waiting.receiver.add(chunk, wrong), ProtocolError);
}

TEST(SceneSync, blobs_nobody_asked_for_are_refused) {
    Waiting waiting;
    for (std::size_t i = 0; i < 3; ++i) waiting.add(i);
    EXPECT_TRUE(waiting.receiver.take_ready());
    EXPECT_THROW(waiting.add(0), ProtocolError);
    EXPECT_THROW(waiting.receiver.add({.blob = {}, .offset = 0, .total = 0}, {}), ProtocolError);
}

TEST(SceneSync, sizes_that_disagree_are_refused) {
    Waiting waiting;
    waiting.add(0);
    BlobChunk longer = *waiting.chunks[1].get<BlobChunk>();
    longer.total += 1;
    EXPECT_THROW(waiting.receiver.add(longer, waiting.chunks[1].payload.bytes), ProtocolError);
    Waiting overrun;
    const Bytes ten(10);
    EXPECT_THROW(overrun.receiver.add({.blob = overrun.id, .offset = 0, .total = 9}, ten),
                 ProtocolError);
}

TEST(SceneSync, limits_are_checked_before_anything_is_kept) {
    Waiting waiting({.scenes = 1, .blob_bytes = 2 * chunk_bytes});
    EXPECT_THROW(waiting.add(0), ProtocolError);
    const BlobChunk huge{.blob = waiting.id, .offset = 0, .total = ~std::uint64_t(0)};
    EXPECT_THROW(waiting.receiver.add(huge, {}), ProtocolError);
    EXPECT_THROW(waiting.receiver.update({.scene = "second", .delta = diff({}, {1, {}})}),
                 ProtocolError);
}

TEST(SceneSync, earlier_blobs_make_room_when_it_is_needed) {
    Waiting waiting({.scenes = 1, .blob_bytes = 3 * chunk_bytes});
    for (std::size_t i = 0; i < 3; ++i) waiting.add(i);
    BlobStore store;
    SceneVersion next{.version = 2, .scene = {}};
    next.scene.meshes.push_back(store.insert(Bytes(3 * chunk_bytes, std::byte(1))));
    deliver(waiting.receiver, store, waiting.receiver.update(update_between({}, next)));
    EXPECT_TRUE(waiting.receiver.take_ready());
    EXPECT_EQ(waiting.receiver.blobs().size(), 1u);
}

TEST(SceneSync, what_is_found_elsewhere_need_not_come) {
    Waiting waiting;
    BlobStore elsewhere;
    elsewhere.insert(*waiting.blob);
    elsewhere.insert(Bytes(5));
    waiting.receiver.supply(elsewhere);
    EXPECT_TRUE(waiting.receiver.ask_again(std::vector{waiting.id}).empty());
    const auto ready = waiting.receiver.take_ready();
    ASSERT_TRUE(ready);
    EXPECT_EQ(*ready->blobs.find(waiting.id), *waiting.blob);
    EXPECT_EQ(waiting.receiver.blobs().size(), 1u) << "nobody has asked for the other one";
    EXPECT_THROW(waiting.add(0), ProtocolError);
}

TEST(SceneSync, what_has_begun_to_come_comes_to_its_end) {
    Waiting waiting;
    waiting.add(0);
    BlobStore elsewhere;
    elsewhere.insert(*waiting.blob);
    waiting.receiver.supply(elsewhere);
    EXPECT_FALSE(waiting.receiver.take_ready());
    waiting.add(1);
    waiting.add(2);
    EXPECT_TRUE(waiting.receiver.take_ready());
}

TEST(SceneSync, what_is_found_elsewhere_must_have_room) {
    Waiting waiting({.scenes = 1, .blob_bytes = 2 * chunk_bytes});
    BlobStore elsewhere;
    elsewhere.insert(*waiting.blob);
    EXPECT_THROW(waiting.receiver.supply(elsewhere), ProtocolError);
}

TEST(SceneSync, a_dropped_scene_frees_its_blobs) {
    Waiting waiting;
    for (std::size_t i = 0; i < 3; ++i) waiting.add(i);
    waiting.receiver.drop("scene");
    EXPECT_EQ(waiting.receiver.blobs().size(), 0u);
    EXPECT_EQ(waiting.receiver.find("scene"), nullptr);
    EXPECT_FALSE(waiting.receiver.take_ready());
}

/// Takes updates and chunks, answers requests, until version `last` is whole.
asio::awaitable<SceneVersion> receive_until(std::shared_ptr<Connection> connection,
                                            std::uint64_t last) {
    SceneReceiver receiver;
    for (;;) {
        const Message message = co_await connection->receive();
        if (const auto* update = message.get<SceneUpdate>())
            connection->send({receiver.update(*update), {}});
        else if (const auto* chunk = message.get<BlobChunk>())
            receiver.add(*chunk, message.payload.bytes);
        const auto ready = receiver.take_ready();
        if (ready && ready->scene->version == last) co_return *ready->scene;
    }
}

TEST(SceneSync, a_scene_crosses_a_connection) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        const auto serve = [](std::shared_ptr<Connection> to) -> asio::awaitable<void> {
            const Version version = RandomVersions(8).make(1);
            to->send({update_between({}, version.scene), {}});
            const Message answer = co_await to->receive();
            co_await send_blobs(to, version.blobs, answer.get<BlobRequest>()->blobs);
        };
        asio::co_spawn(co_await asio::this_coro::executor, serve(pair.a), asio::detached);
        EXPECT_EQ(co_await receive_until(pair.b, 1), RandomVersions(8).make(1).scene);
    });
}

TEST(SceneSync, control_messages_pass_a_large_transfer) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        const auto transfer = [](std::shared_ptr<Connection> to) -> asio::awaitable<void> {
            BlobStore store;
            const BlobId id = store.insert(Bytes(64 * chunk_bytes));
            co_await send_blobs(to, store, std::vector<BlobId>(1, id));
        };
        asio::co_spawn(co_await asio::this_coro::executor, transfer(pair.a), asio::detached);
        co_await pair.b->receive();
        pair.a->send({Ping{1}, {}});
        // What the sockets' buffers hold is out of reach; the other chunks must wait.
        int before = 0;
        while (!(co_await pair.b->receive()).get<Ping>()) ++before;
        EXPECT_LT(before, 60);
    });
}

TEST(SceneSync, a_request_for_an_unknown_blob_is_refused) {
    run_pair([](Pair pair) -> asio::awaitable<void> {
        EXPECT_THROW(co_await send_blobs(pair.a, BlobStore(), std::vector<BlobId>(1)),
                     ProtocolError);
    });
}

}  // namespace
}  // namespace tessera
