// A server in this process with scripted peers over loopback: who is refused and why, what breaks
// one session and no other, and that a viewer gets the exact picture whatever happens to workers.

#include "server/server.h"

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/resource.h>

#include <array>
#include <cstring>
#include <fstream>
#include <random>
#include <regex>

#include "common/check.h"
#include "common/relay.h"
#include "common/scene_sync.h"
#include "tests/fake_answer.h"
#include "tests/loopback.h"
#include "tests/random_message.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

using namespace std::chrono_literals;

/// A server whose clock of patience runs fast.
struct Host {
    asio::io_context io;
    Server server;
    std::size_t workers_in = 0;

    explicit Host(const std::string& token = "", const std::filesystem::path& keys = {},
                  const std::filesystem::path& journal = {}, const Limits& limits = {},
                  RelayMode relays = RelayMode::automatic)
        : server(io, {.listen = "127.0.0.1:0",
                      .keys = keys,
                      .token = token,
                      .journal = journal,
                      .relays = relays,
                      .limits = limits,
                      .handshake_deadline = 2s}) {
        server.start();
    }

    /// Runs a test's coroutine, then stops the server, so that everything comes to an end.
    template <class Body>
    void run(Body body) {
        tessera::run(io, [&]() -> asio::awaitable<void> {
            const auto stop = [this](void*) { server.stop(); };
            const std::unique_ptr<void, decltype(stop)> at_the_end(this, stop);
            co_await body();
        });
    }
};

Hello hello_of(Role role) {
    return {.role = role, .build = "test", .token = {}, .name = "peer", .threads = 2};
}

asio::awaitable<std::shared_ptr<Connection>> say_hello(Host& host, Hello hello) {
    const auto connection = co_await connect(parse_address(host.server.address()));
    connection->send({hello, {}});
    co_return connection;
}

asio::awaitable<std::shared_ptr<Connection>> join(Host& host, Role role) {
    const auto connection = co_await say_hello(host, hello_of(role));
    const Message answer = co_await connection->receive();
    EXPECT_TRUE(answer.get<Welcome>());
    co_return connection;
}

/// The next message of type T; pings are answered, others passed over.
template <class T>
asio::awaitable<Message> receive(std::shared_ptr<Connection> connection) {
    for (;;) {
        Message message = co_await connection->receive();
        if (const auto* ping = message.get<Ping>()) connection->send({Pong{ping->stamp}, {}});
        if (message.get<T>()) co_return message;
    }
}

/// Whether the server closes the connection.
asio::awaitable<bool> closes(std::shared_ptr<Connection> connection) {
    try {
        for (;;) co_await connection->receive();
    } catch (const boost::system::system_error&) {
        co_return true;
    }
}

struct WorkerScript {
    int dies_after = -1;    ///< answers, then the connection closes
    int ignores = 0;        ///< tasks at the beginning
    int leaves_after = -1;  ///< answers; goes on with what it has
    bool answers_twice = false;
    bool answers_wrong = false;  ///< with a tile of the wrong size
    bool relays = false;
    std::string cannot_build = {};  ///< reason
    std::string cannot_render = {};
};

Message answer_to(const FrameSpec& spec, const TileTask& task, bool wrong) {
    const TileResult result = fake_answer(spec, task);
    const auto pixels = std::make_shared<Bytes>(packed(spec, result));
    if (wrong) pixels->pop_back();
    const TileReport report{
        .task = task, .rays = result.rays, .pixel_bytes = std::uint32_t(pixels->size())};
    return {TileResults{{report}}, {pixels, *pixels}};
}

/// A worker's side: what it holds, and its relay, if it has one.
struct FakeWorker {
    std::shared_ptr<Connection> connection;
    std::shared_ptr<SceneReceiver> scenes = std::make_shared<SceneReceiver>();
    std::shared_ptr<Relay> relay;

    FakeWorker() = default;
    FakeWorker(FakeWorker&&) = default;
    ~FakeWorker() {
        if (relay) relay->close();
    }
};

asio::awaitable<FakeWorker> join_as_worker(Host& host, bool relays) {
    FakeWorker worker;
    worker.connection = co_await connect(parse_address(host.server.address()));
    Hello hello = hello_of(Role::worker);
    if (relays) {
        // Of peers, on however slow a machine.
        const RelayPatience patience{60s, 60s};
        worker.relay = Relay::listen(*worker.connection, {}, 0, patience);
        hello.relay_port = worker.relay->port();
    }
    worker.connection->send({hello, {}});
    const Message answer = co_await worker.connection->receive();
    const auto* welcome = answer.get<Welcome>();
    if (!welcome) throw std::runtime_error("the server does not let the worker in");
    if (relays) worker.relay->begin(welcome->relay_token, worker.scenes, worker.connection, [] {});
    ++host.workers_in;
    co_return worker;
}

/// Builds nothing and renders made-up tiles; ends with its connection.
asio::awaitable<void> fake_worker(Host& host, WorkerScript script) {
    const FakeWorker self = co_await join_as_worker(host, script.relays);
    const auto connection = self.connection;
    SceneReceiver& scenes = *self.scenes;
    std::map<std::uint64_t, FrameSpec> frames;
    for (int answers = 0; answers != script.dies_after;) {
        const Message message = co_await connection->receive();
        if (const auto* update = message.get<SceneUpdate>())
            connection->send({scenes.update(*update), {}});
        if (const auto* source = message.get<BlobSource>()) self.relay->pull(*source);
        if (const auto* chunk = message.get<BlobChunk>()) scenes.add(*chunk, message.payload.bytes);
        if (const auto ready = scenes.take_ready()) {
            SceneReady report;
            report.scene = ready->name;
            report.version = ready->scene->version;
            report.build_seconds = 0.5;
            if (script.cannot_build.empty())
                connection->send({report, {}});
            else
                connection->send({Failure{0, script.cannot_build}, {}});
        }
        if (const auto* begin = message.get<FrameBegin>()) {
            frames[begin->spec.frame] = begin->spec;
            if (!script.cannot_render.empty())
                connection->send({Failure{begin->spec.frame, script.cannot_render}, {}});
        }
        if (const auto* ping = message.get<Ping>()) connection->send({Pong{ping->stamp}, {}});
        const auto* tasks = message.get<TileTasks>();
        if (!tasks || !script.cannot_render.empty()) continue;
        for (const TileTask& task : tasks->tasks) {
            if (script.ignores-- > 0) continue;
            const Message answer = answer_to(frames.at(task.frame), task, script.answers_wrong);
            if (script.answers_twice) connection->send_bulk(answer);
            connection->send_bulk(answer);
            if (++answers == script.leaves_after) connection->send({Leave{}, {}});
            if (answers == script.dies_after) break;
        }
    }
    co_await connection->close_when_sent();
}

void start_worker(Host& host, WorkerScript script = {}) {
    asio::co_spawn(host.io, fake_worker(host, script), [](std::exception_ptr) {});
}

