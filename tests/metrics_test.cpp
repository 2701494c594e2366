// Picture metrics against pictures whose distance is known.

#include "common/metrics.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "common/check.h"

namespace tessera {
namespace {

Image flat(float value) {
    Image image({8, 4}, 3);
    for (float& v : image.data) v = value;
    return image;
}

constexpr float nan = std::numeric_limits<float>::quiet_NaN();
constexpr float inf = std::numeric_limits<float>::infinity();

TEST(Metrics, a_picture_is_identical_to_itself) {
    const Comparison c = compare(flat(0.3f), flat(0.3f));
    EXPECT_TRUE(c.identical);
    EXPECT_EQ(c.rmse, 0);
    EXPECT_EQ(c.relmse, 0);
    EXPECT_EQ(c.max_abs, 0);
}

TEST(Metrics, delta_e_is_the_distance_in_cielab) {
    // Greys differ in lightness alone, L = 116 cbrt(Y) - 16, from black 0 to white 100.
    EXPECT_NEAR(compare(flat(1), flat(0)).delta_e, 100, 0.02);
    EXPECT_NEAR(compare(flat(0.5f), flat(0.25f)).delta_e, 116 * (std::cbrt(0.5) - std::cbrt(0.25)),
                0.02);
    EXPECT_EQ(compare(flat(2), flat(7)).delta_e, 0);
    // sRGB red lies at (53.24, 80.09, 67.20).
    Image red({1, 1}, 3);
    red.data = {1, 0, 0};
    EXPECT_NEAR(compare(red, Image({1, 1}, 3)).delta_e, std::hypot(53.24, 80.09, 67.20), 0.1);
}

TEST(Metrics, constant_offset_has_closed_forms) {
    const Comparison c = compare(flat(0.75f), flat(0.5f));
    EXPECT_FALSE(c.identical);
    EXPECT_DOUBLE_EQ(c.rmse, 0.25);
    EXPECT_DOUBLE_EQ(c.rmse_clamped, 0.25);
    EXPECT_NEAR(c.relmse, 0.0625 / 0.26, 1e-12);
    EXPECT_DOUBLE_EQ(c.max_abs, 0.25);
    EXPECT_DOUBLE_EQ(c.mean_a, 0.75);
    EXPECT_DOUBLE_EQ(c.mean_b, 0.5);
}

TEST(Metrics, clamping_hides_what_a_screen_cannot_show) {
    const Comparison c = compare(flat(7), flat(3));
    EXPECT_EQ(c.rmse_clamped, 0);
    EXPECT_DOUBLE_EQ(c.rmse, 4);
    EXPECT_DOUBLE_EQ(compare(flat(-2), flat(1)).rmse_clamped, 1);
}

TEST(Metrics, one_pixel_counts_by_its_share) {
    Image a = flat(0.5f);
    a.data[17] = 1.5f;
    const Comparison c = compare(a, flat(0.5f));
    EXPECT_DOUBLE_EQ(c.rmse, std::sqrt(1.0 / double(a.data.size())));
    EXPECT_DOUBLE_EQ(c.max_abs, 1);
}

TEST(Metrics, nan_is_a_difference_and_never_hides_one) {
    Image a = flat(0.5f);
    a.data[3] = nan;
    for (const Comparison& c : {compare(a, flat(0.5f)), compare(flat(0.5f), a)}) {
        EXPECT_FALSE(c.identical);
        EXPECT_EQ(c.max_abs, inf);
        EXPECT_EQ(c.rmse, inf);
        EXPECT_GT(c.rmse_clamped, 0);
        EXPECT_TRUE(std::isfinite(c.rmse_clamped));
    }
    const Comparison same = compare(a, a);
    EXPECT_TRUE(same.identical);
    EXPECT_EQ(same.rmse, 0);
}

TEST(Metrics, infinities_differ_unless_equal) {
    EXPECT_EQ(compare(flat(inf), flat(inf)).rmse, 0);
    EXPECT_EQ(compare(flat(inf), flat(-inf)).max_abs, inf);
    EXPECT_EQ(compare(flat(inf), flat(1)).relmse, inf);
}

TEST(Metrics, negative_zero_is_not_the_same_bits) {
    const Comparison c = compare(flat(0.0f), flat(-0.0f));
    EXPECT_FALSE(c.identical);
    EXPECT_EQ(c.max_abs, 0);
}

TEST(Metrics, shapes_must_agree) {
    EXPECT_THROW(compare(flat(1), Image({4, 8}, 3)), UserError);
    EXPECT_THROW(compare(flat(1), Image({8, 4}, 1)), UserError);
}

}  // namespace
}  // namespace tessera
