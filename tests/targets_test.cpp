#include "worker/targets.h"

#include <gtest/gtest.h>

#include <random>
#include <vector>

namespace tessera {
namespace {

TEST(Targets, HoldThePointsBothWaysAndTellWhichAreFinite) {
    std::mt19937 random(1);
    std::uniform_real_distribution<float> uniform(-10, 10);
    for (const std::size_t count : {0, 1, 15, 16, 17, 200, 256}) {
        std::vector<vec3> points;
        for (std::size_t i = 0; i < count; ++i) {
            points.emplace_back(uniform(random), uniform(random), uniform(random));
            if (random() % 4 == 0) points.back()[int(random() % 3)] = infinity;
        }
        const Targets targets(points);
        for (std::size_t i = 0; i < Targets::max_count; ++i) {
            const bool usable = i < count && is_finite(points[i]);
            ASSERT_EQ(has(targets.finite, i), usable);
            for (int k = 0; k < 3; ++k) {
                if (usable) {
                    ASSERT_EQ(targets.p[k][i], points[i][k]);
                }
                ASSERT_EQ(targets.by_place[k][i % 16][i / 16], targets.p[k][i]);
            }
        }
    }
}

TEST(Targets, RepeatAPointOfTheGroupWhereThereIsNone) {
    std::vector<vec3> points(20, vec3(1, 2, 3));
    points[3] = vec3(infinity);
    const Targets targets(points);
    EXPECT_EQ(targets.point(3), vec3(1, 2, 3));
    EXPECT_EQ(targets.point(31), vec3(1, 2, 3));
    EXPECT_EQ(targets.point(32), vec3(0));
}

}  // namespace
}  // namespace tessera