SceneBundle small_scene(float size) {
    SceneBundle bundle;
    Mesh mesh;
    mesh.positions = {{0, 0, 0}, {size, 0, 0}, {0, size, 0}};
    mesh.triangles = {{0, 1, 2}};
    bundle.scene.objects.push_back({.name = "o", .mesh = add_mesh(bundle, mesh), .materials = {0}});
    bundle.scene.materials.emplace_back();
    bundle.scene.instances.push_back({.name = "i"});
    return bundle;
}

asio::awaitable<void> upload(std::shared_ptr<Connection> viewer, SceneBundle bundle,
                             std::uint64_t version = 1) {
    const SceneVersion next{.version = version, .scene = bundle.scene};
    viewer->send({SceneUpdate{"scene", diff(SceneVersion{}, next)}, {}});
    const Message request = co_await receive<BlobRequest>(viewer);
    co_await send_blobs(viewer, bundle.blobs, request.get<BlobRequest>()->blobs);
    const Message ready = co_await receive<SceneReady>(viewer);
    EXPECT_EQ(ready.get<SceneReady>()->version, version);
}

FrameRequest small_request(std::uint64_t number = 1) {
    FrameRequest request;
    request.request = number;
    request.spec.scene = "scene";
    request.spec.size = {150, 100};
    request.spec.extra = ChannelSet{}.with(Channel::albedo).with(Channel::depth);
    return request;
}

struct Picture {
    std::map<Channel, std::vector<float>> channels;
    FrameStatistics statistics;
    std::vector<FrameProgress> progress;
    std::string failure;
};

/// Receives `count` frames to their ends, by request number.
asio::awaitable<std::map<std::uint64_t, Picture>> pictures(std::shared_ptr<Connection> viewer,
                                                           int count) {
    std::map<std::uint64_t, Picture> out;
    while (count > 0) {
        const Message message = co_await viewer->receive();
        if (const auto* progress = message.get<FrameProgress>())
            out[progress->request].progress.push_back(*progress);
        if (const auto* chunk = message.get<PictureChunk>()) {
            std::vector<float>& values = out[chunk->request].channels[chunk->channel];
            values.resize(chunk->total / sizeof(float));
            std::memcpy(reinterpret_cast<std::byte*>(values.data()) + chunk->offset,
                        message.payload.bytes.data(), message.payload.bytes.size());
        }
        if (const auto* failure = message.get<Failure>())
            out[failure->request].failure = failure->reason;
        if (const auto* done = message.get<FrameDone>())
            out[done->request].statistics = done->statistics;
        if (message.get<Failure>() || message.get<FrameDone>()) --count;
    }
    co_return out;
}

asio::awaitable<Picture> render(std::shared_ptr<Connection> viewer, FrameRequest request) {
    viewer->send({request, {}});
    auto received = co_await pictures(viewer, 1);
    co_return received.at(request.request);
}

/// What the fake answers add up to.
FrameSums exact_sums(const FrameSpec& spec) {
    FrameAssembler assembler(spec);
    FrameSums sums(spec);
    for (TileTask task : all_tasks(spec)) {
        assembler.add(task, packed(spec, fake_answer(spec, task)));
        if (std::optional<RunBuffer> run = assembler.take_complete()) {
            sums.fold(*run, 0, spec.size.height);
            sums.finish_run(*run);
            assembler.run_folded(std::move(*run));
        }
    }
    return sums;
}

void expect_exact(const Picture& got, const FrameSpec& spec) {
    const FrameSums sums = exact_sums(spec);
    ASSERT_EQ(got.failure, "");
    ASSERT_EQ(got.channels.size(), 3u);
    EXPECT_EQ(got.channels.at(Channel::radiance), sums.picture().data);
    EXPECT_EQ(got.channels.at(Channel::albedo), sums.channel(Channel::albedo).data);
    EXPECT_EQ(got.channels.at(Channel::depth), sums.channel(Channel::depth).data);
    EXPECT_EQ(got.statistics.passes, spec.settings.passes);
    EXPECT_EQ(got.statistics.error_estimate, sums.error_estimate());
}

// ---- Who comes in -------------------------------------------------------------------------------

void expect_refused(Hello hello, const std::string& advice) {
    Host host("secret");
    host.run([&]() -> asio::awaitable<void> {
        const auto peer = co_await say_hello(host, hello);
        const Message answer = co_await peer->receive();
        EXPECT_TRUE(answer.get<Refused>());
        if (!answer.get<Refused>()) co_return;
        EXPECT_NE(answer.get<Refused>()->reason.find(advice), std::string::npos)
            << answer.get<Refused>()->reason;
        EXPECT_TRUE(co_await closes(peer));
    });
}

TEST(Server, another_protocol_version_is_refused) {
    Hello hello = hello_of(Role::worker);
    hello.token = "secret";
    hello.protocol = protocol_version + 1;
    expect_refused(hello, "install the same release");
}

TEST(Server, a_wrong_token_is_refused) {
    Hello hello = hello_of(Role::viewer);
    for (const char* token : {"", "secreT", "secret "}) {
        hello.token = token;
        expect_refused(hello, "TESSERA_TOKEN");
    }
}

TEST(Server, the_right_token_is_welcome) {
    Host host("secret");
    host.run([&]() -> asio::awaitable<void> {
        Hello hello = hello_of(Role::viewer);
        hello.token = "secret";
        const auto peer = co_await say_hello(host, hello);
        const Message answer = co_await peer->receive();
        EXPECT_TRUE(answer.get<Welcome>());
    });
}

TEST(Server, listens_beyond_loopback_only_with_keys) {
    const TempDir temp;
    make_keys(temp.file("keys"));
    asio::io_context io;
    EXPECT_THROW(Server(io, {.listen = "0.0.0.0:0", .keys = {}, .token = "secret"}), UserError);
    EXPECT_NO_THROW(
        Server(io, {.listen = "0.0.0.0:0", .keys = temp.file("keys/server"), .token = ""}));
}

/// What the server answers to a Hello: empty when the peer is welcome, else the reason.
asio::awaitable<std::string> answer_to(Host& host, Hello hello, std::shared_ptr<const Tls> tls) {
    const auto peer = co_await connect(parse_address(host.server.address()), tls);
    peer->send({hello, {}});
    const Message answer = co_await peer->receive();
    const auto* refused = answer.get<Refused>();
    co_return refused ? refused->reason : "";
}

