// Real processes on loopback: the same frame is the same bits from any number of workers and
// threads, and when a worker is killed in mid-frame; nothing is left behind.

#include <gtest/gtest.h>
#include <signal.h>

#include <filesystem>

#include "client/local_cluster.h"
#include "client/render_client.h"
#include "client/restart_bench.h"
#include "common/check.h"
#include "common/generator.h"
#include "tests/temp_dir.h"

namespace tessera {
namespace {

FrameRequest small_picture(const SceneBundle& bundle) {
    FrameRequest request;
    request.spec.scene = "scene";
    request.spec.size = {200, 120};
    request.spec.camera = bundle.scene.cameras.front();
    return request;
}

struct Cluster {
    LocalCluster processes;
    RenderClient client;

    Cluster(int workers, int threads)
        : Cluster({.workers = workers, .threads = threads, .programs = TESSERA_PROGRAMS}) {}
    explicit Cluster(const LocalClusterConfig& config)
        : processes(config),
          client({.address = processes.address(), .credentials = processes.credentials()}) {}

    /// Waits until the server's status is as `wanted` says.
    Status wait_for(const std::function<bool(const Status&)>& wanted) {
        for (;;) {
            Status status = client.status();
            if (wanted(status)) return status;
            client.wait_until(std::chrono::steady_clock::now() + std::chrono::milliseconds(10));
        }
    }
};

/// Of blobs that are kept there.
std::uint64_t bytes_in(const std::filesystem::path& folder) {
    std::uint64_t sum = 0;
    for (const auto& file : std::filesystem::directory_iterator(folder))
        if (file.path().extension() == ".blob") sum += file.file_size();
    return sum;
}

const SceneBundle& office() {
    static const SceneBundle bundle = *generate_scene("office");
    return bundle;
}

/// A hundred lamps, of which those that matter are found.
const SceneBundle& rooms() {
    static const SceneBundle bundle = *generate_scene("rooms");
    return bundle;
}

Image render(
    Cluster& cluster, const SceneBundle& scene, const FrameRequest& request,
    const std::function<void(const FrameProgress&)>& progress = [](const FrameProgress&) {}) {
    cluster.client.upload_scene("scene", scene);
    return cluster.client.render(request, progress).channels.at(Channel::radiance);
}

TEST(Cluster, same_bits_from_any_number_of_workers_and_threads) {
    Cluster one(1, 1);
    const Image of_office = render(one, office(), small_picture(office()));
    const Image of_rooms = render(one, rooms(), small_picture(rooms()));
    for (const auto& [workers, threads] : {std::pair(1, 2), std::pair(2, 1), std::pair(3, 2)}) {
        Cluster cluster(workers, threads);
        EXPECT_EQ(render(cluster, office(), small_picture(office())), of_office)
            << workers << " workers, " << threads << " threads";
        EXPECT_EQ(render(cluster, rooms(), small_picture(rooms())), of_rooms)
            << workers << " workers, " << threads << " threads";
    }
}

TEST(Cluster, same_bits_when_a_worker_is_killed_in_mid_frame) {
    FrameRequest request = small_picture(rooms());
    request.spec.settings.passes = 24;
    Cluster undisturbed(1, 2);
    const Image expected = render(undisturbed, rooms(), request);

    Cluster cluster(2, 1);
    bool killed = false;
    const Image picture = render(cluster, rooms(), request, [&](const FrameProgress& p) {
        if (killed || p.workers < 2 || p.tiles_done == 0) return;
        kill(cluster.processes.workers().front(), SIGKILL);
        killed = true;
    });
    EXPECT_TRUE(killed) << "the frame was over before a worker could be killed";
    EXPECT_EQ(picture, expected);
}

TEST(Cluster, same_bits_from_workers_that_get_meshes_from_one_another) {
    const FrameRequest request = small_picture(office());
    Cluster alone(1, 2);
    const Image expected = render(alone, office(), request);

    Cluster cluster({.workers = 3, .threads = 1, .relays = "on", .programs = TESSERA_PROGRAMS});
    cluster.wait_for([](const Status& status) { return status.workers.size() == 3; });
    EXPECT_EQ(render(cluster, office(), request), expected);
    // One of them gets everything from the server, and the others from those before them.
    std::uint64_t relayed = 0;
    cluster.wait_for([&](const Status& status) {
        std::uint64_t sent = relayed = 0;
        for (const WorkerStatus& worker : status.workers) {
            sent += worker.sent_bytes;
            relayed += worker.relayed_bytes;
        }
        return relayed > 0 || sent > 3 * office().blobs.bytes();
    });
    if (relayed == 0) GTEST_SKIP() << "no worker let another one in within two seconds";
}

TEST(Cluster, a_worker_that_is_killed_comes_back_with_its_meshes) {
    const TempDir dir;
    const std::filesystem::path cache = dir.file("cache");
    const FrameRequest request = small_picture(office());
    Cluster cluster(
        {.workers = 1, .threads = 2, .blob_cache = cache, .programs = TESSERA_PROGRAMS});
    const Image first = render(cluster, office(), request);
    const auto sent = [&] { return cluster.client.status().workers.at(0).sent_bytes; };
    EXPECT_GT(sent(), office().blobs.bytes());
    cluster.wait_for([&](const Status&) { return bytes_in(cache) == office().blobs.bytes(); });

    cluster.processes.restart_worker(0);
    EXPECT_EQ(render(cluster, office(), request), first);
    EXPECT_LT(sent(), office().blobs.bytes() / 4);
}

TEST(Cluster, a_second_upload_of_the_same_scene_renders_the_same) {
    const FrameRequest request = small_picture(office());
    Cluster cluster(1, 2);
    const Image first = render(cluster, office(), request);
    EXPECT_EQ(render(cluster, office(), request), first);
}

TEST(Cluster, wrong_token_is_refused_with_a_reason) {
    LocalCluster processes({.workers = 1, .threads = 1, .programs = TESSERA_PROGRAMS});
    try {
        RenderClient client({.address = processes.address(), .credentials = {"guess", nullptr}});
        FAIL() << "the server let a stranger in";
    } catch (const UserError& error) {
        EXPECT_NE(std::string(error.what()).find("token"), std::string::npos) << error.what();
    }
}

TEST(Cluster, a_server_that_is_killed_comes_back_with_every_edit) {
    const TempDir dir;
    RestartReport report;
    bench_restarts({.cluster = {.workers = 1,
                                .threads = 1,
                                .log_level = "error",
                                .journal = dir.file("journal"),
                                .programs = TESSERA_PROGRAMS},
                    .kills = 20},
                   report);
    EXPECT_EQ(report.kills, 20);
    EXPECT_GT(report.edits, 20u);
    EXPECT_EQ(report.lost, 0u);
}

TEST(Cluster, children_are_gone_with_the_cluster) {
    std::vector<pid_t> workers;
    {
        LocalCluster processes({.workers = 2, .threads = 1, .programs = TESSERA_PROGRAMS});
        workers = processes.workers();
        for (const pid_t pid : workers) EXPECT_EQ(kill(pid, 0), 0);
    }
    for (const pid_t pid : workers) EXPECT_NE(kill(pid, 0), 0);
}

}  // namespace
}  // namespace tessera
