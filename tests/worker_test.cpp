// A real worker against a server made of a few coroutines, over loopback TCP.

#include "worker/worker.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <functional>

#include "common/check.h"
#include "common/generator.h"
#include "common/tile_codec.h"
#include "tests/loopback.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

namespace fs = std::filesystem;

/// The server's side of one test; the worker runs beside it and both end with it.
class FakeServer {
public:
    FakeServer() : acceptor_(io_, {asio::ip::address_v4::loopback(), 0}) {}

    WorkerConfig worker_config() const {
        return {.server = {"127.0.0.1", std::to_string(acceptor_.local_endpoint().port())},
                .threads = 2,
                .name = "test",
                .credentials = {"secret", nullptr},
                .attempts = std::nullopt};
    }

    /// Runs a worker and `script`, a coroutine; ends both when the script is over.
    template <class Script>
    void run_with_worker(Script script) {
        run_with_worker(worker_config(), std::move(script));
    }
    template <class Script>
    void run_with_worker(const WorkerConfig& config, Script script) {
        Worker worker(config);
        asio::co_spawn(io_, worker.run(), [](std::exception_ptr) {});
        std::exception_ptr failure;
        asio::co_spawn(io_, std::move(script), [&](std::exception_ptr error) {
            failure = error;
            io_.stop();
        });
        io_.run();
        if (failure) std::rethrow_exception(failure);
    }

    /// Runs a worker until it gives up; returns why.
    template <class Script>
    std::string reason_to_give_up(const WorkerConfig& config, Script script) {
        Worker worker(config);
        std::exception_ptr failure;
        asio::co_spawn(io_, script, asio::detached);
        asio::co_spawn(io_, worker.run(), [&](std::exception_ptr error) {
            failure = error;
            io_.stop();
        });
        io_.run();
        try {
            std::rethrow_exception(failure);
        } catch (const UserError& error) {
            return error.what();
        }
    }

    asio::awaitable<std::shared_ptr<Connection>> accept() {
        co_return std::make_shared<Connection>(
            co_await acceptor_.async_accept(asio::use_awaitable));
    }

    /// Accepts a worker and welcomes it.
    asio::awaitable<std::shared_ptr<Connection>> accept_worker() {
        const auto worker = co_await accept();
        const Message hello = co_await worker->receive();
        EXPECT_TRUE(hello.get<Hello>());
        Welcome welcome;
        worker->send({welcome, {}});
        co_return worker;
    }

    void stop_accepting() { acceptor_.close(); }

private:
    asio::io_context io_;
    tcp::acceptor acceptor_;
};

/// The next message of type T; anything else fails the test.
template <class T>
asio::awaitable<T> expect(std::shared_ptr<Connection> from) {
    const Message message = co_await from->receive();
    if (!message.get<T>()) throw std::runtime_error("another message was expected");
    co_return *message.get<T>();
}

SceneVersion version_of(const SceneBundle& bundle, std::uint64_t version) {
    return {.version = version, .scene = bundle.scene};
}

/// Sends a scene and waits until the worker has built it.
asio::awaitable<void> send_scene(std::shared_ptr<Connection> to, SceneBundle bundle) {
    const SceneVersion empty;
    to->send({SceneUpdate{.scene = "s", .delta = diff(empty, version_of(bundle, 1))}, {}});
    const BlobRequest request = co_await expect<BlobRequest>(to);
    co_await send_blobs(to, bundle.blobs, request.blobs);
    const SceneReady ready = co_await expect<SceneReady>(to);
    EXPECT_EQ(ready.version, 1u);
}

FrameSpec small_frame(const SceneBundle& bundle, std::uint64_t number) {
    FrameSpec spec{.frame = number,
                   .scene = std::string("s"),
                   .version = 1,
                   .size = {40, 24},
                   .camera = {},
                   .settings = {},
                   .extra = {}};
    spec.camera = bundle.scene.cameras.at(0);
    spec.settings.integrator = Integrator::path;
    return spec;
}

Message tasks_of(std::vector<TileTask> tasks) { return {TileTasks{std::move(tasks)}, {}}; }

/// Receives until tiles come; on the way a frame may report what it made the worker build.
asio::awaitable<Message> next_tiles(std::shared_ptr<Connection> from) {
    for (;;) {
        Message message = co_await from->receive();
        if (message.get<TileResults>()) co_return message;
        if (!message.get<SceneReady>()) throw std::runtime_error("a tile was expected");
    }
}

TEST(Worker, introduces_itself) {
    FakeServer server;
    server.run_with_worker([&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept();
        const Hello hello = co_await expect<Hello>(worker);
        EXPECT_EQ(hello.role, Role::worker);
        EXPECT_EQ(hello.protocol, protocol_version);
        EXPECT_EQ(hello.threads, 2u);
        EXPECT_EQ(hello.name, "test");
        EXPECT_EQ(hello.token, "secret");
    });
}