TEST(Server, keys_let_everybody_into_his_own_role) {
    const TempDir temp;
    make_keys(temp.file("keys"));
    const auto keys_of = [&](const char* role) {
        return load_credentials(temp.file("keys") / role);
    };
    const Credentials worker = keys_of("worker"), viewer = keys_of("viewer"),
                      editor = keys_of("editor");
    Host host("", temp.file("keys/server"));
    host.run([&]() -> asio::awaitable<void> {
        const auto expect = [&](Role role, const std::string& token, std::shared_ptr<const Tls> tls,
                                std::string expected) -> asio::awaitable<void> {
            Hello hello = hello_of(role);
            hello.token = token;
            const std::string answer = co_await answer_to(host, hello, tls);
            EXPECT_EQ(answer.empty(), expected.empty()) << answer;
            EXPECT_NE(answer.find(expected), std::string::npos) << answer;
        };
        co_await expect(Role::worker, worker.token, worker.tls, "");
        co_await expect(Role::viewer, viewer.token, viewer.tls, "");
        co_await expect(Role::viewer, editor.token, editor.tls, "");
        co_await expect(Role::viewer, worker.token, worker.tls, "is for a worker");
        co_await expect(Role::worker, viewer.token, viewer.tls, "is for a viewer");
        co_await expect(Role::worker, worker.token, viewer.tls, "no worker's certificate");
        co_await expect(Role::viewer, "guess", viewer.tls, "wrong token");
        co_await expect(Role::viewer, viewer.token, nullptr, "--keys");
    });
}

TEST(Server, who_may_only_look_brings_no_scene) {
    const TempDir temp;
    make_keys(temp.file("keys"));
    const Credentials viewer = load_credentials(temp.file("keys/viewer"));
    Host host("", temp.file("keys/server"));
    host.run([&]() -> asio::awaitable<void> {
        Hello hello = hello_of(Role::viewer);
        hello.token = viewer.token;
        const auto peer = co_await connect(parse_address(host.server.address()), viewer.tls);
        peer->send({hello, {}});
        SceneUpdate update{.scene = "mine", .delta = {}};
        update.delta.next_version = 1;
        peer->send({update, {}});
        const Message answer = co_await receive<Failure>(peer);
        EXPECT_NE(answer.get<Failure>()->reason.find("not to edit"), std::string::npos);
    });
}

TEST(Server, a_port_that_is_taken_is_the_users_fault) {
    Host host;
    try {
        Server second(host.io, {.listen = host.server.address(), .keys = {}, .token = ""});
        FAIL() << "two servers on one port";
    } catch (const UserError& error) {
        EXPECT_NE(std::string(error.what()).find(host.server.address()), std::string::npos);
    }
}

TEST(Server, a_stranger_that_says_nothing_is_sent_away) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto peer = co_await connect(parse_address(host.server.address()));
        EXPECT_TRUE(co_await closes(peer));
    });
}

TEST(Server, malformed_bytes_close_that_session_only) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        const Address address = parse_address(host.server.address());
        tcp::socket vandal(host.io);
        co_await vandal.async_connect(
            {asio::ip::make_address(address.host), std::uint16_t(std::stoi(address.port))},
            asio::use_awaitable);
        const std::string noise(100, 'x');
        co_await asio::async_write(vandal, asio::buffer(noise), asio::use_awaitable);
        boost::system::error_code end;
        char c;
        co_await asio::async_read(vandal, asio::buffer(&c, 1),
                                  asio::redirect_error(asio::use_awaitable, end));
        EXPECT_TRUE(end);
        // A viewer that sends what only workers may is no better.
        const auto confused = co_await join(host, Role::viewer);
        confused->send({SceneReady{}, {}});
        EXPECT_TRUE(co_await closes(confused));

        viewer->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(viewer);
        EXPECT_EQ(status.get<Status>()->viewers, 1u);
    });
}

// ---- Frames -------------------------------------------------------------------------------------

/// One viewer, these workers, all of them there before the one frame begins.
Picture render_with(std::vector<WorkerScript> workers, FrameRequest request = small_request()) {
    Host host;
    Picture out;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        co_await upload(viewer, small_scene(1));
        for (const WorkerScript& script : workers) start_worker(host, script);
        while (host.workers_in < workers.size()) co_await asio::post(host.io, asio::use_awaitable);
        out = co_await render(viewer, request);
    });
    return out;
}

TEST(Server, a_viewer_gets_the_exact_picture) {
    const Picture picture = render_with({{}, {}});
    expect_exact(picture, small_request().spec);
    EXPECT_EQ(picture.statistics.build_seconds, 0.5);
    std::uint64_t tiles = 0;
    for (const WorkerShare& share : picture.statistics.workers) tiles += share.tiles;
    EXPECT_GE(tiles, all_tasks(small_request().spec).size());  // some may come in quarters
    EXPECT_EQ(picture.statistics.rays, 10 * tiles);
    ASSERT_FALSE(picture.progress.empty());
    EXPECT_EQ(picture.progress.front().workers, 0u);
}

TEST(Server, the_path_integrator_adds_up_runs_of_passes) {
    FrameRequest request = small_request();
    request.spec.settings.integrator = Integrator::path;
    request.spec.settings.passes = 100;
    expect_exact(render_with({{}}, request), request.spec);
}

TEST(Server, a_worker_that_leaves_does_not_change_a_bit) {
    expect_exact(render_with({{.leaves_after = 3}, {.leaves_after = 1}, {}}), small_request().spec);
}

/// Gets the first piece of a mesh, passes it on to a worker that comes then, and is gone.
asio::awaitable<void> die_in_mid_upload(Host& host) {
    const FakeWorker self = co_await join_as_worker(host, true);
    for (bool begun = false; !begun;) {
        const Message message = co_await self.connection->receive();
        if (const auto* ping = message.get<Ping>()) self.connection->send({Pong{ping->stamp}, {}});
        if (const auto* update = message.get<SceneUpdate>())
            self.connection->send({self.scenes->update(*update), {}});
        if (const auto* chunk = message.get<BlobChunk>()) {
            self.scenes->add(*chunk, message.payload.bytes);
            begun = true;
        }
    }
    start_worker(host, {.relays = true});
    while (self.relay->bytes_sent() == 0)
        co_await asio::post(self.connection->executor(), asio::use_awaitable);
    self.connection->close();
}

TEST(Server, a_worker_that_dies_while_it_passes_meshes_on_does_not_change_a_bit) {
    Host host("", {}, {}, {}, RelayMode::on);
    SceneBundle bundle = small_scene(1);
    Mesh mesh;
    mesh.positions.resize(chunk_bytes / 4);  // three pieces and more
    mesh.triangles = {{0, 1, 2}};
    bundle.scene.objects[0].mesh = add_mesh(bundle, mesh);
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        asio::co_spawn(host.io, die_in_mid_upload(host), [](std::exception_ptr) {});
        while (host.workers_in < 1) co_await asio::post(host.io, asio::use_awaitable);
        co_await upload(viewer, bundle);
        expect_exact(co_await render(viewer, small_request()), small_request().spec);
        EXPECT_EQ(host.workers_in, 2u);
    });
}

TEST(Server, metrics_name_every_worker) {
    Status status;
    status.frames_done = 7;
    status.workers = {{.peer = 3, .name = "a \"b\"", .address = {}, .tiles = 5}};
    const std::string text = metrics_text(status);
    EXPECT_NE(text.find("tessera_frames_done_total 7\n"), std::string::npos) << text;
    EXPECT_NE(text.find("tessera_worker_tiles_total{peer=\"3\",worker=\"a \\\"b\\\"\"} 5\n"),
              std::string::npos)
        << text;
}

