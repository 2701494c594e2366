// Laws of tone mapping: the sRGB transfer inverts, curves rise from black to white, and no value
// whatever makes an impossible pixel. False colours rise in lightness, as their legends say.

#include "common/tone_map.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <limits>
#include <random>

#include "common/false_colour.h"
#include "hwy/targets.h"

namespace tessera {
namespace {

float lightness(const Rgb8& c) {
    return 0.2126f * linear_from_srgb(float(c[0]) / 255) +
           0.7152f * linear_from_srgb(float(c[1]) / 255) +
           0.0722f * linear_from_srgb(float(c[2]) / 255);
}

TEST(FalseColour, lightness_rises_with_the_value) {
    float before = 0;
    for (int i = 0; i <= 100; ++i) {
        const float now = lightness(viridis(float(i) / 100));
        EXPECT_GE(now, before - 2e-3f) << i;
        before = now;
    }
    EXPECT_EQ(viridis(-1), viridis(0));
    EXPECT_EQ(viridis(2), viridis(1));
}

TEST(FalseColour, legends_name_places_on_the_map_in_order) {
    for (const Channel c : {Channel::depth, Channel::path_length, Channel::error}) {
        float before = -1;
        for (const LegendMark& mark : legend_of(c)) {
            EXPECT_GT(mark.position, before);
            EXPECT_LE(mark.position, 1);
            before = mark.position;
        }
        EXPECT_GE(before, 0.99f);
        EXPECT_TRUE(std::isnan(map_position(c, std::numeric_limits<float>::infinity())) ||
                    c == Channel::path_length);
    }
    EXPECT_TRUE(legend_of(Channel::albedo).empty());
}

TEST(FalseColour, workers_differ_well_from_those_beside_them) {
    for (std::uint64_t number = 0; number < 100; ++number) {
        const Rgb8 a = colour_of_number(number), b = colour_of_number(number + 1);
        int difference = 0;
        for (std::size_t c = 0; c < 3; ++c) difference += std::abs(int(a[c]) - int(b[c]));
        EXPECT_GT(difference, 100) << number;
    }
}

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

TEST(ToneMap, any_exposure_makes_black_or_white_in_the_end) {
    Image image({3, 1}, 3);
    image.data = {0, 1, 1e30f, 1e-30f, 1e38f, infinity, 0, 0, 0};
    EXPECT_EQ(to_srgb8(image, {.exposure = 500}),
              (std::vector<std::uint8_t>{0, 255, 255, 255, 255, 0, 0, 0, 0}));
    for (const float exposure : {-500.0f, -infinity, std::nanf("")})
        for (const std::uint8_t byte : to_srgb8(image, {.exposure = exposure})) EXPECT_EQ(byte, 0);
}

TEST(ToneMap, bytes_are_the_curve_rounded) {
    std::mt19937 random(7);
    for (const ToneCurve curve : {ToneCurve::srgb, ToneCurve::filmic})
        for (const float exposure : {-60.0f, -3.0f, 0.0f, 5.5f, 17.3f}) {
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

/// Whatever the floats, however many, on every instruction set of this machine.
TEST(ToneMap, many_values_at_once_get_the_bytes_of_each) {
    std::mt19937 random(8);
    for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
        hwy::SetSupportedTargetsForTest(target);
        for (const ToneCurve curve : {ToneCurve::srgb, ToneCurve::filmic})
            for (const float exposure : {-500.0f, -3.0f, 0.0f, 5.5f, 500.0f}) {
                const ToneTable table({curve, exposure});
                std::vector<float> values(1000 + random() % 100);
                for (float& value : values)
                    value = random() % 2 ? std::bit_cast<float>(std::uint32_t(random()))
                                         : std::ldexp(float(random()), int(random() % 20) - 48);
                for (const float scale : {1.0f, 1.0f / 3, -1.0f}) {
                    std::vector<std::uint8_t> bytes(values.size());
                    table.put(values, scale, bytes.data());
                    for (std::size_t i = 0; i < values.size(); ++i)
                        ASSERT_EQ(bytes[i], table(values[i] * scale)) << values[i];
                }
            }
    }
    hwy::SetSupportedTargetsForTest(0);
}

TEST(ToneMap, takes_the_first_three_channels) {
    Image image({1, 1}, 5);
    image.data = {1, 0, 1, 0.5f, 0.5f};
    EXPECT_EQ(to_srgb8(image, {}), (std::vector<std::uint8_t>{255, 0, 255}));
}

}  // namespace
}  // namespace tessera