TEST(Worker, renders_two_frames_at_once_as_the_renderer_does) {
    FakeServer server;
    const SceneBundle bundle = *generate_scene("cornell");
    Renderer reference(bundle.scene, bundle.blobs, {.threads = 1});
    server.run_with_worker([&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept_worker();
        co_await send_scene(worker, bundle);
        const std::uint32_t tiles = tile_count(small_frame(bundle, 1).size);
        for (const std::uint64_t frame : {7, 8}) {
            reference.begin_frame(small_frame(bundle, frame));
            worker->send({FrameBegin{small_frame(bundle, frame)}, {}});
        }
        std::vector<TileTask> tasks;
        for (std::uint32_t tile = 0; tile < tiles; ++tile)
            for (const std::uint64_t frame : {7, 8})
                tasks.push_back({.frame = frame, .tile = tile, .pass_count = 2});
        worker->send(tasks_of(tasks));
        std::set<TileTask> answered;
        while (answered.size() < 2 * tiles) {
            const Message message = co_await next_tiles(worker);
            auto pixels = message.payload.bytes;
            for (const TileReport& tile : message.get<TileResults>()->tiles) {
                EXPECT_TRUE(answered.insert(tile.task).second);
                const FrameSpec spec = small_frame(bundle, tile.task.frame);
                const auto expected = reference.render(tile.task);
                EXPECT_TRUE(std::ranges::equal(
                    pixels.first(tile.pixel_bytes),
                    pack_tile(tile_channels(spec), tile_rect(spec.size, tile.task.tile).pixels(),
                              expected->data)));
                pixels = pixels.subspan(tile.pixel_bytes);
            }
        }
    });
}

TEST(Worker, ignores_tasks_of_unknown_frames_and_answers_pings) {
    FakeServer server;
    server.run_with_worker([&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept_worker();
        worker->send(tasks_of({{.frame = 99}}));
        worker->send({FrameEnd{98}, {}});
        worker->send({Ping{5}, {}});
        const Pong pong = co_await expect<Pong>(worker);
        EXPECT_EQ(pong.stamp, 5u);
    });
}

TEST(Worker, an_ended_frame_gives_no_more_tiles) {
    FakeServer server;
    const SceneBundle bundle = *generate_scene("cornell");
    server.run_with_worker([&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept_worker();
        co_await send_scene(worker, bundle);
        worker->send({FrameBegin{small_frame(bundle, 1)}, {}});
        worker->send(tasks_of({{.frame = 1}}));
        worker->send({FrameEnd{1}, {}});
        worker->send({FrameBegin{small_frame(bundle, 2)}, {}});
        worker->send(tasks_of({{.frame = 2}}));
        const Message message = co_await next_tiles(worker);
        EXPECT_EQ(message.get<TileResults>()->tiles.at(0).task.frame, 2u);
    });
}

TEST(Worker, says_when_it_cannot_do_what_is_asked) {
    FakeServer server;
    const SceneBundle bundle = *generate_scene("cornell");
    server.run_with_worker([&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept_worker();
        worker->send({FrameBegin{small_frame(bundle, 3)}, {}});
        const Failure unknown = co_await expect<Failure>(worker);
        EXPECT_EQ(unknown.request, 3u);
        EXPECT_EQ(unknown.reason, "scene 's' version 1 is not held");

        SceneBundle broken;
        broken.scene.meshes.push_back(broken.blobs.insert(Bytes(10)));
        broken.scene.objects.push_back({});
        broken.scene.instances.push_back({});
        const SceneVersion empty;
        worker->send({SceneUpdate{.scene = "s", .delta = diff(empty, version_of(broken, 1))}, {}});
        co_await expect<BlobRequest>(worker);
        co_await send_blobs(worker, broken.blobs, broken.scene.meshes);
        const Failure failure = co_await expect<Failure>(worker);
        EXPECT_EQ(failure.request, 0u);
        EXPECT_TRUE(failure.reason.starts_with("scene 's' version 1: ")) << failure.reason;
    });
}

TEST(Worker, comes_back_when_the_connection_is_lost) {
    FakeServer server;
    server.run_with_worker([&]() -> asio::awaitable<void> {
        for (int i = 0; i < 3; ++i) {
            const auto worker = co_await server.accept_worker();
            worker->close();
        }
    });
}