TEST(Server, the_dashboard_shows_metrics_that_there_are) {
    Status status;
    status.workers.resize(1);
    const std::string text = metrics_text(status);
    std::ifstream file(TESSERA_DASHBOARD);
    const std::string dashboard(std::istreambuf_iterator<char>(file), {});
    const std::regex metric("tessera_[a-z_]+");
    const std::sregex_iterator begin(dashboard.begin(), dashboard.end(), metric), end;
    EXPECT_GT(std::distance(begin, end), 10);
    for (auto name = begin; name != end; ++name)
        EXPECT_NE(text.find("# TYPE " + name->str() + " "), std::string::npos) << name->str();
}

TEST(Server, health_is_being_there_and_readiness_may_ask_for_workers) {
    Status status;
    const auto answer = [&](const std::string& path) {
        return http_answer("GET " + path + " HTTP/1.1\r\n\r\n", [&] { return status; });
    };
    const auto says = [&](const std::string& path, const std::string& code) {
        return answer(path).starts_with("HTTP/1.1 " + code);
    };
    EXPECT_TRUE(says("/healthz", "200"));
    EXPECT_TRUE(says("/readyz", "200"));
    EXPECT_TRUE(says("/readyz?workers=1", "503"));
    status.workers.resize(2);
    EXPECT_TRUE(says("/readyz?workers=2", "200"));
    EXPECT_TRUE(says("/readyz?workers=3", "503"));
    EXPECT_NE(answer("/readyz?workers=3").find("2 workers of 3"), std::string::npos);
    EXPECT_TRUE(says("/readyz?workers=", "404"));
    EXPECT_TRUE(says("/readyz?workers=99999999999", "404"));
    EXPECT_TRUE(says("/metrics", "200"));
    EXPECT_TRUE(says("/elsewhere", "404"));
    EXPECT_TRUE(http_answer("POST /metrics HTTP/1.1\r\n\r\n", [&] {
                    return status;
                }).starts_with("HTTP/1.1 404"));
}

TEST(Server, dying_workers_do_not_change_a_bit) {
    const Picture picture =
        render_with({{.dies_after = 0}, {.dies_after = 20}, {.dies_after = 5}, {}});
    expect_exact(picture, small_request().spec);
    EXPECT_GT(picture.statistics.tiles_reissued, 0u);
}

TEST(Server, a_worker_that_answers_twice_does_not_change_a_bit) {
    expect_exact(render_with({{.answers_twice = true}}), small_request().spec);
}

TEST(Server, tiles_that_a_worker_keeps_to_itself_go_to_another) {
    expect_exact(render_with({{.ignores = 3}, {}}), small_request().spec);
}

TEST(Server, a_worker_that_sends_broken_tiles_is_dropped) {
    expect_exact(render_with({{.answers_wrong = true}, {}}), small_request().spec);
}

TEST(Server, a_scene_that_only_some_workers_can_build_is_rendered_by_the_others) {
    expect_exact(render_with({{.cannot_build = "too large"}, {.cannot_render = "no memory"}, {}}),
                 small_request().spec);
}

TEST(Server, a_scene_that_no_worker_can_build_is_reported_with_the_reason) {
    const Picture picture = render_with({{.cannot_build = "mesh 3 is broken"}});
    EXPECT_NE(picture.failure.find("mesh 3 is broken"), std::string::npos) << picture.failure;
    EXPECT_NE(render_with({{.cannot_render = "no memory"}}).failure.find("no memory"),
              std::string::npos);
}

TEST(Server, an_unknown_scene_is_reported_by_name) {
    Host host;
    host.server.add_scene("loaded", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        const Picture none = co_await render(viewer, small_request());
        EXPECT_NE(none.failure.find("'scene'"), std::string::npos) << none.failure;
        EXPECT_NE(none.failure.find("loaded"), std::string::npos) << none.failure;
    });
}

TEST(Server, srgb8_is_the_tone_mapped_picture) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        start_worker(host);
        co_await upload(viewer, small_scene(1));
        FrameRequest request = small_request();
        request.spec.extra = {};
        const Picture linear = co_await render(viewer, request);
        request.format = PictureFormat::srgb8;
        request.tone_map.exposure = -1;
        viewer->send({request, {}});
        const Message message = co_await receive<PictureChunk>(viewer);
        Image image(request.spec.size, 3);
        image.data = linear.channels.at(Channel::radiance);
        const std::vector<std::uint8_t> expected = to_srgb8(image, request.tone_map);
        EXPECT_TRUE(std::ranges::equal(std::as_bytes(std::span(expected)), message.payload.bytes));
    });
}

TEST(Server, viewers_share_the_workers_and_each_has_its_own_scene) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        start_worker(host);
        const auto a = co_await join(host, Role::viewer);
        const auto b = co_await join(host, Role::viewer);
        co_await upload(a, small_scene(1));
        co_await upload(b, small_scene(2));
        for (const auto& viewer : {a, b})
            for (std::uint64_t number : {1, 2, 3}) viewer->send({small_request(number), {}});
        for (const auto& viewer : {a, b}) {
            const auto received = co_await pictures(viewer, 3);
            EXPECT_EQ(received.size(), 3u);
            for (const auto& [number, picture] : received)
                expect_exact(picture, small_request().spec);
        }
        a->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(a);
        EXPECT_EQ(status.get<Status>()->frames_done, 6u);
        EXPECT_EQ(status.get<Status>()->scenes.size(), 2u);
        EXPECT_EQ(status.get<Status>()->workers.size(), 2u);
    });
}

TEST(Server, an_edited_scene_is_rendered_in_its_newest_version) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto viewer = co_await join(host, Role::viewer);
        for (std::uint64_t version = 1; version <= 3; ++version) {
            co_await upload(viewer, small_scene(float(version)), version);
            expect_exact(co_await render(viewer, small_request(version)), small_request().spec);
        }
        viewer->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(viewer);
        EXPECT_EQ(status.get<Status>()->scenes.size(), 1u);
        EXPECT_EQ(status.get<Status>()->scenes.front().version, 3u);
    });
}

TEST(Server, a_cancelled_frame_ends_and_its_scene_goes_with_the_viewer) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        const auto other = co_await join(host, Role::viewer);
        co_await upload(viewer, small_scene(1));
        viewer->send({small_request(1), {}});
        viewer->send({small_request(2), {}});
        viewer->send({FrameCancel{1}, {}});
        viewer->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(viewer);
        EXPECT_EQ(status.get<Status>()->frames_in_flight, 1u);
        viewer->close();
        // The server sees the end of a connection whenever it comes to it.
        for (;;) {
            other->send({StatusRequest{}, {}});
            const Message after = co_await receive<Status>(other);
            if (after.get<Status>()->viewers == 2) continue;
            EXPECT_EQ(after.get<Status>()->frames_in_flight, 0u);
            EXPECT_TRUE(after.get<Status>()->scenes.empty());
            break;
        }
    });
}

