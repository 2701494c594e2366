#include "worker/renderer.h"

#include <fmt/format.h>
#include <gtest/gtest.h>

#include <atomic>
#include <bit>
#include <map>
#include <random>
#include <thread>

#include "common/generator.h"
#include "worker/bench/render_fixture.h"
#include "worker/camera.h"

namespace tessera {
namespace {

SceneBundle cornell() { return *generate_scene("cornell"); }

FrameSpec cornell_frame(const SceneBundle& bundle, Integrator integrator, ImageSize size,
                        std::uint32_t passes) {
    FrameSpec spec = frame_of(integrator, size, bundle.scene.cameras.at(0), passes);
    spec.extra = spec.extra.with(Channel::direct).with(Channel::indirect);
    return spec;
}

std::vector<std::uint32_t> bits(const std::vector<float>& values) {
    std::vector<std::uint32_t> out;
    for (const float v : values) out.push_back(std::bit_cast<std::uint32_t>(v));
    return out;
}

using Pictures = std::map<TileTask, std::vector<std::uint32_t>>;

/// All tasks, shuffled, on several threads.
Pictures render_shuffled(const SceneBundle& bundle, const FrameSpec& spec, unsigned seed,
                         int threads) {
    Renderer renderer(bundle.scene, bundle.blobs, {.threads = threads});
    renderer.begin_frame(spec);
    std::vector<TileTask> tasks = tasks_of(spec);
    std::shuffle(tasks.begin(), tasks.end(), std::mt19937(seed));
    std::vector<std::vector<std::uint32_t>> results(tasks.size());
    std::atomic<std::size_t> next = 0;
    {
        std::vector<std::jthread> crew;
        for (int i = 0; i < threads; ++i)
            crew.emplace_back([&] {
                for (std::size_t t; (t = next++) < tasks.size();)
                    results[t] = bits(renderer.render(tasks[t])->data);
            });
    }
    Pictures pictures;
    for (std::size_t i = 0; i < tasks.size(); ++i) pictures[tasks[i]] = std::move(results[i]);
    return pictures;
}

class RendererOf : public testing::TestWithParam<std::tuple<Integrator, TracerKind>> {};

TEST_P(RendererOf, GivesTheSameBitsForAnyOrderAndThreads) {
    const SceneBundle bundle = cornell();
    FrameSpec spec = cornell_frame(bundle, std::get<0>(GetParam()), {40, 33}, 20);
    spec.settings.tracer = std::get<1>(GetParam());
    const Pictures reference = render_shuffled(bundle, spec, 1, 1);
    for (const unsigned seed : {2u, 3u})
        EXPECT_TRUE(render_shuffled(bundle, spec, seed, 3) == reference);
}

INSTANTIATE_TEST_SUITE_P(Each, RendererOf,
                         testing::Combine(testing::Values(Integrator::path, Integrator::igi),
                                          testing::Values(TracerKind::kdtree, TracerKind::embree)));

TEST(Renderer, TracksLightsToTheSameBits) {
    const SceneBundle bundle = *generate_scene("rooms");
    const FrameSpec spec = frame_of(Integrator::igi, {48, 32}, bundle.scene.cameras.at(0), 2);
    Renderer one(bundle.scene, bundle.blobs, {}), two(bundle.scene, bundle.blobs, {.threads = 3});
    const std::vector<TileResult> expected = render_all(one, spec);
    two.begin_frame(spec);
    const std::vector<TileTask> tasks = tasks_of(spec);
    for (std::size_t i = tasks.size(); i-- > 0;) {
        const TileResult got = *two.render(tasks[i]);
        EXPECT_EQ(bits(got.data), bits(expected[i].data));
        EXPECT_EQ(got.lights, expected[i].lights);
    }
}

/// The pixels of `part` in a result for `rect`.
std::vector<float> cropped(const FrameSpec& spec, const TileResult& result, const Rect& rect,
                           const Rect& part) {
    std::vector<float> out;
    std::size_t offset = 0;
    for (int c = 0; c < channel_count; ++c) {
        if (!tile_channels(spec).has(Channel(c))) continue;
        const auto floats = std::size_t(floats_per_pixel(Channel(c)));
        for (int y = part.y0; y < part.y1; ++y) {
            const int first = (y - rect.y0) * rect.width() + part.x0 - rect.x0;
            const auto row = result.data.begin() + std::ptrdiff_t(offset + floats * first);
            out.insert(out.end(), row, row + std::ptrdiff_t(floats * part.width()));
        }
        offset += floats * rect.pixels();
    }
    return out;
}

/// Lamps with rims, lights that are tracked, lobes of every kind, and sets of VPLs that light whole
/// tiles at a time.
TEST(Renderer, QuartersAreTheSameBitsAsTheirTile) {
    std::size_t cut = 0, with_lights = 0;
    for (const char* name : {"cornell", "rooms", "kitchen", "shading"}) {
        const SceneBundle bundle = *generate_scene(name);
        Renderer renderer(bundle.scene, bundle.blobs, {});
        FrameSpec spec = cornell_frame(bundle, Integrator::igi, {90, 56}, 1);
        for (const std::uint32_t interleave : {1u, 3u, 0u}) {
            SCOPED_TRACE(fmt::format("{}, {}", name, interleave));
            spec.settings.tracer = interleave == 1 ? TracerKind::kdtree : TracerKind::embree;
            spec.settings.interleave = std::max(interleave, 1u);
            if (interleave == 0) spec.settings.integrator = Integrator::path;
            ++spec.frame;
            renderer.begin_frame(spec);
            for (TileTask task : tasks_of(spec)) {
                if (!can_be_cut(spec.size, task.tile)) continue;
                ++cut;
                const TileResult whole = *renderer.render(task);
                std::vector<LightEstimate> lights;
                for (task.part = 1; task.part <= quarters; ++task.part) {
                    const TileResult part = *renderer.render(task);
                    EXPECT_EQ(bits(part.data),
                              bits(cropped(spec, whole, rect_of(spec.size, whole.task),
                                           rect_of(spec.size, task))))
                        << task.tile << ' ' << task.part;
                    add_estimates(part.lights, lights);
                }
                EXPECT_EQ(lights, whole.lights);
                with_lights += !lights.empty();
            }
        }
    }
    EXPECT_EQ(cut, 4 * 3 * 6 * 3u);
    EXPECT_GT(with_lights, 20u);
}

TEST(Renderer, ATaskIsTheSumOfItsPasses) {
    const SceneBundle bundle = cornell();
    for (const Integrator integrator : {Integrator::path, Integrator::igi}) {
        const FrameSpec spec = cornell_frame(bundle, integrator, {16, 16}, 4);
        Renderer renderer(bundle.scene, bundle.blobs, {});
        renderer.begin_frame(spec);
        const TileResult whole = *renderer.render({1, 0, 0, 4});
        std::vector<TileResult> parts;
        for (std::uint32_t pass = 0; pass < 4; ++pass)
            parts.push_back(*renderer.render({1, 0, pass, 1}));
        const std::size_t end = channel_offset(spec, Channel::irradiance, 256);
        for (std::size_t i = 0; i < end; ++i) {
            float sum = 0;
            for (const TileResult& part : parts) sum += part.data[i];
            EXPECT_EQ(whole.data[i], sum);
        }
        EXPECT_EQ(whole.data.size(), 256u * floats_per_pixel(tile_channels(spec)));
    }
}

TEST(Renderer, DirectAndIndirectAddUpToThePicture) {
    const SceneBundle bundle = cornell();
    const FrameSpec spec = cornell_frame(bundle, Integrator::path, {16, 16}, 1);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const TileResult r = render_all(renderer, spec).front();
    const std::size_t direct = channel_offset(spec, Channel::direct, 256);
    const std::size_t indirect = channel_offset(spec, Channel::indirect, 256);
    for (std::size_t i = 0; i < 3 * 256; ++i)
        EXPECT_NEAR(r.data[i], r.data[direct + i] + r.data[indirect + i], 1e-4f);
}

TEST(Renderer, SeedsChangeTheNoiseAndNotTheMean) {
    const SceneBundle bundle = cornell();
    FrameSpec spec = cornell_frame(bundle, Integrator::igi, {32, 32}, 16);
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const vec3 mean = mean_radiance(spec, render_all(renderer, spec));
    spec.frame = 2;
    spec.settings.seed = 7;
    const vec3 other = mean_radiance(spec, render_all(renderer, spec));
    EXPECT_NE(mean, other);
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(mean[c], other[c], 0.03f * mean[c]);
}

TEST(Renderer, BothIntegratorsHaveTheSameMean) {
    const SceneBundle bundle = cornell();
    Renderer renderer(bundle.scene, bundle.blobs, {});
    FrameSpec spec = cornell_frame(bundle, Integrator::path, {48, 48}, 128);
    const vec3 path = mean_radiance(spec, render_all(renderer, spec));
    spec = cornell_frame(bundle, Integrator::igi, {48, 48}, 64);
    spec.frame = 2;
    const vec3 igi = mean_radiance(spec, render_all(renderer, spec));
    for (int c = 0; c < 3; ++c) EXPECT_NEAR(igi[c], path[c], 0.01f * path[c]);
}

TEST(Pinhole, FindsWhereARayOfAPixelGoes) {
    Camera camera;
    camera.eye = {1, 2, 3};
    camera.at = {-2, 1, 0.5f};
    camera.up = {0, 1, 0.2f};
    camera.fov_y = 70;
    const Pinhole pinhole(camera, {64, 40});
    std::mt19937 random(1);
    std::uniform_real_distribution<float> number(-20, 80);
    for (int i = 0; i < 100; ++i) {
        const vec2 raster(number(random), number(random));
        const Ray ray = pinhole.ray(raster);
        const auto seen = pinhole.raster(ray.org + 5.0f * ray.dir);
        ASSERT_TRUE(seen);
        EXPECT_NEAR(length(*seen - raster), 0, 1e-3f);
        EXPECT_FALSE(pinhole.raster(ray.org - 5.0f * ray.dir));
    }
}

TEST(Renderer, KnowsOnlyFramesBetweenBeginAndEnd) {
    const SceneBundle bundle = cornell();
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const FrameSpec spec = cornell_frame(bundle, Integrator::igi, {16, 16}, 1);
    EXPECT_FALSE(renderer.render({1, 0, 0, 1}));
    renderer.begin_frame(spec);
    renderer.begin_frame(spec);
    EXPECT_TRUE(renderer.render({1, 0, 0, 1}));
    renderer.end_frame(1);
    EXPECT_FALSE(renderer.render({1, 0, 0, 1}));
}

TEST(Renderer, LeavesPixelsWithoutASurfaceEmpty) {
    const SceneBundle bundle = cornell();
    FrameSpec spec = cornell_frame(bundle, Integrator::igi, {16, 16}, 1);
    spec.camera.at = 2.0f * spec.camera.eye - spec.camera.at;  // look away
    Renderer renderer(bundle.scene, bundle.blobs, {});
    const TileResult r = render_all(renderer, spec).front();
    EXPECT_EQ(r.data[channel_offset(spec, Channel::depth, 256)], infinity);
    EXPECT_EQ(bits(r.data)[channel_offset(spec, Channel::surface, 256)], 0u);
    EXPECT_EQ(r.sanitised, 0u);
}

TEST(Renderer, NamesWhatIsMissing) {
    SceneBundle bundle = cornell();
    EXPECT_THROW(Renderer(bundle.scene, BlobStore{}, {}), std::runtime_error);
}

TEST(Renderer, PlansWhatTheSceneNeeds) {
    SceneBundle bundle = cornell();
    bundle.scene.materials[0].metallic = 0.5f;
    const Renderer renderer(bundle.scene, bundle.blobs, {});
    const auto has = [](const std::vector<std::string>& lines, const std::string& text) {
        return std::any_of(lines.begin(), lines.end(), [&](const std::string& line) {
            return line.find(text) != std::string::npos;
        });
    };
    EXPECT_TRUE(has(renderer.plan().modelled, "area lights: 2"));
    EXPECT_TRUE(has(renderer.plan().modelled, "glossy reflection: 1"));
    EXPECT_TRUE(has(renderer.plan().left_out, "glass"));
    EXPECT_TRUE(has(renderer.plan().left_out, "textures"));
}

}  // namespace
}  // namespace tessera