TEST(Worker, keeps_meshes_when_the_connection_is_lost) {
    FakeServer server;
    const SceneBundle bundle = *generate_scene("cornell");
    server.run_with_worker([&]() -> asio::awaitable<void> {
        auto worker = co_await server.accept_worker();
        co_await send_scene(worker, bundle);
        worker->close();

        worker = co_await server.accept_worker();
        const SceneVersion empty;
        worker->send({SceneUpdate{.scene = "s", .delta = diff(empty, version_of(bundle, 1))}, {}});
        const BlobRequest request = co_await expect<BlobRequest>(worker);
        EXPECT_TRUE(request.blobs.empty());
        co_await expect<SceneReady>(worker);
    });
}

/// How many files are in the folder, and none of them is being written.
std::size_t whole_files(const fs::path& folder) {
    std::size_t count = 0;
    for (const auto& file : fs::directory_iterator(folder)) {
        if (file.path().extension() != ".blob") return 0;
        ++count;
    }
    return count;
}

TEST(Worker, asks_for_nothing_that_is_on_disk) {
    const TempDir folder;
    const fs::path cache = folder.file("cache");
    const SceneBundle bundle = *generate_scene("cornell");
    const auto run_worker = [&](auto script) {
        FakeServer server;
        WorkerConfig config = server.worker_config();
        config.blob_cache = cache;
        server.run_with_worker(config, [&]() -> asio::awaitable<void> {
            co_await script(co_await server.accept_worker());
        });
    };
    using Peer = std::shared_ptr<Connection>;
    run_worker([&](Peer worker) -> asio::awaitable<void> {
        co_await send_scene(worker, bundle);
        while (whole_files(cache) < bundle.blobs.size()) {
            worker->send({Ping{1}, {}});
            co_await expect<Pong>(worker);
        }
    });
    // Another worker, and one file is damaged.
    fs::resize_file(cache / (full_name(bundle.scene.meshes[0]) + ".blob"), 7);
    run_worker([&](Peer worker) -> asio::awaitable<void> {
        const SceneDelta delta = diff(SceneVersion{}, version_of(bundle, 1));
        worker->send({SceneUpdate{.scene = "s", .delta = delta}, {}});
        const BlobRequest request = co_await expect<BlobRequest>(worker);
        EXPECT_EQ(request.blobs, std::vector{bundle.scene.meshes[0]});
        co_await send_blobs(worker, bundle.blobs, request.blobs);
        co_await expect<SceneReady>(worker);
        worker->send({SceneUpdate{.scene = "t", .delta = delta}, {}});
        EXPECT_TRUE((co_await expect<BlobRequest>(worker)).blobs.empty());
        co_await expect<SceneReady>(worker);
    });
}

TEST(Worker, a_broken_protocol_costs_the_session_only) {
    FakeServer server;
    const SceneBundle bundle = *generate_scene("cornell");
    server.run_with_worker([&]() -> asio::awaitable<void> {
        auto worker = co_await server.accept_worker();
        worker->send({StatusRequest{}, {}});
        EXPECT_THROW(co_await worker->receive(), boost::system::system_error);

        worker = co_await server.accept_worker();
        co_await send_scene(worker, bundle);
        worker->send({FrameBegin{small_frame(bundle, 1)}, {}});
        worker->send(tasks_of({{.frame = 1, .tile = 1000}}));
        EXPECT_THROW(co_await next_tiles(worker), boost::system::system_error);

        worker = co_await server.accept_worker();
        co_await send_scene(worker, bundle);
    });
}

TEST(Worker, a_refusal_is_final) {
    FakeServer server;
    const auto refuse = [&]() -> asio::awaitable<void> {
        const auto worker = co_await server.accept();
        co_await worker->receive();
        Refused refused;
        refused.reason = "wrong token";
        worker->send({refused, {}});
        co_await worker->close_when_sent();
    };
    const std::string reason = server.reason_to_give_up(server.worker_config(), refuse);
    EXPECT_NE(reason.find("refuses this worker: wrong token"), std::string::npos) << reason;
}

TEST(Worker, gives_up_after_the_attempts_allowed) {
    FakeServer server;
    WorkerConfig config = server.worker_config();
    config.attempts = 2;
    server.stop_accepting();
    const auto nothing = []() -> asio::awaitable<void> { co_return; };
    const std::string reason = server.reason_to_give_up(config, nothing);
    EXPECT_NE(reason.find("gave up after 2 attempts"), std::string::npos) << reason;
}

TEST(Worker, waits_longer_after_every_failure_up_to_a_bound) {
    using namespace std::chrono_literals;
    EXPECT_EQ(retry_delay(0, 0), 100ms);
    EXPECT_EQ(retry_delay(3, 0), 800ms);
    EXPECT_EQ(retry_delay(1000000, 0), 1s);
    EXPECT_EQ(retry_delay(1, 0.5), 150ms);
}

}  // namespace
}  // namespace tessera
