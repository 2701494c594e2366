// The inner loops of the discontinuity filter (common/discontinuity.h), compiled by Google Highway
// for each instruction set.
//
// Most of a picture is planes: of the 24 pixels that a row of a window of 9 reaches from a block of
// 16, nearly all have one of one to three normals, bit for bit. So each row is cut into *groups*
// once, the pixels of a block's reach with one surface and normal, and each group is added up over
// the window's width, once for all the rows of pixels whose windows hold it. A block of pixels then
// asks, for each of its own groups and each row of the window, whether all of the row's group with
// the same normal lies in the same plane, and that none of the others can count: if so, the row
// is one addition. Blocks whose windows are one group (*flat*) are found many at a time, and only
// added. What is curved or unclear is asked pixel by pixel (a *tap*).
//
// All ways give the same bits: each row of the window is added from the left, with zeros for
// pixels that do not count, then the rows from the top.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "common/math.h"

namespace tessera {

inline constexpr std::size_t block_pixels = 16;

/// A block of one guide: a cache line.
struct alignas(64) BlockLine {
    std::array<float, block_pixels> values;
};

/// What the pixels of one plane have in common: bits of floats.
struct SurfaceKind {
    std::uint32_t surface, nx, ny, nz;

    bool same_normal(const SurfaceKind& o) const {
        return ((nx ^ o.nx) | (ny ^ o.ny) | (nz ^ o.nz)) == 0;
    }
    bool operator==(const SurfaceKind& o) const { return surface == o.surface && same_normal(o); }
};

/// Pixels of a block's reach with one surface and one normal. The reach is the block and the
/// pixels on both sides that the windows of its pixels hold.
struct PixelGroup {
    SurfaceKind kind;
    std::uint64_t pixels;  ///< a bit for each, from the leftmost of the reach
    float least_plane, most_plane;
    float least_depth;
    /// By pixel of the block, over its window's width: red, green and blue, and how many pixels.
    std::array<BlockLine, 4> sums;
};

/// The groups of a block's reach. Pixels in none are alone: nothing was hit there.
struct Reach {
    std::uint32_t first = 0, count = 0;  ///< in GuideRow::groups
    bool by_taps = false;                ///< too many groups, or no planes
};

/// More groups in a reach than this take longer than their taps.
inline constexpr std::size_t most_groups = 4;

/// What is known of the pixels of a row.
struct GuideRow {
    enum Guide {
        red,  // irradiance, zero where it is not finite
        green,
        blue,
        nx,  // normal
        ny,
        nz,
        depth,    // along the direction of view, as if seen directly
        seen,     // the same, but not a number where irradiance is not finite
        plane,    // dot(normal, hit relative to the eye)
        surface,  // bits of a number
        guide_count
    };

    /// Of reaches that are one group of pixels that are all valid; else not a number.
    enum Flat {
        flat_surface,  // bits
        flat_nx,
        flat_ny,
        flat_nz,
        least_plane,
        most_plane,
        least_depth,
        flat_count
    };

    /// Holds `blocks` of pixels with `reach` on each side. The pixels at the right that the last
    /// block may have too many are there, and not seen.
    GuideRow(std::size_t blocks, std::size_t reach);

    float* operator[](Flat flat) { return flats[flat * (flats.size() / flat_count)].values.data(); }
    const float* operator[](Flat flat) const {
        return flats[flat * (flats.size() / flat_count)].values.data();
    }
    float* operator[](Guide guide) { return values[guide * lines].values.data(); }
    const float* operator[](Guide guide) const { return values[guide * lines].values.data(); }
    /// Of no pixel is anything known.
    void forget();

    std::size_t margin;  ///< pixels before the first block: whole lines
    std::size_t lines;   ///< of each guide
    std::vector<BlockLine> values;
    // By line, a bit for each pixel:
    std::vector<std::uint16_t> ends;   ///< the next pixel has another surface or normal
    std::vector<std::uint16_t> valid;  ///< irradiance is finite
    // By block:
    std::vector<Reach> reaches;
    std::vector<PixelGroup> groups;  ///< most_groups for each, which are not all used
    std::size_t group_count = 0;
    std::vector<BlockLine> flats;
};

/// The rows around a row of pixels.
struct FilterWindow {
    std::vector<const GuideRow*> rows;  ///< 2 reach + 1, from the top
    std::size_t reach = 0;              ///< pixels to each side
    float cosine = 0;                   ///< least between normals
    float plane_tolerance = 0;          ///< most distance from the plane at depth 1
    float pixel_angle = 0;              ///< what a pixel's distance may change in depth at depth 1
    vec3 across{0}, down{0};            ///< from a pixel to the next at depth 1
};

/// Pixels of a pass side by side, by channel; the first is the picture's number `x` of its row.
/// From the eye to pixel x it is the way corner + x * across, as far as depth 1.
struct PassRow {
    const float* irradiance;
    const float* normal;
    const float* depth;  ///< along the way
    const float* surface;
    std::size_t count;
    int x;
    vec3 corner, across;
};

/// Fills `out` from `at` with the pixels, for windows of that reach and least cosine.
void prepare_row(const PassRow& pixels, std::size_t at, std::size_t reach, float cosine,
                 GuideRow& out);

/// Sets `out` to the filtered irradiance of the first `count` pixels of the window's middle row.
/// In one plane is what keeps within plane_tolerance of it, or differs in depth by no more than the
/// pixels are apart: behind a mirror the normal belongs to the true surface and the hit to its
/// image, so that the plane says nothing there. Comparisons with what is not a number fail, so such
/// pixels stay alone.
void filter_row(const FilterWindow& window, std::size_t count, float* out);

}  // namespace tessera