TEST(Server, passes_stop_at_the_error_limit) {
    FrameRequest request = small_request();
    request.spec.settings.passes = 100000;
    request.error_limit = 0.05;
    const Picture picture = render_with({{}, {}}, request);
    EXPECT_LE(picture.statistics.error_estimate, 0.05);
    EXPECT_GT(picture.statistics.error_estimate, 0.0);
    FrameSpec expected = request.spec;
    expected.settings.passes = picture.statistics.passes;
    expect_exact(picture, expected);
}

TEST(Server, passes_stop_at_the_time_limit) {
    FrameRequest request = small_request();
    request.spec.settings.passes = 1u << 20;
    request.time_limit = 0.05;
    const Picture picture = render_with({{}}, request);
    FrameSpec expected = request.spec;
    expected.settings.passes = picture.statistics.passes;
    expect_exact(picture, expected);
}

// ---- Open scenes --------------------------------------------------------------------------------

/// A viewer's copy of an open scene.
struct Watcher {
    std::shared_ptr<Connection> connection;
    SceneVersion held = {};

    /// Until it holds that version.
    asio::awaitable<void> catch_up(std::uint64_t version) {
        while (held.version < version) {
            const Message message = co_await receive<SceneUpdate>(connection);
            held = apply(held, message.get<SceneUpdate>()->delta);
        }
    }
};

asio::awaitable<EditResult> edit(std::shared_ptr<Connection> viewer,
                                 std::vector<EditOperation> operations) {
    viewer->send({SceneEdit{7, "scene", std::move(operations)}, {}});
    const Message message = co_await receive<EditResult>(viewer);
    co_return *message.get<EditResult>();
}

SetTransform moved(float x) {
    SetTransform out{.instance = "i"};
    out.world_from_object[3].x = x;
    return out;
}

TEST(Server, an_edit_is_seen_by_all_who_watch_and_rendered) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        Watcher a, b;
        a.connection = co_await join(host, Role::viewer);
        b.connection = co_await join(host, Role::viewer);
        for (Watcher* w : {&a, &b}) {
            w->connection->send({SceneWatch{"scene"}, {}});
            co_await w->catch_up(1);
            EXPECT_EQ(w->held.scene.instances, small_scene(1).scene.instances);
        }
        const std::vector<EditOperation> moves = {moved(1), moved(2)};
        const EditResult result = co_await edit(a.connection, moves);
        EXPECT_EQ(result.request, 7u);
        EXPECT_EQ(result.version, 2u);
        EXPECT_TRUE(result.complaints.empty());
        co_await b.catch_up(2);
        EXPECT_EQ(b.held.scene.instances[0].world_from_object[3].x, 2);
        expect_exact(co_await render(b.connection, small_request()), small_request().spec);
    });
}

/// An edit that brings the object's shape along.
asio::awaitable<EditResult> reshape(std::shared_ptr<Connection> viewer, Shape shape) {
    const auto blob = std::make_shared<const Bytes>(encode(shape));
    SceneEdit edit{7, "scene", {SetShape{"o", blob_id(*blob)}}, {blob->size()}};
    viewer->send({std::move(edit), {blob, *blob}});
    const Message message = co_await receive<EditResult>(viewer);
    co_return *message.get<EditResult>();
}

TEST(Server, shapes_come_with_their_edits_and_reach_the_workers) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        Watcher viewer;
        viewer.connection = co_await join(host, Role::viewer);
        viewer.connection->send({SceneWatch{"scene"}, {}});
        for (std::uint64_t version = 2; version < 6; ++version) {
            Shape shape{.positions = {vec3(0), vec3(float(version)), vec3(0, 1, 0)}, .normals = {}};
            const EditResult result = co_await reshape(viewer.connection, shape);
            EXPECT_EQ(result.version, version);
            EXPECT_TRUE(result.complaints.empty());
            co_await viewer.catch_up(version);
            EXPECT_EQ(viewer.held.scene.shapes, std::vector<BlobId>{blob_id(encode(shape))});
        }
        expect_exact(co_await render(viewer.connection, small_request()), small_request().spec);
        Shape too_small{.positions = {vec3(0)}, .normals = {}};
        const EditResult refused = co_await reshape(viewer.connection, too_small);
        EXPECT_EQ(refused.version, 5u);
        EXPECT_EQ(refused.complaints.size(), 1u);
    });
}

TEST(Server, objects_come_with_their_meshes) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto viewer = co_await join(host, Role::viewer);
        const auto create = [&](Bytes bytes) -> asio::awaitable<EditResult> {
            const auto mesh = std::make_shared<const Bytes>(std::move(bytes));
            SceneEdit edit{7,
                           "scene",
                           {CreateObject{"new", blob_id(*mesh), {"material 0"}},
                            CreateInstance{"first", "new"}, SetShape{"new", blob_id(*mesh)}},
                           {mesh->size()}};
            viewer->send({std::move(edit), {mesh, *mesh}});
            const Message message = co_await receive<EditResult>(viewer);
            co_return *message.get<EditResult>();
        };
        const EditResult refused = co_await create(Bytes(100));
        EXPECT_EQ(refused.version, 1u);
        EXPECT_EQ(refused.complaints.size(), 3u);
        const SceneBundle larger = small_scene(2);
        const EditResult done = co_await create(*larger.blobs.find(larger.scene.meshes[0]));
        EXPECT_EQ(done.version, 2u);
        EXPECT_EQ(done.complaints, std::vector<std::string>{"'new': that is no shape for it"});
        expect_exact(co_await render(viewer, small_request()), small_request().spec);
    });
}

TEST(Server, edits_that_cannot_be_done_are_told_and_change_nothing) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        const std::vector<EditOperation> impossible = {DeleteInstance{"nobody"}};
        const EditResult result = co_await edit(viewer, impossible);
        EXPECT_EQ(result.version, 1u);
        EXPECT_EQ(result.complaints, std::vector<std::string>{"there is no instance 'nobody'"});
        viewer->send({SceneEdit{8, "elsewhere", {}}, {}});
        const Message message = co_await receive<EditResult>(viewer);
        EXPECT_EQ(message.get<EditResult>()->complaints.size(), 1u);
    });
}

