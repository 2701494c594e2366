#include "common/filter_block.h"

#include <bit>

#define HWY_DISABLED_TARGETS (HWY_SSSE3 | HWY_AVX3_DL)
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "common/filter_block.cpp"
#include "hwy/foreach_target.h"
// foreach_target.h comes first.
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

namespace hn = hwy::HWY_NAMESPACE;
using enum GuideRow::Guide;

constexpr hn::CappedTag<float, block_pixels> tag;
using Float = hn::Vec<decltype(tag)>;
using Mask = hn::Mask<decltype(tag)>;

HWY_INLINE Float load(const GuideRow& row, int guide, std::size_t at) {
    return hn::LoadU(tag, row[GuideRow::Guide(guide)] + at);
}

/// A pixel in each lane, and what is the same for all its taps.
struct Pixels {
    Float n[3], plane, plane_tolerance, depth, surface;
};

/// Where the pixel of row `q` shows the same surface and lies so near that its distance along the
/// rows and columns is `apart`.
HWY_INLINE Mask same_surface(const Pixels& p, const GuideRow& q, std::size_t at, float cosine,
                             float apart) {
    const Float qn[3] = {load(q, nx, at), load(q, ny, at), load(q, nz, at)};
    const Float alike = p.n[0] * qn[0] + p.n[1] * qn[1] + p.n[2] * qn[2];
    const Float height =
        p.n[0] * load(q, px, at) + p.n[1] * load(q, py, at) + p.n[2] * load(q, pz, at) - p.plane;
    const Float farther = load(q, depth, at) - p.depth;
    const Mask near = hn::Or(hn::Abs(height) <= p.plane_tolerance,
                             hn::Abs(farther) <= hn::Set(tag, apart) * p.depth);
    constexpr hn::RebindToUnsigned<decltype(tag)> bits;
    const Mask same = hn::RebindMask(
        tag, hn::BitCast(bits, p.surface) == hn::BitCast(bits, load(q, surface, at)));
    return hn::And(hn::And(same, near), alike >= hn::Set(tag, cosine));
}

/// Narrower windows are added sooner than their rows are surveyed.
constexpr std::size_t least_reach_surveyed = 2;

/// What `count` pixels, at least a block, have in common.
Survey survey(const GuideRow& row, std::size_t from, std::size_t count) {
    Survey out{.surface = std::bit_cast<std::uint32_t>(row[surface][from]),
               .normal = {row[nx][from], row[ny][from], row[nz][from]}};
    constexpr hn::RebindToUnsigned<decltype(tag)> bits;
    const auto surfaces = hn::Set(bits, out.surface);
    Mask alike = hn::FirstN(tag, hn::Lanes(tag)), all = alike, any = hn::Not(alike);
    Float least_depth = load(row, depth, from), least = load(row, plane, from), most = least;
    for (std::size_t i = 0; i < count; i += hn::Lanes(tag)) {
        const std::size_t at = from + std::min(i, count - hn::Lanes(tag));
        const Mask is_valid = hn::MaskFromVec(load(row, valid, at));
        all = hn::And(all, is_valid);
        any = hn::Or(any, is_valid);
        alike = hn::And(alike,
                        hn::RebindMask(tag, hn::BitCast(bits, load(row, surface, at)) == surfaces));
        for (int k = 0; k < 3; ++k)
            alike = hn::And(alike, load(row, nx + k, at) == hn::Set(tag, out.normal[k]));
        const Float planes = load(row, plane, at);
        alike = hn::And(alike, planes * hn::Zero(tag) == hn::Zero(tag));
        least = hn::Min(least, planes);
        most = hn::Max(most, planes);
        least_depth = hn::Min(least_depth, load(row, depth, at));
    }
    out.any_valid = !hn::AllFalse(tag, any);
    out.all_valid = hn::AllTrue(tag, all);
    out.uniform = hn::AllTrue(tag, alike);
    if (!out.uniform) return out;
    out.least_depth = hn::GetLane(hn::MinOfLanes(tag, least_depth));
    out.least_plane = hn::GetLane(hn::MinOfLanes(tag, least));
    out.most_plane = hn::GetLane(hn::MaxOfLanes(tag, most));
    return out;
}

