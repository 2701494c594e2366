// Frame assembly: any order and any duplication of results gives the same bits; passes fold in
// order; the error estimate is the one of its definition.

#include "server/frame.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>

#include "common/discontinuity.h"
#include "server/runs.h"
#include "tests/fake_answer.h"

namespace tessera {
namespace {

FrameSpec small_frame(Integrator integrator, std::uint32_t passes) {
    FrameSpec spec;
    spec.frame = 7;
    spec.size = {50, 37};
    spec.settings.integrator = integrator;
    spec.settings.passes = passes;
    spec.extra = ChannelSet{}
                     .with(Channel::albedo)
                     .with(Channel::irradiance)
                     .with(Channel::depth)
                     .with(Channel::direct);
    return spec;
}

struct Assembly {
    FrameSpec spec;
    FrameAssembler assembler;
    FrameSums sums;

    explicit Assembly(const FrameSpec& s) : spec(s), assembler(s), sums(s) {}

    Arrival add(const TileTask& task) {
        return assembler.add(task, packed(spec, fake_answer(spec, task)), 0, lights(task));
    }
    /// Numbers whose sums depend on their order; a tile's are those of its quarters.
    static std::vector<LightEstimate> lights(TileTask task) {
        if (task.part > 0)
            return {{task.tile % 3, 0.1f * float(task.tile + task.part)},
                    {3 + task.tile % 5, 0.25e6f / float(task.first_pass + 1)}};
        std::vector<LightEstimate> sum;
        for (task.part = 1; task.part <= quarters; ++task.part) {
            std::vector<LightEstimate> part = lights(task);
            add_estimates(part, sum);
        }
        return sum;
    }
    void fold(int band_rows) {
        while (std::optional<RunBuffer> run = assembler.take_complete()) {
            for (int y = 0; y < spec.size.height; y += band_rows)
                sums.fold(*run, y, std::min(y + band_rows, spec.size.height));
            sums.finish_run(*run);
            assembler.run_folded(std::move(*run));
        }
    }
};

Assembly assemble_in_order(const FrameSpec& spec) {
    Assembly frame(spec);
    for (const TileTask& task : all_tasks(spec)) {
        EXPECT_EQ(frame.add(task), Arrival::stored);
        frame.fold(spec.size.height);
    }
    EXPECT_TRUE(frame.assembler.finished());
    return frame;
}

void expect_same_bits(const Assembly& a, const Assembly& b) {
    EXPECT_EQ(a.sums.picture(), b.sums.picture());
    EXPECT_EQ(a.sums.error_estimate(), b.sums.error_estimate());
    for (Channel c : {Channel::albedo, Channel::irradiance, Channel::depth, Channel::direct})
        EXPECT_EQ(a.sums.channel(c), b.sums.channel(c)) << int(c);
}

TEST(Frame, any_order_and_duplication_gives_the_same_bits) {
    for (const Integrator integrator : {Integrator::igi, Integrator::path}) {
        const FrameSpec spec = small_frame(integrator, integrator == Integrator::igi ? 5 : 70);
        const Assembly expected = assemble_in_order(spec);
        for (unsigned seed = 0; seed < 8; ++seed) {
            Assembly frame(spec);
            std::mt19937 random(seed);
            std::vector<TileTask> tasks = cut_some(spec, all_tasks(spec), random);
            std::shuffle(tasks.begin(), tasks.end(), random);
            for (const TileTask& task : tasks) {
                EXPECT_EQ(frame.add(task), Arrival::stored);
                EXPECT_EQ(frame.add(task), Arrival::duplicate);
                frame.fold(1 + int(random() % 20));
            }
            EXPECT_TRUE(frame.assembler.finished());
            EXPECT_EQ(frame.assembler.tiles_done(), frame.assembler.tiles_total());
            expect_same_bits(frame, expected);
            EXPECT_EQ(frame.sums.lights(100), expected.sums.lights(100));
        }
    }
}

TEST(Frame, a_tile_may_come_after_some_of_its_quarters) {
    const FrameSpec spec = small_frame(Integrator::igi, 2);
    const Assembly expected = assemble_in_order(spec);
    Assembly frame(spec);
    for (const TileTask& task : all_tasks(spec)) {
        TileTask part = task;
        part.part = can_be_cut(spec.size, task.tile) ? 1 + task.tile % quarters : 0;
        EXPECT_EQ(frame.add(part), Arrival::stored);
        EXPECT_EQ(frame.add(task), part.part > 0 ? Arrival::stored : Arrival::duplicate);
        EXPECT_EQ(frame.add(part), Arrival::duplicate);
        frame.fold(spec.size.height);
    }
    EXPECT_TRUE(frame.assembler.finished());
    expect_same_bits(frame, expected);
    EXPECT_EQ(frame.sums.lights(100), expected.sums.lights(100));
}

TEST(Frame, lights_that_send_most_are_told_by_number) {
    const Assembly frame = assemble_in_order(small_frame(Integrator::igi, 2));
    const std::vector<LightEstimate> all = frame.sums.lights(100), most = frame.sums.lights(5);
    ASSERT_EQ(all.size(), 8u);
    ASSERT_EQ(most.size(), 5u);
    for (std::uint32_t i = 0; i < 5; ++i) EXPECT_EQ(most[i], all[3 + i]);
    // Passes of 12 tiles; a light of five gets a million, and half of it in the second pass.
    EXPECT_NEAR(all[7].radiance, 0.75e6f * 2, 1);
}

TEST(Frame, the_error_of_pixels_adds_up_to_that_of_the_picture) {
    FrameSpec spec = small_frame(Integrator::path, 70);
    spec.extra = spec.extra.with(Channel::error);
    Assembly frame(spec);
    for (const TileTask& task : all_tasks(spec)) {
        frame.add(task);
        frame.fold(spec.size.height);
        const Image error = frame.sums.channel(Channel::error);
        if (frame.sums.runs() < 2) {
            EXPECT_TRUE(std::isinf(error.data[0]));
            continue;
        }
        double squares = 0;
        for (const float e : error.data) squares += double(e) * double(e);
        EXPECT_NEAR(std::sqrt(squares / double(error.data.size())), frame.sums.error_estimate(),
                    1e-5);
    }
}

TEST(Frame, owners_are_those_of_the_tiles_in_the_newest_run) {
    FrameSpec spec = small_frame(Integrator::path, 33);
    spec.extra = spec.extra.with(Channel::owner);
    Assembly frame(spec);
    std::mt19937 random(1);
    const std::vector<TileTask> tasks = cut_some(spec, all_tasks(spec), random);
    const auto owner = [](const TileTask& task) {
        return 10 * task.tile + task.first_pass + task.part;
    };
    for (const TileTask& task : tasks) {
        frame.assembler.add(task, packed(spec, fake_answer(spec, task)), owner(task));
        frame.fold(7);
    }
    const Image owners = frame.sums.channel(Channel::owner);
    for (const TileTask& task : tasks) {
        if (*run_of(spec, task) + 1 != frame.sums.runs()) continue;
        const Rect rect = rect_of(spec.size, task);
        for (int y = rect.y0; y < rect.y1; ++y)
            for (int x = rect.x0; x < rect.x1; ++x)
                EXPECT_EQ(owners.data[std::size_t(y * spec.size.width + x)], float(owner(task)));
    }
}

TEST(Frame, sums_that_were_saved_go_on_to_the_same_bits) {
    for (const FilterPlace filter : {FilterPlace::server, FilterPlace::off})
        for (const Integrator integrator : {Integrator::igi, Integrator::path}) {
            FrameSpec spec = small_frame(integrator, integrator == Integrator::igi ? 5 : 70);
            spec.settings.filter = filter;
            const Assembly expected = assemble_in_order(spec);
            Assembly begun(spec);
            for (const TileTask& task : all_tasks(spec)) {
                begun.add(task);
                const std::uint32_t runs_before = begun.sums.runs();
                begun.fold(spec.size.height);
                if (begun.sums.runs() == runs_before) continue;

                // Another server takes over here.
                Assembly rest(spec);
                ASSERT_TRUE(rest.sums.resume(begun.sums.saved()));
                rest.assembler = FrameAssembler(spec, rest.sums.runs());
                for (const TileTask& later : all_tasks(spec)) {
                    if (*run_of(spec, later) < rest.sums.runs()) continue;
                    EXPECT_EQ(rest.add(later), Arrival::stored);
                    rest.fold(spec.size.height);
                }
                EXPECT_TRUE(rest.assembler.finished());
                EXPECT_EQ(rest.sums.passes(), expected.sums.passes());
                expect_same_bits(rest, expected);
            }
        }
}

TEST(Frame, sums_of_other_frames_are_refused) {
    const FrameSpec spec = small_frame(Integrator::igi, 5);
    const Bytes saved = assemble_in_order(spec).sums.saved();
    FrameSpec larger = spec;
    ++larger.size.width;
    EXPECT_FALSE(FrameSums(larger).resume(saved));
    EXPECT_FALSE(FrameSums(small_frame(Integrator::igi, 4)).resume(saved));  // has 5 runs
    EXPECT_FALSE(FrameSums(spec).resume(std::span(saved).first(saved.size() - 1)));
    EXPECT_FALSE(FrameSums(spec).resume({}));
}

TEST(Frame, picture_is_the_mean_of_radiance_and_filtered_irradiance) {
    const FrameSpec spec = small_frame(Integrator::igi, 1);
    Assembly frame(spec);
    for (const TileTask& task : all_tasks(spec)) frame.add(task);
    RunBuffer run = *frame.assembler.take_complete();
    frame.sums.fold(run, 0, spec.size.height);
    frame.sums.finish_run(run);

    const std::size_t n = spec.size.pixels();
    const auto plane = [&](std::size_t from, std::size_t floats) {
        return std::span(run.data).subspan(from * n, floats * n);
    };
    std::vector<float> filtered(3 * n);
    filter_irradiance(
        {.picture = spec.size, .camera = spec.camera, .window = int(spec.settings.interleave)},
        {.area = {0, 0, spec.size.width, spec.size.height},
         .irradiance = plane(3, 3),
         .normal = plane(9, 3),
         .depth = plane(12, 1),
         .surface = plane(13, 1)},
        {0, 0, spec.size.width, spec.size.height}, filtered);
    const Image picture = frame.sums.picture();
    for (std::size_t i = 0; i < 3 * n; ++i)
        ASSERT_FLOAT_EQ(picture.data[i], plane(0, 3)[i] + plane(6, 3)[i] / pi * filtered[i]);
    EXPECT_EQ(frame.sums.channel(Channel::irradiance).data, filtered);
    EXPECT_EQ(frame.sums.error_estimate(), 0);
}

TEST(Frame, error_estimate_is_the_standard_error_of_the_mean_of_runs) {
    const FrameSpec spec = small_frame(Integrator::path, 80);
    Assembly frame(spec);
    std::vector<std::vector<double>> means;
    for (const TileTask& task : all_tasks(spec)) {
        frame.add(task);
        if (task.tile + 1 < tile_count(spec.size)) continue;
        RunBuffer run = *frame.assembler.take_complete();
        means.emplace_back();
        for (std::size_t i = 0; i < 3 * spec.size.pixels(); ++i)
            means.back().push_back(run.data[i] / double(run.passes));
        frame.sums.fold(run, 0, spec.size.height);
        frame.sums.finish_run(run);
        frame.assembler.run_folded(run);
    }
    double sum = 0;
    const double n = double(means.size());
    for (std::size_t i = 0; i < means[0].size(); ++i) {
        double mean = 0, squares = 0;
        for (const auto& m : means) mean += m[i] / n;
        for (const auto& m : means) squares += (m[i] - mean) * (m[i] - mean);
        sum += squares / (n - 1) / n;
    }
    EXPECT_NEAR(frame.sums.error_estimate(), std::sqrt(sum / double(means[0].size())), 1e-6);
}

TEST(Frame, results_of_the_wrong_shape_are_refused) {
    const FrameSpec spec = small_frame(Integrator::igi, 2);
    Assembly frame(spec);
    const TileTask good = task_of(spec, 0, 3);
    const Bytes pixels = packed(spec, fake_answer(spec, good));
    const auto broken = [&](auto change) {
        TileTask task = good;
        Bytes bytes = pixels;
        change(task, bytes);
        EXPECT_EQ(frame.assembler.add(task, bytes), Arrival::broken);
    };
    broken([](TileTask&, Bytes& b) { b.pop_back(); });
    broken([](TileTask&, Bytes& b) { b.push_back({}); });
    broken([](TileTask&, Bytes& b) { b.clear(); });
    broken([](TileTask&, Bytes& b) { b[0] = std::byte(3); });
    broken([](TileTask& t, Bytes&) { t.tile = 100; });
    broken([](TileTask& t, Bytes&) { t.first_pass = 2; });
    broken([](TileTask& t, Bytes&) { t.pass_count = 2; });
    broken([](TileTask& t, Bytes&) { t.frame = 8; });
    broken([](TileTask& t, Bytes&) { t.part = 1; });  // too narrow to be cut
    EXPECT_EQ(frame.assembler.add(good, pixels), Arrival::stored);
}

TEST(Frame, early_stop_is_the_frame_of_fewer_passes) {
    const Assembly expected = assemble_in_order(small_frame(Integrator::igi, 3));
    Assembly frame(small_frame(Integrator::igi, 9));
    std::vector<TileTask> tasks = all_tasks(frame.spec);
    const std::size_t tiles = tile_count(frame.spec.size);
    for (std::size_t i = 0; i < 2 * tiles; ++i) frame.add(tasks[i]);
    for (std::size_t i = 3 * tiles; i < 4 * tiles + 3; ++i) frame.add(tasks[i]);
    frame.assembler.limit_passes(3);
    frame.fold(8);
    EXPECT_FALSE(frame.assembler.finished());
    EXPECT_EQ(frame.assembler.tiles_done(), 2 * tiles);
    for (std::size_t i = 2 * tiles; i < 3 * tiles; ++i) frame.add(tasks[i]);
    EXPECT_EQ(frame.add(tasks[3 * tiles]), Arrival::not_wanted);
    frame.fold(8);
    EXPECT_TRUE(frame.assembler.finished());
    expect_same_bits(frame, expected);
    frame.assembler.limit_passes(1);
    EXPECT_TRUE(frame.assembler.finished());
    EXPECT_EQ(frame.sums.passes(), 3u);
}

TEST(Frame, runs_in_flight_are_bounded_by_what_has_been_folded) {
    FrameSpec spec = small_frame(Integrator::igi, 1000);
    spec.size = {1024, 1024};
    Assembly frame(spec);
    EXPECT_EQ(frame.assembler.run_limit(), frame.assembler.window());
    EXPECT_GE(frame.assembler.window(), 2u);
    EXPECT_LE(frame.assembler.window(), 8u);
    EXPECT_EQ(frame.add(task_of(spec, frame.assembler.window(), 0)), Arrival::not_wanted);
    for (std::uint32_t tile = 0; tile < tile_count(spec.size); ++tile)
        frame.add(task_of(spec, 0, tile));
    EXPECT_EQ(frame.assembler.run_limit(), frame.assembler.window());
    frame.fold(100);
    EXPECT_EQ(frame.assembler.run_limit(), frame.assembler.window() + 1);
}

TEST(Frame, bytes_are_those_of_the_picture) {
    const ToneTable table({});
    for (const Integrator integrator : {Integrator::igi, Integrator::path}) {
        FrameSpec spec = small_frame(integrator, integrator == Integrator::igi ? 3 : 70);
        if (integrator == Integrator::path) spec.extra = {};
        Assembly frame(spec);
        const auto expect_bytes = [&] {
            const Image picture = frame.sums.picture();
            std::vector<std::uint8_t> bytes(picture.data.size());
            for (int y = 0; y < spec.size.height; y += 16)
                frame.sums.srgb8_rows(table, y, std::min(y + 16, spec.size.height),
                                      &bytes[3 * std::size_t(y * spec.size.width)]);
            EXPECT_TRUE(std::ranges::equal(bytes, picture.data, {}, {}, table));
        };
        expect_bytes();  // black
        for (const TileTask& task : all_tasks(spec)) {
            frame.add(task);
            frame.fold(spec.size.height);
            if (task.tile + 1 == tile_count(spec.size)) expect_bytes();
        }
    }
}

TEST(Frame, values_that_are_not_finite_do_not_reach_the_picture) {
    for (const Integrator integrator : {Integrator::igi, Integrator::path}) {
        FrameSpec spec = small_frame(integrator, 1);
        if (integrator == Integrator::path) spec.extra = {};
        Assembly frame(spec);
        for (const TileTask& task : all_tasks(spec)) {
            TileResult result = fake_answer(spec, task);
            for (std::size_t i = 0; i < result.data.size(); i += 17) result.data[i] = std::nanf("");
            frame.assembler.add(task, packed(spec, result));
        }
        frame.fold(10);
        for (float v : frame.sums.picture().data) ASSERT_TRUE(std::isfinite(v));
    }
}

}  // namespace
}  // namespace tessera