TEST(Server, a_shared_scene_is_open_to_others_and_outlives_its_viewer) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto owner = co_await join(host, Role::viewer);
        owner->send({SceneShare{"scene"}, {}});
        const Message refused = co_await receive<Failure>(owner);
        EXPECT_NE(refused.get<Failure>()->reason.find("upload it first"), std::string::npos);
        co_await upload(owner, small_scene(1));
        owner->send({SceneShare{"scene"}, {}});
        expect_exact(co_await render(owner, small_request()), small_request().spec);
        owner->close();

        const auto viewer = co_await join(host, Role::viewer);
        const std::vector<EditOperation> move = {moved(3)}, again = {moved(4)};
        const EditResult result = co_await edit(viewer, move);
        EXPECT_EQ(result.version, 2u);
        expect_exact(co_await render(viewer, small_request()), small_request().spec);
        // Its blobs can be had, too.
        const BlobId mesh = small_scene(1).scene.meshes[0];
        viewer->send({BlobRequest{"scene", {mesh}}, {}});
        const Message blob = co_await receive<BlobChunk>(viewer);
        EXPECT_EQ(blob_id(blob.payload.bytes), mesh);
        // An upload of the same name and content is the viewer's own, whatever others do to theirs.
        co_await upload(viewer, small_scene(1));
        const EditResult third = co_await edit(viewer, again);
        EXPECT_EQ(third.version, 3u);
        viewer->send({SceneShare{"scene"}, {}});
        const Message taken = co_await receive<Failure>(viewer);
        EXPECT_NE(taken.get<Failure>()->reason.find("'scene'"), std::string::npos);
    });
}

// ---- The journal, and frames that go on
// ----------------------------------------------------------

TEST(Server, open_scenes_outlive_it) {
    const TempDir dir;
    {
        Host host("", {}, dir.file("j"));
        host.server.add_scene("scene", small_scene(1));
        host.run([&]() -> asio::awaitable<void> {
            const auto viewer = co_await join(host, Role::viewer);
            co_await upload(viewer, small_scene(2));
            // The viewer's own scene has the name of an open one: it cannot be opened, too.
            viewer->send({SceneShare{"scene"}, {}});
            co_await receive<Failure>(viewer);
            for (float x = 1; x < 40; ++x) viewer->send({SceneEdit{7, "scene", {moved(x)}}, {}});
            const std::vector<EditOperation> last = {moved(40)};
            const EditResult result = co_await edit(viewer, last);
            EXPECT_TRUE(result.complaints.empty());
            for (int i = 1; i < 40; ++i) co_await receive<EditResult>(viewer);
        });
    }
    Host host("", {}, dir.file("j"));
    EXPECT_TRUE(host.server.holds_scene("scene"));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        Watcher watcher;
        watcher.connection = co_await join(host, Role::viewer);
        watcher.connection->send({SceneWatch{"scene"}, {}});
        co_await watcher.catch_up(41);
        EXPECT_EQ(watcher.held.scene.instances[0].world_from_object[3].x, 40);
        EXPECT_EQ(watcher.held.scene.meshes, small_scene(1).scene.meshes);
        // A frame that is asked for behind an edit has it.
        watcher.connection->send({SceneEdit{8, "scene", {moved(41)}}, {}});
        expect_exact(co_await render(watcher.connection, small_request()), small_request().spec);
    });
}

TEST(Server, what_cannot_be_written_is_refused_and_not_shown) {
    const TempDir dir;
    Host host("", {}, dir.file("j"));
    host.server.add_scene("scene", small_scene(1));
    rlimit before{};
    ASSERT_EQ(getrlimit(RLIMIT_FSIZE, &before), 0);
    signal(SIGXFSZ, SIG_IGN);
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        co_await upload(viewer, small_scene(2));
        const rlimit small{
            .rlim_cur = std::filesystem::file_size(dir.file("j") / "journal.sqlite-wal"),
            .rlim_max = before.rlim_max};
        setrlimit(RLIMIT_FSIZE, &small);
        const std::vector<EditOperation> one = {moved(1)}, two = {moved(2)};
        EditResult result = co_await edit(viewer, one);
        while (result.complaints.empty()) result = co_await edit(viewer, two);
        EXPECT_NE(result.complaints.front().find("make room"), std::string::npos);
        const std::uint64_t version = result.version;
        setrlimit(RLIMIT_FSIZE, &before);
        const std::vector<EditOperation> three = {moved(3)};
        result = co_await edit(viewer, three);
        EXPECT_TRUE(result.complaints.empty());
        EXPECT_EQ(result.version, version + 1);
    });
    setrlimit(RLIMIT_FSIZE, &before);
}

/// The sums of the viewer's frame after at least one pass.
asio::awaitable<Bytes> save(std::shared_ptr<Connection> viewer, std::uint64_t request) {
    Bytes sums;
    for (;;) {
        viewer->send({FrameSave{request}, {}});
        for (;;) {
            const Message message = co_await receive<SumsChunk>(viewer);
            const auto* chunk = message.get<SumsChunk>();
            sums.insert(sums.end(), message.payload.bytes.begin(), message.payload.bytes.end());
            if (chunk->offset + message.payload.bytes.size() == chunk->total) break;
        }
        if (!sums.empty()) co_return sums;
    }
}

TEST(Server, a_frame_goes_on_elsewhere_to_the_same_bits) {
    FrameRequest request = small_request();
    request.spec.settings.passes = 40;
    Bytes sums;
    Host first, second;
    first.run([&]() -> asio::awaitable<void> {
        start_worker(first);
        const auto viewer = co_await join(first, Role::viewer);
        co_await upload(viewer, small_scene(1));
        viewer->send({request, {}});
        sums = co_await save(viewer, request.request);
    });
    second.run([&]() -> asio::awaitable<void> {
        start_worker(second);
        const auto viewer = co_await join(second, Role::viewer);
        co_await upload(viewer, small_scene(1));
        request.sums_bytes = sums.size();
        viewer->send({request, {}});
        for (SumsChunk chunk{.request = request.request, .total = sums.size()};
             chunk.offset < chunk.total;) {
            const std::size_t size = std::min<std::size_t>(chunk_bytes, chunk.total - chunk.offset);
            viewer->send({chunk, {nullptr, std::span(sums).subspan(chunk.offset, size)}});
            chunk.offset += size;
        }
        auto received = co_await pictures(viewer, 1);
        const Picture& picture = received.at(request.request);
        EXPECT_GT(picture.progress.front().passes_done, 0u);
        expect_exact(picture, request.spec);
    });
}

TEST(Server, sums_that_do_not_fit_cost_the_viewer_its_session) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        FrameRequest request = small_request();
        request.sums_bytes = 100;
        viewer->send({request, {}});
        EXPECT_TRUE(co_await closes(viewer));
    });
}

// ---- Views --------------------------------------------------------------------------------------

struct Shown {
    ViewPicture about;
    std::vector<float> values;
};

/// The next picture of a view; pings are answered, so that more may come.
asio::awaitable<Shown> next_shown(std::shared_ptr<Connection> viewer) {
    Shown out;
    for (;;) {
        const Message message = co_await viewer->receive();
        if (const auto* ping = message.get<Ping>()) viewer->send({Pong{ping->stamp}, {}});
        if (const auto* chunk = message.get<PictureChunk>()) {
            out.values.resize(chunk->total / sizeof(float));
            std::memcpy(reinterpret_cast<std::byte*>(out.values.data()) + chunk->offset,
                        message.payload.bytes.data(), message.payload.bytes.size());
        }
        if (const auto* about = message.get<ViewPicture>()) {
            out.about = *about;
            co_return out;
        }
    }
}