/// Whether every pixel of `reach` counts for every one of `block`. What same_surface() computes of
/// equal normals is a difference of planes, and no such difference is more than the greatest.
bool all_count(const FilterWindow& window, const Survey& block, const Survey& reach) {
    const vec3& n = block.normal;
    return reach.all_valid && block.uniform && reach.uniform && block.surface == reach.surface &&
           n == reach.normal && n.x * n.x + n.y * n.y + n.z * n.z >= window.cosine &&
           std::max(reach.most_plane - block.least_plane, block.most_plane - reach.least_plane) <=
               window.plane_tolerance * block.least_depth;
}

/// Whether none does.
bool none_counts(const Survey& block, const Survey& reach) {
    return !reach.any_valid || (block.uniform && reach.uniform && block.surface != reach.surface);
}

void filter_lanes(const FilterWindow& window, const Survey& block, std::size_t number,
                  std::size_t x, float* out) {
    const std::size_t reach = window.reach, here = x + reach;
    const GuideRow& own = *window.rows[reach];
    Pixels p{{load(own, nx, here), load(own, ny, here), load(own, nz, here)},
             load(own, plane, here),
             hn::Zero(tag),
             load(own, depth, here),
             load(own, surface, here)};
    p.plane_tolerance = hn::Set(tag, window.plane_tolerance) * p.depth;
    const auto apart = [&](std::size_t i) { return float(i > reach ? i - reach : reach - i); };

    Float sums[3] = {hn::Zero(tag), hn::Zero(tag), hn::Zero(tag)}, count = hn::Zero(tag);
    for (std::size_t row = 0; row <= 2 * reach; ++row) {
        const GuideRow& q = *window.rows[row];
        if (none_counts(block, q.reaches[number])) continue;
        if (all_count(window, block, q.reaches[number])) {
            for (int k = 0; k < 3; ++k) sums[k] = sums[k] + load(q, red_row + k, x);
            count = count + hn::Set(tag, float(2 * reach + 1));
            continue;
        }
        Float row_sums[3] = {hn::Zero(tag), hn::Zero(tag), hn::Zero(tag)};
        for (std::size_t column = 0; column <= 2 * reach; ++column) {
            const std::size_t at = x + column;
            Mask accepted = hn::MaskFromVec(load(q, valid, at));
            if (row != reach || column != reach)
                accepted = hn::And(accepted,
                                   same_surface(p, q, at, window.cosine,
                                                (apart(row) + apart(column)) * window.pixel_angle));
            for (int k = 0; k < 3; ++k)
                row_sums[k] = row_sums[k] + hn::IfThenElseZero(accepted, load(q, red + k, at));
            count = count + hn::IfThenElseZero(accepted, hn::Set(tag, 1.0f));
        }
        for (int k = 0; k < 3; ++k) sums[k] = sums[k] + row_sums[k];
    }
    const Float one = hn::Set(tag, 1.0f);
    const Float scale = one / hn::Max(count, one);
    hn::StoreInterleaved3(sums[0] * scale, sums[1] * scale, sums[2] * scale, tag, out);
}

void filter_all_lanes(const FilterWindow& window, std::size_t number,
                      float (&out)[3 * block_pixels]) {
    const std::size_t x = number * block_pixels;
    const GuideRow& own = *window.rows[window.reach];
    Survey block = own.reaches[number];
    if (!block.uniform && window.reach >= least_reach_surveyed)
        block = survey(own, x + window.reach, block_pixels);
    for (std::size_t i = 0; i < block_pixels; i += hn::Lanes(tag))
        filter_lanes(window, block, number, x + i, out + 3 * i);
}

