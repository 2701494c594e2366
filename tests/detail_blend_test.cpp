// The blend of filtered and unfiltered pictures: leaves noise out, brings lost detail back, and
// knows its own error.

#include "server/detail_blend.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace tessera {
namespace {

constexpr ImageSize size{53, 37};
constexpr std::size_t row_floats = 3 * 53;

/// A filter that took `lost` away from the middle of the picture, and noise.
struct Detail {
    float lost = 0;
    float noise = 0;
    std::mt19937 random{7};

    std::vector<float> row(int y) {
        std::normal_distribution<float> gauss(0, 1);
        std::vector<float> out(row_floats);
        for (std::size_t i = 0; i < row_floats; ++i)
            out[i] = truth(int(i) / 3, y) + noise * gauss(random);
        return out;
    }
    float truth(int x, int y) const { return x > 15 && x < 33 && y > 15 && y < 33 ? lost : 0; }
};

double squared_error(const DetailBlend& blend, const Detail& run) {
    Image picture(size, 3);
    blend.add_to(picture.data, 0, picture.size.height);
    double sum = 0;
    for (int y = 0; y < size.height; ++y)
        for (int x = 0; x < size.width; ++x)
            for (const float v : picture.pixel(x, y)) sum += std::pow(v - run.truth(x, y), 2);
    return sum;
}

/// Squared error after `runs` runs, and what the blend says of it.
std::pair<double, double> after(std::uint32_t runs, Detail run) {
    DetailBlend blend(size);
    for (std::uint32_t n = 1; n <= runs; ++n)
        for (int y = 0; y < size.height; ++y) blend.add_row(y, run.row(y), n);
    return {squared_error(blend, run), blend.squared_error()};
}

TEST(DetailBlend, leaves_pure_noise_out) {
    for (const std::uint32_t runs : {2, 4, 16, 64}) {
        const double all = double(size.pixels()) * 3 / runs;
        EXPECT_LT(after(runs, {.noise = 1}).first, 0.02 * all) << runs;
    }
}

TEST(DetailBlend, takes_nothing_before_it_knows_the_noise) {
    EXPECT_EQ(after(1, {.lost = 5, .noise = 0.1f}).second, 0);
    DetailBlend blend(size);
    Detail run{.lost = 5};
    for (int y = 0; y < size.height; ++y) blend.add_row(y, run.row(y), 1);
    Image picture(size, 3);
    blend.add_to(picture.data, 0, picture.size.height);
    EXPECT_EQ(picture, Image(size, 3));
}

TEST(DetailBlend, brings_back_what_was_lost_as_runs_add_up) {
    const double lost = after(2, {.lost = 1, .noise = 3}).first;
    const double some = after(64, {.lost = 1, .noise = 3}).first;
    const double most = after(1024, {.lost = 1, .noise = 3}).first;
    EXPECT_LT(some, 0.6 * lost);
    EXPECT_LT(most, 0.2 * some);
}

TEST(DetailBlend, is_never_much_worse_than_filtering_or_not) {
    for (const float noise : {0.1f, 1.0f, 10.0f}) {
        for (const std::uint32_t runs : {4, 32, 128}) {
            const double filtered = 3 * 17 * 17;
            const double unfiltered = 3 * double(size.pixels()) * noise * noise / runs;
            EXPECT_LT(after(runs, {.lost = 1, .noise = noise}).first,
                      1.5 * std::min(filtered, unfiltered) + 1)
                << noise << " " << runs;
        }
    }
}

TEST(DetailBlend, knows_its_error) {
    for (const std::uint32_t runs : {64, 256}) {
        const auto [error, estimate] = after(runs, {.lost = 1, .noise = 3});
        EXPECT_LT(estimate, 2 * error) << runs;
        EXPECT_GT(estimate, error / 2) << runs;
    }
}

}  // namespace
}  // namespace tessera
