#include "client/restart_bench.h"

#include <fmt/format.h>

#include <array>
#include <chrono>
#include <map>
#include <random>

#include "client/render_client.h"
#include "common/clock.h"
#include "common/connection.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

constexpr const char* scene_name = "cornell";
/// Edits go round these cameras, so that each shows the last of its own.
constexpr std::size_t marks = 8;
/// Edits under way at a time: more than a batch of the server's holds now and then.
constexpr std::uint64_t window = 16;
/// A server is killed so long after the first edit of its life, at most.
constexpr double longest_life = 0.15;
/// What does not come back within this time does not come back.
constexpr std::chrono::seconds longest_restart{30};
constexpr std::chrono::milliseconds interval{5};

std::string mark_name(std::size_t mark) { return fmt::format("mark {}", mark); }

/// Sends edits, numbered, as fast as they are acknowledged; the numbers are eyes of cameras.
class Editor {
public:
    explicit Editor(RestartReport& report) : report_(report) {}

    asio::awaitable<void> run(const LocalCluster& cluster) {
        sent_.clear();
        const auto connection = co_await connect(parse_address(cluster.address()));
        connection->send({Hello{.role = Role::viewer,
                                .build = TESSERA_VERSION,
                                .token = cluster.credentials().token,
                                .name = "editor"},
                          {}});
        for (;;) {
            const Message message = co_await connection->receive();
            if (const auto* ping = message.get<Ping>()) connection->send({Pong{ping->stamp}, {}});
            if (const auto* result = message.get<EditResult>()) acknowledge(*result);
            while (message.get<Ping>() == nullptr && sent_.size() < window) send(*connection);
        }
    }

    /// The last edit of each camera that the server has said is done.
    const std::array<std::uint64_t, marks>& acknowledged() const { return acknowledged_; }

private:
    void send(Connection& connection) {
        Camera camera{.name = mark_name(++last_ % marks)};
        camera.eye.x = float(last_);
        connection.send({SceneEdit{last_, scene_name, {SetCamera{camera}}}, {}});
        sent_[last_] = Clock::now();
    }

    void acknowledge(const EditResult& result) {
        const auto sent = sent_.find(result.request);
        if (sent == sent_.end()) throw UserError("an edit is acknowledged that was never sent");
        if (!result.complaints.empty()) throw UserError(result.complaints.front());
        report_.acknowledge_seconds.push_back(seconds_since(sent->second));
        ++report_.edits;
        acknowledged_[result.request % marks] = result.request;
        sent_.erase(sent);
    }

    RestartReport& report_;
    std::uint64_t last_ = 0;
    std::map<std::uint64_t, Clock::time_point> sent_;
    std::array<std::uint64_t, marks> acknowledged_{};
};

View small_view() {
    View view{.request = 1, .spec = {}, .format = PictureFormat::srgb8, .tone_map = {}};
    view.spec.scene = scene_name;
    view.spec.size = {64, 48};
    view.spec.camera = {.name = {}, .eye = {0, 1, 3.5f}, .at = {0, 1, 0}};
    view.spec.settings.passes = 1u << 20;
    return view;
}

std::uint64_t count_lost(const Scene& scene, const Editor& editor) {
    std::uint64_t lost = 0;
    for (std::size_t mark = 0; mark < marks; ++mark) {
        std::uint64_t there = 0;
        for (const Camera& camera : scene.cameras)
            if (camera.name == mark_name(mark)) there = std::uint64_t(camera.eye.x);
        lost += there < editor.acknowledged()[mark];
    }
    return lost;
}

}  // namespace

void bench_restarts(const RestartBenchConfig& config, RestartReport& report) {
    LocalClusterConfig cluster_config = config.cluster;
    cluster_config.scenes = {scene_name};
    LocalCluster cluster(cluster_config);
    Editor editor(report);
    std::mt19937 random(config.seed);
    std::uniform_real_distribution<double> life(0, longest_life);
    RenderClient viewer({.address = cluster.address(),
                         .credentials = cluster.credentials(),
                         .tick = [&] { config.tick(report.kills); },
                         .reconnects = true});
    const auto wait_for_picture = [&] {
        const auto deadline = Clock::now() + longest_restart;
        while (!viewer.take_picture()) {
            viewer.poll(interval);
            if (Clock::now() > deadline) throw UserError("the viewer sees no picture any more");
        }
    };
    viewer.watch(scene_name);
    viewer.show(small_view());
    wait_for_picture();
    while (report.kills < config.kills) {
        // Edit until the server is killed, and hear what it still said.
        asio::io_context io(1);
        bool ended = false;
        std::exception_ptr failure;
        asio::co_spawn(io, editor.run(cluster), [&](std::exception_ptr error) {
            ended = true;
            failure = error;
        });
        const std::uint64_t before = report.edits;
        while (!ended && report.edits == before) io.run_one_for(interval);
        io.run_for(from_seconds(life(random)));
        cluster.kill_server();
        ++report.kills;
        while (!ended) io.run_one_for(interval);
        try {
            std::rethrow_exception(failure);
        } catch (const boost::system::system_error&) {
            // As it must be: the connection is lost.
        }

        // Start the server again, and look.
        while (viewer.connected()) viewer.poll(interval);
        viewer.wait_until(Clock::now() + from_seconds(config.down_seconds));
        viewer.take_picture();
        viewer.take_complaints();
        const auto started = Clock::now();
        cluster.start_server();
        report.start_seconds.push_back(seconds_since(started));
        wait_for_picture();
        report.picture_seconds.push_back(seconds_since(started));
        report.lost += count_lost(viewer.scene().scene, editor);
    }
}

}  // namespace tessera
