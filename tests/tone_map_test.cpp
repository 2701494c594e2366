// Laws of tone mapping: the sRGB transfer inverts, curves rise from black to white, and no value
// whatever makes an impossible pixel.

#include "common/tone_map.h"

#include <gtest/gtest.h>

#include <cmath>
#include <random>

namespace tessera {
namespace {

TEST(ToneMap, srgb_transfer_inverts_for_every_byte) {
    for (int i = 0; i <= 255; ++i) {
        const float linear = linear_from_srgb(float(i) / 255);
        EXPECT_EQ(int(255 * srgb_from_linear(linear) + 0.5f), i);
    }
}

TEST(ToneMap, curves_rise_from_black_to_white) {
    for (const ToneCurve curve : {ToneCurve::srgb, ToneCurve::filmic}) {
        const ToneMap map{.curve = curve};
        float last = apply_curve(map, 0);
        EXPECT_NEAR(last, 0, 1e-6f);
        for (float radiance = 0.01f; radiance < 20; radiance *= 1.1f) {
            const float value = apply_curve(map, radiance);
            EXPECT_GE(value, last);
            EXPECT_LE(value, 1);
            last = value;
        }
        EXPECT_EQ(apply_curve(map, 1000), 1);
    }
}

TEST(ToneMap, one_stop_doubles) {
    EXPECT_FLOAT_EQ(apply_curve({.exposure = 1}, 0.2f), apply_curve({}, 0.4f));
    EXPECT_FLOAT_EQ(apply_curve({.exposure = -2}, 0.8f), apply_curve({}, 0.2f));
}

TEST(ToneMap, what_is_no_radiance_is_black) {
    Image image({4, 1}, 3);
    const float bad[] = {std::nanf(""), -infinity, infinity, -1};
    for (int x = 0; x < 4; ++x) image.pixel(x, 0)[0] = bad[x];
    for (const std::uint8_t byte : to_srgb8(image, {})) EXPECT_EQ(byte, 0);
}

TEST(ToneMap, bytes_are_the_curve_rounded) {
    std::mt19937 random(7);
    for (const ToneCurve curve : {ToneCurve::srgb, ToneCurve::filmic})
        for (const float exposure : {-3.0f, 0.0f, 5.5f}) {
            const ToneMap map{curve, exposure};
            Image image({100000, 1}, 3);
            std::uniform_real_distribution<float> exponent(-30, 10);
            for (float& value : image.data) value = std::exp2(exponent(random));
            const std::vector<std::uint8_t> bytes = to_srgb8(image, map);
            for (std::size_t i = 0; i < bytes.size(); ++i) {
                const float exact = 255 * srgb_from_linear(apply_curve(map, image.data[i]));
                // The curve is not quite monotonic in its last bits.
                ASSERT_NEAR(bytes[i], exact, 0.5005f) << image.data[i];
            }
        }
}

TEST(ToneMap, takes_the_first_three_channels) {
    Image image({1, 1}, 5);
    image.data = {1, 0, 1, 0.5f, 0.5f};
    EXPECT_EQ(to_srgb8(image, {}), (std::vector<std::uint8_t>{255, 0, 255}));
}

}  // namespace
}  // namespace tessera