asio::awaitable<Shown> settled(std::shared_ptr<Connection> viewer, std::uint64_t stamp) {
    for (;;) {
        Shown shown = co_await next_shown(viewer);
        if (shown.about.settled && shown.about.stamp == stamp) co_return shown;
    }
}

View small_view(std::uint64_t stamp, std::uint32_t passes) {
    View view;
    view.request = 1;
    view.spec = small_request().spec;
    view.spec.settings.passes = passes;
    view.format = PictureFormat::linear_float;
    view.stamp = stamp;
    return view;
}

TEST(Server, a_view_shows_the_first_pass_and_settles_at_the_exact_picture) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto viewer = co_await join(host, Role::viewer);
        View view = small_view(5, 6);
        viewer->send({view, {}});
        const Shown first = co_await next_shown(viewer);
        EXPECT_EQ(first.about.passes, 1u);
        EXPECT_EQ(first.about.stamp, 5u);
        view.spec.settings.passes = 1;
        EXPECT_EQ(first.values, exact_sums(view.spec).picture().data);
        const Shown last = co_await settled(viewer, 5);
        view.spec.settings.passes = 6;
        EXPECT_EQ(last.about.passes, 6u);
        EXPECT_EQ(last.values, exact_sums(view.spec).picture().data);
        // Another exposure shows the same samples, another channel is rendered.
        view.stamp = 6;
        view.tone_map.exposure = 1;
        viewer->send({view, {}});
        const Shown again = co_await next_shown(viewer);
        EXPECT_TRUE(again.about.settled);
        EXPECT_EQ(again.about.stamp, 6u);
        view.stamp = 7;
        view.shown = Channel::depth;
        viewer->send({view, {}});
        const Shown depth = co_await settled(viewer, 7);
        EXPECT_EQ(depth.values, std::vector<float>(view.spec.size.pixels(), 1));
    });
}

TEST(Server, a_view_begins_anew_when_camera_or_scene_change) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto viewer = co_await join(host, Role::viewer);
        View view = small_view(1, max_passes);
        viewer->send({view, {}});
        co_await next_shown(viewer);
        for (view.stamp = 2; view.stamp <= 20; ++view.stamp) {
            view.spec.camera.eye.x = float(view.stamp);
            viewer->send({view, {}});
        }
        Shown shown = co_await next_shown(viewer);
        while (shown.about.stamp < 20) {
            const std::uint64_t before = shown.about.stamp;
            shown = co_await next_shown(viewer);
            EXPECT_GE(shown.about.stamp, before);
        }
        const std::vector<EditOperation> move = {moved(3)};
        viewer->send({SceneEdit{7, "scene", move}, {}});
        while (shown.about.version < 2) shown = co_await next_shown(viewer);
        viewer->send({ViewEnd{1}, {}});
        viewer->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(viewer);
        EXPECT_EQ(status.get<Status>()->frames_in_flight, 0u);
    });
}

TEST(Server, a_viewer_that_does_not_keep_up_misses_pictures_and_delays_nobody) {
    Host host;
    host.server.add_scene("scene", small_scene(1));
    host.run([&]() -> asio::awaitable<void> {
        start_worker(host);
        const auto slow = co_await join(host, Role::viewer);
        const auto quick = co_await join(host, Role::viewer);
        slow->send({small_view(1, 30), {}});
        quick->send({small_view(1, 30), {}});
        co_await settled(quick, 1);
        // Its pings have not been answered, so no more than two pictures are under way to it.
        slow->send({StatusRequest{}, {}});
        int pictures = 0;
        for (bool told = false; !told;) {
            const Message message = co_await slow->receive();
            if (message.get<ViewPicture>()) ++pictures;
            told = message.get<Status>();
        }
        EXPECT_LE(pictures, 2);
    });
}

// ---- Peers that break the protocol --------------------------------------------------------------

/// A frame of any kind with a few bytes spoilt, cut off or lengthened.
Bytes spoilt_frame(std::mt19937& random) {
    Bytes frame =
        flattened(encode(RandomMessage(unsigned(random())).make(random() % RandomMessage::kinds)));
    if (random() % 4 == 0) frame.resize(1 + random() % frame.size());
    for (unsigned i = 1 + random() % 4; i > 0; --i)
        frame[random() % std::min<std::size_t>(frame.size(), random() % 2 ? 16 : frame.size())] =
            std::byte(random());
    return frame;
}

/// Sends it, let in or not, and waits until the server has hung up.
asio::awaitable<void> vandal(Host& host, std::optional<Role> role, Bytes frame) {
    const Address address = parse_address(host.server.address());
    tcp::socket socket(host.io);
    co_await socket.async_connect(
        {asio::ip::make_address(address.host), std::uint16_t(std::stoi(address.port))},
        asio::use_awaitable);
    Bytes bytes = role ? flattened(encode({hello_of(*role), {}})) : Bytes{};
    bytes.insert(bytes.end(), frame.begin(), frame.end());
    boost::system::error_code error;
    co_await asio::async_write(socket, asio::buffer(bytes),
                               asio::redirect_error(asio::use_awaitable, error));
    socket.shutdown(tcp::socket::shutdown_send, error);
    std::array<std::byte, 4096> heard;
    while (!error)
        co_await socket.async_read_some(asio::buffer(heard),
                                        asio::redirect_error(asio::use_awaitable, error));
}

TEST(Server, spoilt_frames_of_every_kind_do_not_change_a_bit_for_others) {
    Host host;
    host.run([&]() -> asio::awaitable<void> {
        const auto viewer = co_await join(host, Role::viewer);
        co_await upload(viewer, small_scene(1));
        start_worker(host);
        std::mt19937 random(1);
        for (int i = 0; i < 300; ++i) {
            const Bytes frame = spoilt_frame(random);
            const auto role = std::array{std::optional<Role>{}, std::optional(Role::viewer),
                                         std::optional(Role::worker)}[i % 3];
            co_await vandal(host, role, frame);
            if (i % 50 != 0) continue;
            const FrameRequest request = small_request(std::uint64_t(i) + 1);
            expect_exact(co_await render(viewer, request), request.spec);
        }
        viewer->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(viewer);
        EXPECT_EQ(status.get<Status>()->viewers, 1u);
        EXPECT_EQ(status.get<Status>()->workers.size(), 1u);
    });
}

// ---- Limits -------------------------------------------------------------------------------------

using Peer = std::shared_ptr<Connection>;

/// Runs `body(host, peer)` on a server with these limits; a bystander notices nothing.
template <class Body>
void run_limited(const Limits& limits, Body body) {
    Host host("", {}, {}, limits);
    host.run([&]() -> asio::awaitable<void> {
        const auto bystander = co_await join(host, Role::viewer);
        const auto peer = co_await join(host, Role::viewer);
        co_await body(host, peer);
        bystander->send({StatusRequest{}, {}});
        const Message status = co_await receive<Status>(bystander);
        EXPECT_TRUE(status.get<Status>());
    });
}

