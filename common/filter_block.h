// The inner loop of the discontinuity filter (common/discontinuity.h), compiled by Google Highway
// for each instruction set: the sums of a block of pixels stay in registers while the window is
// added.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "common/math.h"

namespace tessera {

inline constexpr std::size_t block_pixels = 16;

/// What pixels side by side have in common.
struct Survey {
    bool any_valid = false;
    bool all_valid = false;
    bool uniform = false;       ///< the same surface and normal everywhere, and finite planes
    std::uint32_t surface = 0;  ///< bits; these where uniform
    vec3 normal{0};
    float least_depth = 0;
    float least_plane = 0, most_plane = 0;
};

/// What is known of the pixels of a row.
class GuideRow {
public:
    enum Guide {
        red,  // irradiance
        green,
        blue,
        nx,  // normal
        ny,
        nz,
        px,  // hit relative to the eye, as if seen directly
        py,
        pz,
        depth,
        plane,    // dot(normal, hit)
        surface,  // bits of a number
        valid,    // bits, all ones where irradiance is finite
        red_row,  // sums over the window's width from this pixel on, of uniform reaches
        green_row,
        blue_row,
        guide_count
    };

    /// Holds `blocks` of pixels with `reach` on each side, and what prepare_row() may write behind.
    GuideRow(std::size_t blocks, std::size_t reach)
        : reaches(blocks),
          width_((blocks + 1) * block_pixels + 2 * reach),
          values_(guide_count * width_) {}

    float* operator[](Guide guide) { return &values_[guide * width_]; }
    const float* operator[](Guide guide) const { return &values_[guide * width_]; }
    /// Of no pixel is anything known.
    void forget() {
        std::fill_n((*this)[valid], width_, 0.0f);
        std::ranges::fill(reaches, Survey{});
    }

    std::vector<Survey> reaches;  ///< by block: its pixels and the reach on both sides

private:
    std::size_t width_;
    std::vector<float> values_;
};

/// The rows around a row of pixels. Pixel x of the picture's part is at x + reach.
struct FilterWindow {
    std::vector<const GuideRow*> rows;  ///< 2 reach + 1, from the top
    std::size_t reach = 0;              ///< pixels to each side
    float cosine = 0;                   ///< least between normals
    float plane_tolerance = 0;          ///< most distance from the plane at depth 1
    float pixel_angle = 0;              ///< what a pixel's distance may change in depth at depth 1
};

/// Pixels of a pass side by side, by channel; the first is the picture's number `x` of its row.
/// From the eye to pixel x it is the way corner + x * across.
struct PassRow {
    const float* irradiance;
    const float* normal;
    const float* depth;
    const float* surface;
    std::size_t count;
    int x;
    vec3 corner, across;
};

/// Fills `out` from `at` with the pixels, for windows of that reach.
void prepare_row(const PassRow& pixels, std::size_t at, std::size_t reach, GuideRow& out);

/// Sets `out` to the filtered irradiance of a block of pixels.
/// In one plane is what keeps within plane_tolerance of it, or differs in depth by no more than the
/// pixels are apart: behind a mirror the normal belongs to the true surface and the hit to its
/// image, so that the plane says nothing there. Comparisons with what is not a number fail, so such
/// pixels stay alone. Each row of the window is added from the left, then the rows from the top:
/// where a row and the block lie in one plane for certain, its sums are there already.
void filter_block(const FilterWindow& window, std::size_t block, float (&out)[3 * block_pixels]);

}  // namespace tessera
