// The discontinuity filter against a plain double loop, and what it must keep: constants, edges,
// the same bits for any cut into rectangles.

#include "common/discontinuity.h"

#include <gtest/gtest.h>

#include <bit>
#include <cmath>
#include <numeric>
#include <random>

#include "hwy/targets.h"

namespace tessera {
namespace {

/// A pass over a whole picture of random pieces of surface.
struct Pass {
    DiscontinuityFilter filter;
    std::vector<float> irradiance, normal, depth, surface;

    PassView view() const {
        return {{0, 0, filter.picture.width, filter.picture.height},
                irradiance,
                normal,
                depth,
                surface};
    }
    std::size_t at(int x, int y) const {
        return std::size_t(y) * std::size_t(filter.picture.width) + std::size_t(x);
    }
    std::vector<float> filtered() const {
        std::vector<float> out(irradiance.size());
        filter_irradiance(filter, view(), view().area, out);
        return out;
    }
};

vec3 eye_ray(const DiscontinuityFilter& f, int x, int y) {
    const vec3 forward = normalize(f.camera.at - f.camera.eye);
    const vec3 right = normalize(cross(forward, f.camera.up));
    const vec3 up = cross(right, forward);
    const float half = std::tan(glm::radians(f.camera.fov_y) / 2);
    const float aspect = float(f.picture.width) / float(f.picture.height);
    const float u = (2 * (float(x) + 0.5f) / float(f.picture.width) - 1) * half * aspect;
    const float v = (1 - 2 * (float(y) + 0.5f) / float(f.picture.height)) * half;
    return normalize(forward + u * right + v * up);
}

/// The plane z = 0 seen from an angle, with irradiance 1.
Pass floor_pass(ImageSize size, int window) {
    Pass pass;
    pass.filter.picture = size;
    pass.filter.camera.eye = {1, -4, 5};
    pass.filter.camera.up = {0, 0, 1};
    pass.filter.window = window;
    pass.irradiance.assign(3 * size.pixels(), 1);
    pass.surface.assign(size.pixels(), std::bit_cast<float>(7u));
    for (int y = 0; y < size.height; ++y)
        for (int x = 0; x < size.width; ++x) {
            pass.normal.insert(pass.normal.end(), {0, 0, 1});
            pass.depth.push_back(-pass.filter.camera.eye.z / eye_ray(pass.filter, x, y).z);
        }
    return pass;
}

Pass random_pass(ImageSize size, int window, unsigned seed) {
    Pass pass = floor_pass(size, window);
    std::mt19937 random(seed);
    std::uniform_real_distribution<float> uniform;
    for (float& e : pass.irradiance) e = uniform(random);
    for (std::size_t i = 0; i < size.pixels(); ++i) {
        if (uniform(random) < 0.2f)
            pass.surface[i] = std::bit_cast<float>(std::uint32_t(random() % 2));
        if (uniform(random) < 0.2f) pass.depth[i] *= 1 + 0.05f * uniform(random);
        if (uniform(random) < 0.1f) pass.depth[i] = infinity;
        if (uniform(random) < 0.05f) pass.irradiance[3 * i + random() % 3] = std::nanf("");
        if (uniform(random) < 0.05f) pass.irradiance[3 * i + random() % 3] = infinity;
        if (uniform(random) < 0.05f) pass.normal[3 * i] = std::nanf("");
        if (uniform(random) < 0.2f) {
            const float angle = uniform(random);
            pass.normal[3 * i + 1] = std::sin(angle);
            pass.normal[3 * i + 2] = std::cos(angle);
        }
    }
    return pass;
}

/// A smooth ball, one of facets, a floor with a step, wires, a mirror's image, and nothing.
Pass things_pass(ImageSize size, int window) {
    Pass pass = floor_pass(size, window);
    std::mt19937 random(unsigned(window) + 20);
    for (float& e : pass.irradiance) e = float(random() % 1000) / 999;
    const auto put = [&](std::size_t p, std::uint32_t surface, const vec3& n, float depth) {
        pass.surface[p] = std::bit_cast<float>(surface);
        for (int k = 0; k < 3; ++k) pass.normal[3 * p + std::size_t(k)] = n[k];
        pass.depth[p] = depth;
    };
    const vec3 eye = pass.filter.camera.eye, centre{0, 0, 0.5f};
    for (int y = 0; y < size.height; ++y)
        for (int x = 0; x < size.width; ++x) {
            const std::size_t p = pass.at(x, y);
            const vec3 ray = eye_ray(pass.filter, x, y);
            if ((eye + ray * pass.depth[p]).x > 1) pass.depth[p] *= 1 - 0.1f / eye.z;
            const float b = dot(eye - centre, ray);
            const float inside = b * b - dot(eye - centre, eye - centre) + 1;
            if (inside > 0) {
                const float depth = -b - std::sqrt(inside);
                const vec3 n = eye + ray * depth - centre;
                const vec3 facet = normalize(glm::round(5.0f * n));
                put(p, 8, x < size.width / 2 ? n : facet, depth);
            }
            if (x % 29 == 3) put(p, 9, {0, -1, 0}, 0.5f * pass.depth[p]);
            if (y > size.height * 3 / 4 && x < size.width / 4)
                put(p, 10, normalize(vec3(0, 0.3f, 1)), pass.depth[p] * 1.5f);
            if (y < size.height / 8) put(p, 0, vec3(0), infinity);
        }
    return pass;
}

vec3 vec(const std::vector<float>& v, std::size_t i) {
    return {v[3 * i], v[3 * i + 1], v[3 * i + 2]};
}

/// The definition of the filter, one pixel at a time.
vec3 reference(const Pass& pass, int x, int y) {
    const DiscontinuityFilter& f = pass.filter;
    const int reach = f.window / 2;
    const float pixel = 2 * std::tan(glm::radians(f.camera.fov_y) / 2) / float(f.picture.height);
    const std::size_t p = pass.at(x, y);
    vec3 sum(0);
    int count = 0;
    for (int dy = -reach; dy <= reach; ++dy)
        for (int dx = -reach; dx <= reach; ++dx) {
            const int qx = x + dx, qy = y + dy;
            if (qx < 0 || qy < 0 || qx >= f.picture.width || qy >= f.picture.height) continue;
            const std::size_t q = pass.at(qx, qy);
            if (!is_finite(vec(pass.irradiance, q))) continue;
            const vec3 n = vec(pass.normal, p);
            const vec3 hit_p = eye_ray(f, x, y) * pass.depth[p];
            const vec3 hit_q = eye_ray(f, qx, qy) * pass.depth[q];
            const vec3 forward = normalize(f.camera.at - f.camera.eye);
            const float z = dot(forward, eye_ray(f, x, y)) * pass.depth[p];
            const float beyond = dot(forward, eye_ray(f, qx, qy)) * pass.depth[q] - z;
            const bool flat = std::abs(dot(n, hit_q - hit_p)) <= f.plane_pixels * pixel * z ||
                              std::abs(beyond) <= float(std::abs(dx) + std::abs(dy)) * pixel * z;
            const bool same = std::bit_cast<std::uint32_t>(pass.surface[p]) ==
                                  std::bit_cast<std::uint32_t>(pass.surface[q]) &&
                              dot(n, vec(pass.normal, q)) >= f.normal_cosine && flat;
            if (q != p && !same) continue;
            sum += vec(pass.irradiance, q);
            ++count;
        }
    return sum / float(std::max(count, 1));
}

TEST(Discontinuity, equals_the_plain_double_loop) {
    for (int window : {3, 5, 9})
        for (unsigned seed = 0; seed < 5; ++seed) {
            const Pass pass = random_pass({61, 37}, window, seed);
            const std::vector<float> filtered = pass.filtered();
            for (int y = 0; y < 37; ++y)
                for (int x = 0; x < 61; ++x) {
                    const vec3 expected = reference(pass, x, y);
                    const vec3 got = vec(filtered, pass.at(x, y));
                    ASSERT_LT(max_component(glm::abs(expected - got)), 1e-5f)
                        << window << " at " << x << "," << y;
                }
        }
}

TEST(Discontinuity, constant_irradiance_stays_to_the_border) {
    for (int window : {1, 3, 4, 5, 7}) {
        const Pass pass = floor_pass({40, 30}, window);
        for (float e : pass.filtered()) ASSERT_FLOAT_EQ(e, 1);
    }
}

TEST(Discontinuity, no_window_or_an_even_one_leaves_the_pass_alone) {
    for (int window : {0, 1, 2, 4}) {
        Pass pass = floor_pass({32, 8}, window);
        std::iota(pass.irradiance.begin(), pass.irradiance.end(), 1.0f);
        EXPECT_EQ(pass.filtered(), pass.irradiance);
    }
}

TEST(Discontinuity, inside_a_surface_every_interleaved_set_counts_once) {
    const int window = 5;
    Pass pass = floor_pass({40, 30}, window);
    for (int y = 0; y < 30; ++y)
        for (int x = 0; x < 40; ++x)
            for (int c = 0; c < 3; ++c)
                pass.irradiance[3 * pass.at(x, y) + std::size_t(c)] =
                    float(1 << (x % window)) + float(100 * (y % window));
    const std::vector<float> filtered = pass.filtered();
    for (int y = 2; y < 28; ++y)
        for (int x = 2; x < 38; ++x)
            ASSERT_NEAR(filtered[3 * pass.at(x, y)], 31 / 5.0f + 200, 1e-3f);
}

TEST(Discontinuity, edges_of_every_kind_are_kept) {
    const auto left = [](int x) { return x < 20; };
    for (int kind = 0; kind < 3; ++kind) {
        Pass pass = floor_pass({40, 30}, 3);
        for (int y = 0; y < 30; ++y)
            for (int x = 0; x < 40; ++x) {
                const std::size_t p = pass.at(x, y);
                if (!left(x)) continue;
                for (int c = 0; c < 3; ++c) pass.irradiance[3 * p + std::size_t(c)] = 5;
                if (kind == 0) pass.surface[p] = std::bit_cast<float>(8u);
                if (kind == 1) pass.normal[3 * p] = 1, pass.normal[3 * p + 2] = 0;
                if (kind == 2) pass.depth[p] *= 0.5f;
            }
        EXPECT_EQ(pass.filtered(), pass.irradiance) << kind;
    }
}

TEST(Discontinuity, any_cut_into_rectangles_gives_the_same_bits) {
    const Pass pass = random_pass({75, 50}, 5, 3);
    const std::vector<float> whole = pass.filtered();
    std::vector<float> pieces(whole.size());
    for (int y = 0; y < 50; y += 7)
        for (int x = 0; x < 75; x += 16)
            filter_irradiance(pass.filter, pass.view(),
                              {x, y, std::min(x + 16, 75), std::min(y + 7, 50)}, pieces);
    EXPECT_EQ(whole, pieces);
}

/// Expects the same bits of every instruction set and of strips of these widths, and the plain
/// loop's result within rounding.
void expect_same_everywhere(const Pass& pass, const std::vector<int>& widths) {
    const ImageSize size = pass.filter.picture;
    const std::vector<float> whole = pass.filtered();
    for (int y = 0; y < size.height; ++y)
        for (int x = 0; x < size.width; ++x)
            ASSERT_LT(max_component(glm::abs(reference(pass, x, y) - vec(whole, pass.at(x, y)))),
                      1e-5f)
                << x << "," << y;
    for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
        hwy::SetSupportedTargetsForTest(target);
        for (const int width : widths) {
            std::vector<float> pieces(whole.size());
            for (int x = 0; x < size.width; x += width)
                filter_irradiance(pass.filter, pass.view(),
                                  {x, 0, std::min(x + width, size.width), size.height}, pieces);
            ASSERT_EQ(whole, pieces) << width;
        }
    }
    hwy::SetSupportedTargetsForTest(0);
}

/// Rows of one plane are added in advance, wherever the blocks that they reach begin.
TEST(Discontinuity, surfaces_with_few_flaws_get_the_same_bits_on_every_instruction_set) {
    for (const int window : {3, 5, 9}) {
        Pass pass = floor_pass({90, 40}, window);
        std::mt19937 random(unsigned(window) + 10);
        for (float& e : pass.irradiance) e = float(random() % 1000) / 999;
        for (int flaw = 0; flaw < 40; ++flaw) {
            const std::size_t p = random() % pass.depth.size();
            if (flaw % 4 == 0) pass.surface[p] = std::bit_cast<float>(8u);
            if (flaw % 4 == 1) pass.normal[3 * p + 1] = 0.1f;
            if (flaw % 4 == 2) pass.depth[p] *= 1.03f;
            if (flaw % 4 == 3) pass.irradiance[3 * p] = infinity;
        }
        for (int x = 60; x < 90; ++x) pass.surface[pass.at(x, 20)] = std::bit_cast<float>(9u);
        expect_same_everywhere(pass, {1, 7, 16, 33, 90});
    }
}

TEST(Discontinuity, curves_creases_steps_wires_and_mirrors_equal_the_plain_double_loop) {
    expect_same_everywhere(things_pass({75, 24}, 9), {7, 33});
    expect_same_everywhere(things_pass({60, 12}, 33), {25});  // the widest that is grouped
}

TEST(Discontinuity, a_pixel_of_no_depth_keeps_its_own) {
    Pass pass = floor_pass({32, 16}, 5);
    pass.depth[pass.at(9, 8)] = std::nanf("");
    pass.irradiance[3 * pass.at(9, 8)] = 4;
    const std::vector<float> filtered = pass.filtered();
    EXPECT_EQ(vec(filtered, pass.at(9, 8)), vec3(4, 1, 1));
    EXPECT_EQ(vec(filtered, pass.at(10, 8)), vec3(1));
}

TEST(Discontinuity, a_tile_with_its_border_is_filtered_as_in_the_whole_picture) {
    const Pass pass = random_pass({75, 50}, 5, 4);
    const std::vector<float> whole = pass.filtered();
    const auto cut = [&](const std::vector<float>& from, const Rect& r, std::size_t components) {
        std::vector<float> out;
        for (int y = r.y0; y < r.y1; ++y)
            out.insert(out.end(), from.begin() + std::ptrdiff_t(components * pass.at(r.x0, y)),
                       from.begin() + std::ptrdiff_t(components *
                                                     (pass.at(r.x0, y) + std::size_t(r.width()))));
        return out;
    };
    for (std::uint32_t tile = 0; tile < tile_count(pass.filter.picture); ++tile) {
        const Rect rect = tile_rect(pass.filter.picture, tile);
        const Rect area{std::max(rect.x0 - 2, 0), std::max(rect.y0 - 2, 0),
                        std::min(rect.x1 + 2, 75), std::min(rect.y1 + 2, 50)};
        const std::vector<float> irradiance = cut(pass.irradiance, area, 3);
        const std::vector<float> normal = cut(pass.normal, area, 3);
        const std::vector<float> depth = cut(pass.depth, area, 1);
        const std::vector<float> surface = cut(pass.surface, area, 1);
        std::vector<float> out(irradiance.size());
        filter_irradiance(pass.filter, {area, irradiance, normal, depth, surface}, rect, out);
        for (int y = rect.y0; y < rect.y1; ++y)
            for (int x = rect.x0; x < rect.x1; ++x) {
                const std::size_t in_area = std::size_t((y - area.y0) * area.width() + x - area.x0);
                ASSERT_EQ(vec(out, in_area), vec(whole, pass.at(x, y))) << x << "," << y;
            }
    }
}

TEST(Discontinuity, nothing_that_is_not_finite_comes_out) {
    Pass pass = random_pass({64, 64}, 3, 5);
    std::fill_n(pass.irradiance.begin(), 3 * 64 * 20, std::nanf(""));
    for (float e : pass.filtered()) ASSERT_TRUE(std::isfinite(e));
}

}  // namespace
}  // namespace tessera