void expect_names(const std::string& sentence, const std::string& option) {
    EXPECT_NE(sentence.find(option), std::string::npos) << sentence;
}

/// The peer hears why it is dropped, and is.
asio::awaitable<void> expect_dismissed(std::shared_ptr<Connection> peer, std::string option) {
    const Message last = co_await receive<Refused>(peer);
    expect_names(last.get<Refused>()->reason, option);
    EXPECT_TRUE(co_await closes(peer));
}

/// What the server says to an uploaded scene: empty when it takes it.
asio::awaitable<std::string> answer_to_scene(std::shared_ptr<Connection> peer, SceneBundle bundle) {
    peer->send({SceneUpdate{"scene", diff({}, {.version = 1, .scene = bundle.scene})}, {}});
    const Message request = co_await receive<BlobRequest>(peer);
    co_await send_blobs(peer, bundle.blobs, request.get<BlobRequest>()->blobs);
    for (;;) {
        const Message answer = co_await peer->receive();
        if (const auto* failure = answer.get<Failure>()) co_return failure->reason;
        if (const auto* refused = answer.get<Refused>()) co_return refused->reason;
        if (answer.get<SceneReady>()) co_return "";
    }
}

SceneBundle textured_scene(std::uint32_t width, std::uint32_t height) {
    SceneBundle bundle = small_scene(1);
    add_texture(
        bundle,
        {.width = width, .height = height, .rgba = std::vector<std::uint8_t>(4 * width * height)});
    return bundle;
}

TEST(Limits, of_a_picture) {
    run_limited({.picture_pixels = 150 * 100}, [](Host& host, Peer peer) -> asio::awaitable<void> {
        start_worker(host);
        co_await upload(peer, small_scene(1));
        FrameRequest request = small_request();
        expect_exact(co_await render(peer, request), request.spec);
        request.spec.size.width++;
        const Picture wider = co_await render(peer, request);
        expect_names(wider.failure, "--max-picture");
    });
}

TEST(Limits, of_a_texture) {
    const std::uint64_t bytes =
        textured_scene(3, 4).blobs.find(textured_scene(3, 4).scene.textures[0])->size();
    run_limited({.texture_bytes = bytes}, [](Host&, Peer peer) -> asio::awaitable<void> {
        EXPECT_EQ(co_await answer_to_scene(peer, textured_scene(3, 4)), "");
        expect_names(co_await answer_to_scene(peer, textured_scene(13, 1)), "--max-texture");
        EXPECT_EQ(co_await answer_to_scene(peer, textured_scene(2, 6)), "");
    });
}

TEST(Limits, of_a_scene) {
    const SceneBundle bundle = small_scene(1);
    run_limited(
        {.scene_bytes = bundle.blobs.bytes()}, [&](Host& host, Peer peer) -> asio::awaitable<void> {
            EXPECT_EQ(co_await answer_to_scene(peer, bundle), "");
            expect_names(co_await answer_to_scene(peer, textured_scene(1, 1)), "--max-scene");
            host.server.add_scene("loaded", bundle);
            EXPECT_THROW(host.server.add_scene("large", textured_scene(1, 1)), UserError);
        });
}

TEST(Limits, of_a_sessions_memory) {
    const SceneBundle bundle = small_scene(1);
    const FrameRequest request = small_request();
    run_limited({.session_bytes = bundle.blobs.bytes() + memory_of(request.spec)},
                [&](Host&, Peer peer) -> asio::awaitable<void> {
                    co_await upload(peer, bundle);
                    // Without workers the first waits.
                    peer->send({request, {}});
                    const Picture second = co_await render(peer, small_request(2));
                    expect_names(second.failure, "--max-session");
                });
    run_limited({.session_bytes = bundle.blobs.bytes() - 1},
                [&](Host&, Peer peer) -> asio::awaitable<void> {
                    expect_names(co_await answer_to_scene(peer, bundle), "--max-session");
                    EXPECT_TRUE(co_await closes(peer));
                });
}

TEST(Limits, of_frames_at_a_time) {
    run_limited({.frames = 2}, [](Host& host, Peer peer) -> asio::awaitable<void> {
        co_await upload(peer, small_scene(1));
        for (std::uint64_t i = 1; i <= 3; ++i) peer->send({small_request(i), {}});
        const Message failure = co_await receive<Failure>(peer);
        EXPECT_EQ(failure.get<Failure>()->request, 3u);
        expect_names(failure.get<Failure>()->reason, "--max-frames");
        start_worker(host);
        auto received = co_await pictures(peer, 2);
        for (std::uint64_t i = 1; i <= 2; ++i) expect_exact(received[i], small_request(i).spec);
    });
}

TEST(Limits, of_a_message) {
    const auto watch = [](std::size_t length) {
        return Message{SceneWatch{std::string(length, 'x')}, {}};
    };
    const std::size_t size = encode(watch(100)).head.size() - frame_header_bytes;
    run_limited({.message_bytes = std::uint32_t(size)},
                [&](Host&, Peer peer) -> asio::awaitable<void> {
                    peer->send(watch(100));
                    const Message answer = co_await receive<Failure>(peer);
                    EXPECT_TRUE(answer.get<Failure>());
                    peer->send(watch(101));
                    co_await expect_dismissed(peer, "--max-message");
                });
}

TEST(Limits, of_requests_in_a_second) {
    run_limited({.requests = 10}, [](Host&, Peer peer) -> asio::awaitable<void> {
        for (int i = 0; i < 30; ++i) peer->send({StatusRequest{}, {}});
        co_await expect_dismissed(peer, "--max-requests");
    });
    Rate rate;
    const auto begin = Rate::Time{} + 1h;
    for (int second = 0; second < 3; ++second)
        for (int i = 0; i < 5; ++i) EXPECT_EQ(rate.count(begin + second * 1s + i * 9ms, 3), i < 3);
}

TEST(Limits, of_sessions) {
    run_limited({.sessions = 2}, [](Host& host, Peer) -> asio::awaitable<void> {
        const auto third = co_await say_hello(host, hello_of(Role::worker));
        co_await expect_dismissed(third, "--max-sessions");
    });
}

TEST(Limits, of_handshakes_in_progress) {
    run_limited({.handshakes = 1}, [](Host& host, Peer) -> asio::awaitable<void> {
        const Address address = parse_address(host.server.address());
        const auto silent = co_await connect(address);
        const auto second = co_await connect(address);
        co_await expect_dismissed(second, "--max-handshakes");
        // Patience with the silent one ends, and the door is open again.
        EXPECT_TRUE(co_await closes(silent));
        co_await join(host, Role::viewer);
    });
}

}  // namespace
}  // namespace tessera