void prepare_lanes(const PassRow& pixels, std::size_t first, std::size_t at, GuideRow& out) {
    const auto put = [&](int guide, Float value) {
        hn::StoreU(value, tag, out[GuideRow::Guide(guide)] + at);
    };
    Float e[3], n[3];
    hn::LoadInterleaved3(tag, pixels.irradiance + 3 * first, e[0], e[1], e[2]);
    hn::LoadInterleaved3(tag, pixels.normal + 3 * first, n[0], n[1], n[2]);
    const Float d = hn::LoadU(tag, pixels.depth + first);
    // Zero times anything finite is zero, zero times infinity is not a number.
    const Mask is_finite = (e[0] + e[1] + e[2]) * hn::Zero(tag) == hn::Zero(tag);

    const Float x = hn::Iota(tag, float(pixels.x + int(first)));
    Float way[3];
    for (int k = 0; k < 3; ++k)
        way[k] = hn::Set(tag, pixels.corner[k]) + x * hn::Set(tag, pixels.across[k]);
    const Float scale = d / hn::Sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    for (int k = 0; k < 3; ++k) {
        put(red + k, hn::IfThenElseZero(is_finite, e[k]));
        put(nx + k, n[k]);
        put(px + k, way[k] * scale);
    }
    put(depth, d);
    put(plane, n[0] * (way[0] * scale) + n[1] * (way[1] * scale) + n[2] * (way[2] * scale));
    put(surface, hn::LoadU(tag, pixels.surface + first));
    put(valid, hn::VecFromMask(tag, is_finite));
}

/// The same where fewer pixels are left than there are lanes.
void prepare_last(const PassRow& pixels, std::size_t first, std::size_t at, GuideRow& out) {
    float irradiance[3 * block_pixels] = {}, normal[3 * block_pixels] = {};
    float depths[block_pixels] = {}, surfaces[block_pixels] = {};
    const std::size_t left = pixels.count - first;
    std::copy_n(pixels.irradiance + 3 * first, 3 * left, irradiance);
    std::copy_n(pixels.normal + 3 * first, 3 * left, normal);
    std::copy_n(pixels.depth + first, left, depths);
    std::copy_n(pixels.surface + first, left, surfaces);
    prepare_lanes({irradiance, normal, depths, surfaces, left, pixels.x + int(first), pixels.corner,
                   pixels.across},
                  0, at, out);
    std::fill_n(out[valid] + at + left, hn::Lanes(tag) - left, 0.0f);
}

/// The sums over a window's width from each pixel of a block.
void add_rows(GuideRow& row, std::size_t x, std::size_t reach) {
    for (std::size_t i = x; i < x + block_pixels; i += hn::Lanes(tag))
        for (int k = 0; k < 3; ++k) {
            Float sum = hn::Zero(tag);
            for (std::size_t column = 0; column <= 2 * reach; ++column)
                sum = sum + load(row, red + k, i + column);
            hn::StoreU(sum, tag, row[GuideRow::Guide(red_row + k)] + i);
        }
}

void prepare_all_lanes(const PassRow& pixels, std::size_t at, std::size_t reach, GuideRow& out) {
    const std::size_t lanes = hn::Lanes(tag), whole = pixels.count / lanes * lanes;
    for (std::size_t i = 0; i < whole; i += lanes) prepare_lanes(pixels, i, at + i, out);
    if (whole < pixels.count) prepare_last(pixels, whole, at + whole, out);
    if (reach < least_reach_surveyed) {
        std::ranges::fill(out.reaches, Survey{.any_valid = true});
        return;
    }
    for (std::size_t i = 0; i < out.reaches.size(); ++i) {
        const std::size_t x = i * block_pixels;
        out.reaches[i] = survey(out, x, block_pixels + 2 * reach);
        if (out.reaches[i].uniform && out.reaches[i].all_valid) add_rows(out, x, reach);
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace tessera {

HWY_EXPORT(filter_all_lanes);
HWY_EXPORT(prepare_all_lanes);

void filter_block(const FilterWindow& window, std::size_t block, float (&out)[3 * block_pixels]) {
    HWY_DYNAMIC_DISPATCH(filter_all_lanes)(window, block, out);
}

void prepare_row(const PassRow& pixels, std::size_t at, std::size_t reach, GuideRow& out) {
    HWY_DYNAMIC_DISPATCH(prepare_all_lanes)(pixels, at, reach, out);
}

}  // namespace tessera
#endif
