#include "common/filter_block.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>
#include <limits>
#include <optional>

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
using enum GuideRow::Flat;

constexpr hn::CappedTag<float, block_pixels> tag;
constexpr hn::RebindToUnsigned<decltype(tag)> bits_tag;
using Float = hn::Vec<decltype(tag)>;
using Mask = hn::Mask<decltype(tag)>;

/// A window of one pixel needs no groups, and of one wider the bits are too many.
constexpr std::size_t least_reach_grouped = 1, most_reach_grouped = 16;
/// Of a plane's tolerance, what rounding may take from a tap's.
constexpr float certain_share = 0.99f;

HWY_INLINE Float load(const GuideRow& row, int guide, std::size_t at) {
    return hn::LoadU(tag, row[GuideRow::Guide(guide)] + at);
}

HWY_INLINE Mask equal_bits(Float a, Float b) {
    return hn::RebindMask(tag, hn::BitCast(bits_tag, a) == hn::BitCast(bits_tag, b));
}

HWY_INLINE std::uint64_t bits_of(Mask mask) {
    std::uint8_t bytes[8] = {};
    hn::StoreMaskBits(tag, mask, bytes);
    return std::bit_cast<std::uint64_t>(bytes);
}

/// The lowest bits.
HWY_INLINE Mask mask_of(std::uint64_t bits) {
    return hn::LoadMaskBits(tag, reinterpret_cast<const std::uint8_t*>(&bits));
}

constexpr std::uint64_t low_bits(std::size_t count) {
    return count < 64 ? (std::uint64_t(1) << count) - 1 : ~std::uint64_t(0);
}

std::size_t reach_pixels(std::size_t reach) { return block_pixels + 2 * reach; }

// ---- What is known of a row's pixels

void prepare_lanes(const PassRow& pixels, std::size_t first, std::size_t at, GuideRow& out) {
    const auto put = [&](int guide, Float value) {
        hn::StoreU(value, tag, out[GuideRow::Guide(guide)] + at);
    };
    Float e[3], n[3];
    hn::LoadInterleaved3(tag, pixels.irradiance + 3 * first, e[0], e[1], e[2]);
    hn::LoadInterleaved3(tag, pixels.normal + 3 * first, n[0], n[1], n[2]);
    // Zero times anything finite is zero, zero times infinity is not a number.
    const Mask is_finite = (e[0] + e[1] + e[2]) * hn::Zero(tag) == hn::Zero(tag);

    const Float x = hn::Iota(tag, float(pixels.x + int(first)));
    Float way[3];
    for (int k = 0; k < 3; ++k)
        way[k] = hn::Set(tag, pixels.corner[k]) + x * hn::Set(tag, pixels.across[k]);
    const Float d = hn::LoadU(tag, pixels.depth + first) /
                    hn::Sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
    for (int k = 0; k < 3; ++k) {
        put(red + k, hn::IfThenElseZero(is_finite, e[k]));
        put(nx + k, n[k]);
    }
    put(depth, d);
    const Float somewhere = hn::IfThenElse(d == d, d, hn::Set(tag, infinity));
    put(seen, hn::IfThenElse(is_finite, somewhere,
                             hn::Set(tag, std::numeric_limits<float>::quiet_NaN())));
    put(plane, (n[0] * way[0] + n[1] * way[1] + n[2] * way[2]) * d);
    put(surface, hn::LoadU(tag, pixels.surface + first));
}

/// The same for fewer pixels than there are lanes; the lanes behind them are not seen.
void prepare_few(const PassRow& pixels, std::size_t first, std::size_t count, std::size_t at,
                 GuideRow& out) {
    float irradiance[3 * block_pixels] = {}, normal[3 * block_pixels] = {};
    float depths[block_pixels] = {}, surfaces[block_pixels] = {};
    std::fill_n(irradiance, 3 * block_pixels, std::numeric_limits<float>::quiet_NaN());
    std::copy_n(pixels.irradiance + 3 * first, 3 * count, irradiance);
    std::copy_n(pixels.normal + 3 * first, 3 * count, normal);
    std::copy_n(pixels.depth + first, count, depths);
    std::copy_n(pixels.surface + first, count, surfaces);
    prepare_lanes({irradiance, normal, depths, surfaces, count, pixels.x + int(first),
                   pixels.corner, pixels.across},
                  0, at, out);
}

/// Which pixels are valid, and which differ from the next.
void compare_neighbours(GuideRow& row) {
    for (std::size_t line = 0; line + 1 < row.lines; ++line) {
        std::uint64_t same = 0, seen_here = 0;
        for (std::size_t i = 0; i < block_pixels; i += hn::Lanes(tag)) {
            const std::size_t at = line * block_pixels + i;
            Mask alike = equal_bits(load(row, surface, at), load(row, surface, at + 1));
            for (int k = 0; k < 3; ++k)
                alike =
                    hn::And(alike, equal_bits(load(row, nx + k, at), load(row, nx + k, at + 1)));
            const Float z = load(row, seen, at);
            same |= bits_of(alike) << i;
            seen_here |= bits_of(z == z) << i;
        }
        row.ends[line] = std::uint16_t(~same);
        row.valid[line] = std::uint16_t(seen_here);
    }
}

// ---- Groups

/// Bits of the pixels from `at` on: of most_reach_grouped on both sides of a block.
std::uint64_t bits_from(const std::vector<std::uint16_t>& lines, std::size_t at) {
    std::uint64_t out;
    std::memcpy(&out, &lines[at / block_pixels], sizeof out);
    return out >> (at % block_pixels);
}

SurfaceKind kind_at(const GuideRow& row, std::size_t at) {
    const auto bits = [&](GuideRow::Guide guide) {
        return std::bit_cast<std::uint32_t>(row[guide][at]);
    };
    return {bits(surface), bits(nx), bits(ny), bits(nz)};
}

/// As a tap computes it.
float cosine_between(const SurfaceKind& a, const SurfaceKind& b) {
    const auto product = [](std::uint32_t n, std::uint32_t m) {
        return std::bit_cast<float>(n) * std::bit_cast<float>(m);
    };
    return product(a.nx, b.nx) + product(a.ny, b.ny) + product(a.nz, b.nz);
}

bool nothing_hit(const SurfaceKind& kind) { return ((kind.nx | kind.ny | kind.nz) << 1) == 0; }

/// Sets the bounds of the group's planes and depths. Returns whether they are finite.
bool bound(const GuideRow& row, std::size_t from, std::size_t count, PixelGroup& group) {
    const Float far = hn::Set(tag, infinity);
    Float least = far, most = hn::Neg(far), least_depth = far;
    for (std::size_t i = 0; i < count; i += hn::Lanes(tag)) {
        const std::size_t skip = std::min(i, count - hn::Lanes(tag));
        const Mask in_group = mask_of(group.pixels >> skip);
        const Float planes = load(row, plane, from + skip);
        if (!hn::AllTrue(tag, hn::Or(hn::Not(in_group), planes * hn::Zero(tag) == hn::Zero(tag))))
            return false;
        least = hn::Min(least, hn::IfThenElse(in_group, planes, far));
        most = hn::Max(most, hn::IfThenElse(in_group, planes, hn::Neg(far)));
        least_depth =
            hn::Min(least_depth, hn::IfThenElse(in_group, load(row, depth, from + skip), far));
    }
    group.least_plane = hn::GetLane(hn::MinOfLanes(tag, least));
    group.most_plane = hn::GetLane(hn::MaxOfLanes(tag, most));
    group.least_depth = hn::GetLane(hn::MinOfLanes(tag, least_depth));
    return true;
}

/// Adds up the group over the window's width from each pixel of the block.
void add_widths(const GuideRow& row, std::size_t from, std::size_t reach, std::uint64_t valid,
                PixelGroup& group) {
    const std::uint64_t counted = group.pixels & valid;
    const bool all = counted == low_bits(reach_pixels(reach));
    for (std::size_t i = 0; i < block_pixels; i += hn::Lanes(tag)) {
        Float sums[4] = {hn::Zero(tag), hn::Zero(tag), hn::Zero(tag), hn::Zero(tag)};
        for (std::size_t column = i; column <= i + 2 * reach; ++column) {
            if (all) {
                for (int k = 0; k < 3; ++k) sums[k] = sums[k] + load(row, red + k, from + column);
                continue;
            }
            const Mask here = mask_of(counted >> column);
            for (int k = 0; k < 3; ++k)
                sums[k] = sums[k] + hn::IfThenElseZero(here, load(row, red + k, from + column));
            sums[3] = sums[3] + hn::IfThenElseZero(here, hn::Set(tag, 1.0f));
        }
        if (all) sums[3] = hn::Set(tag, float(2 * reach + 1));
        for (std::size_t k = 0; k < 4; ++k)
            hn::StoreU(sums[k], tag, group.sums[k].values.data() + i);
    }
}

/// Cuts the reach of a block, from pixel `from` on, into groups. Returns how many there are, or
/// nothing where they are too many or one of them does not count with itself.
std::optional<std::size_t> cut_reach(const GuideRow& row, std::size_t from, std::size_t reach,
                                     float cosine, std::span<PixelGroup, most_groups> groups) {
    const std::size_t count = reach_pixels(reach);
    const std::uint64_t ends = bits_from(row.ends, from) | std::uint64_t(1) << (count - 1);
    std::size_t found = 0;
    for (std::size_t begin = 0, end = 0; begin < count; begin = end) {
        end = begin + std::size_t(std::countr_zero(ends >> begin)) + 1;
        const SurfaceKind kind = kind_at(row, from + begin);
        if (nothing_hit(kind)) continue;
        std::size_t g = 0;
        while (g < found && !(groups[g].kind == kind)) ++g;
        if (g == most_groups || !(cosine_between(kind, kind) >= cosine)) return {};
        if (g == found) groups[found].kind = kind, groups[found++].pixels = 0;
        groups[g].pixels |= low_bits(end) & ~low_bits(begin);
    }
    return found;
}

/// Finds the groups of a block's reach, from pixel `from` on.
void group_reach(GuideRow& row, std::size_t from, std::size_t reach, float cosine, Reach& out) {
    const std::span<PixelGroup, most_groups> groups(&row.groups[row.group_count], most_groups);
    const auto count = cut_reach(row, from, reach, cosine, groups);
    out.first = std::uint32_t(row.group_count);
    out.count = std::uint32_t(count.value_or(0));
    out.by_taps = !count;
    for (std::size_t g = 0; g < out.count; ++g)
        if (!bound(row, from, reach_pixels(reach), groups[g])) out.count = 0, out.by_taps = true;
    const std::uint64_t valid = bits_from(row.valid, from);
    for (PixelGroup& group : groups.first(out.count)) add_widths(row, from, reach, valid, group);
    row.group_count += out.count;
}

/// Says of which blocks the reach is one group.
void note_flat(GuideRow& row, std::size_t block, bool is_flat) {
    const PixelGroup& group = row.groups[row.reaches[block].first];
    row[least_plane][block] = is_flat ? group.least_plane : std::numeric_limits<float>::quiet_NaN();
    if (!is_flat) return;
    row[flat_surface][block] = std::bit_cast<float>(group.kind.surface);
    row[flat_nx][block] = std::bit_cast<float>(group.kind.nx);
    row[flat_ny][block] = std::bit_cast<float>(group.kind.ny);
    row[flat_nz][block] = std::bit_cast<float>(group.kind.nz);
    row[most_plane][block] = group.most_plane;
    row[least_depth][block] = group.least_depth;
}

void group_row(std::size_t reach, float cosine, GuideRow& row) {
    row.group_count = 0;
    if (reach < least_reach_grouped || reach > most_reach_grouped || !(cosine > 0)) {
        std::ranges::fill(row.reaches, Reach{.by_taps = true});
        return;
    }
    compare_neighbours(row);
    for (std::size_t block = 0; block < row.reaches.size(); ++block) {
        const std::size_t from = row.margin + block * block_pixels - reach;
        Reach& here = row.reaches[block];
        group_reach(row, from, reach, cosine, here);
        const std::uint64_t all = low_bits(reach_pixels(reach));
        note_flat(row, block,
                  here.count == 1 && (row.groups[here.first].pixels & all) == all &&
                      (bits_from(row.valid, from) & all) == all);
    }
}

void prepare_all_lanes(const PassRow& pixels, std::size_t at, std::size_t reach, float cosine,
                       GuideRow& out) {
    const std::size_t lanes = hn::Lanes(tag), count = pixels.count;
    // Up to where a line begins, so that no store after it lies in two.
    std::size_t i = std::min((lanes - at % lanes) % lanes, count);
    if (i > 0) prepare_few(pixels, 0, i, at, out);
    for (; i + lanes <= count; i += lanes) prepare_lanes(pixels, i, at + i, out);
    if (i < count) prepare_few(pixels, i, count - i, at + i, out);
    group_row(reach, cosine, out);
}

// ---- Adding up a window

struct Sums {
    Float r, g, b, count;

    HWY_INLINE void add(Mask here, Float red, Float green, Float blue, Float pixels) {
        r = r + hn::IfThenElseZero(here, red);
        g = g + hn::IfThenElseZero(here, green);
        b = b + hn::IfThenElseZero(here, blue);
        count = count + hn::IfThenElseZero(here, pixels);
    }
};

/// A pixel in each lane, and what is the same for all its taps.
struct Pixels {
    Float n[3], depth, plane, surface, plane_tolerance, facing, along, below;

    Pixels(const FilterWindow& window, const GuideRow& row, std::size_t at)
        : n{load(row, nx, at), load(row, ny, at), load(row, nz, at)},
          depth(load(row, GuideRow::depth, at)),
          plane(load(row, GuideRow::plane, at)),
          surface(load(row, GuideRow::surface, at)),
          plane_tolerance(hn::Set(tag, window.plane_tolerance) * depth),
          facing(plane / depth),
          along(dot(window.across)),
          below(dot(window.down)) {}

    HWY_INLINE Float dot(const vec3& v) const {
        return n[0] * hn::Set(tag, v.x) + n[1] * hn::Set(tag, v.y) + n[2] * hn::Set(tag, v.z);
    }
};

/// Where the pixel of row `q`, seen at depth `z`, shows the same surface. `facing`: dot(normal, way
/// to it as far as depth 1); `apart`: how far it is along rows and columns, at depth 1.
HWY_INLINE Mask same_surface(const Pixels& p, Float facing, Float z, const GuideRow& q,
                             std::size_t at, Float cosine, Float apart) {
    const Float alike =
        p.n[0] * load(q, nx, at) + p.n[1] * load(q, ny, at) + p.n[2] * load(q, nz, at);
    const Mask near = hn::Or(hn::Abs(facing * z - p.plane) <= p.plane_tolerance,
                             hn::Abs(z - p.depth) <= apart * p.depth);
    return hn::And(hn::And(equal_bits(p.surface, load(q, surface, at)), near), alike >= cosine);
}

/// Adds what counts of a row of the window, pixel by pixel.
HWY_INLINE void add_taps(const FilterWindow& window, const Pixels& p, std::size_t row,
                         std::size_t x, Sums& sums) {
    const GuideRow& q = *window.rows[row];
    const Float cosine = hn::Set(tag, window.cosine), one = hn::Set(tag, 1.0f);
    const float reach = float(window.reach), dy = float(row) - reach;
    Float r = hn::Zero(tag), g = r, b = r, count = r;
    Float facing = p.facing + hn::Set(tag, dy) * p.below - hn::Set(tag, reach) * p.along;
    std::size_t at = x - window.reach;
    for (float dx = -reach; dx <= reach; ++dx, ++at, facing = facing + p.along) {
        const float apart = std::abs(dx) + std::abs(dy);
        const Float seen_there = load(q, seen, at);
        const Mask counts = apart == 0 ? seen_there == seen_there
                                       : same_surface(p, facing, seen_there, q, at, cosine,
                                                      hn::Set(tag, apart * window.pixel_angle));
        r = r + hn::IfThenElseZero(counts, load(q, red, at));
        g = g + hn::IfThenElseZero(counts, load(q, green, at));
        b = b + hn::IfThenElseZero(counts, load(q, blue, at));
        count = count + hn::IfThenElseZero(counts, one);
    }
    sums.r = sums.r + r, sums.g = sums.g + g, sums.b = sums.b + b;
    sums.count = sums.count + count;
}

/// What is known for certain of any pixel of one group and any of another.
enum class Verdict { none_counts, all_count, unclear };

HWY_INLINE Verdict judge(const FilterWindow& window, const PixelGroup& p, const PixelGroup& q) {
    if (p.kind.surface != q.kind.surface) return Verdict::none_counts;
    if (p.kind.same_normal(q.kind))
        return std::max(q.most_plane - p.least_plane, p.most_plane - q.least_plane) <=
                       certain_share * window.plane_tolerance * p.least_depth
                   ? Verdict::all_count
                   : Verdict::unclear;
    return cosine_between(p.kind, q.kind) >= window.cosine ? Verdict::unclear
                                                           : Verdict::none_counts;
}

std::span<const PixelGroup> groups_of(const GuideRow& row, const Reach& reach) {
    return std::span(row.groups).subspan(reach.first, reach.count);
}

/// A bit for each row of the window that has to be added by taps.
std::uint64_t rows_by_taps(const FilterWindow& window, std::size_t block) {
    const GuideRow& row = *window.rows[window.reach];
    if (row.reaches[block].by_taps) return ~std::uint64_t(0);
    const std::span<const PixelGroup> own = groups_of(row, row.reaches[block]);
    std::uint64_t out = 0;
    if (own.empty()) return out;
    for (std::size_t i = 0; i <= 2 * window.reach; ++i) {
        const GuideRow& q = *window.rows[i];
        const Reach& theirs = q.reaches[block];
        bool unclear = theirs.by_taps;
        for (const PixelGroup& a : own)
            for (const PixelGroup& b : groups_of(q, theirs))
                unclear = unclear || judge(window, a, b) == Verdict::unclear;
        out |= std::uint64_t(unclear) << i;
    }
    return out;
}

/// Adds a row of the window by groups, for the lanes that begin with pixel `i` of the block.
HWY_INLINE void add_groups(const FilterWindow& window, std::span<const PixelGroup> own,
                           std::span<const PixelGroup> others, std::size_t i, Sums& sums) {
    for (const PixelGroup& p : own) {
        const Mask here = mask_of(p.pixels >> (window.reach + i) & low_bits(hn::Lanes(tag)));
        for (const PixelGroup& q : others) {
            if (!(p.kind == q.kind)) continue;
            const auto of = [&](std::size_t k)
                                HWY_ATTR { return hn::Load(tag, q.sums[k].values.data() + i); };
            sums.add(here, of(0), of(1), of(2), of(3));
        }
    }
}

/// Adds pixels that are in no group to themselves.
void add_alone(const FilterWindow& window, std::span<const PixelGroup> own, std::size_t x,
               std::size_t i, Sums& sums) {
    std::uint64_t grouped = 0;
    for (const PixelGroup& p : own) grouped |= p.pixels;
    grouped = grouped >> (window.reach + i) & low_bits(hn::Lanes(tag));
    if (grouped == low_bits(hn::Lanes(tag))) return;
    const GuideRow& row = *window.rows[window.reach];
    const Mask valid = load(row, seen, x) == load(row, seen, x);
    const Mask alone = hn::And(hn::Not(mask_of(grouped)), valid);
    sums.add(alone, load(row, red, x), load(row, green, x), load(row, blue, x), hn::Set(tag, 1.0f));
}

void filter_lanes(const FilterWindow& window, std::size_t block, std::size_t i,
                  std::uint64_t by_taps, float* out) {
    const GuideRow& own = *window.rows[window.reach];
    const std::span<const PixelGroup> groups = groups_of(own, own.reaches[block]);
    const std::size_t x = own.margin + block * block_pixels + i;
    Sums sums{hn::Zero(tag), hn::Zero(tag), hn::Zero(tag), hn::Zero(tag)};
    const auto add_by_groups = [&](std::size_t row) HWY_ATTR {
        const GuideRow& q = *window.rows[row];
        add_groups(window, groups, groups_of(q, q.reaches[block]), i, sums);
        if (row == window.reach) add_alone(window, groups, x, i, sums);
    };
    if (groups.empty() && !own.reaches[block].by_taps) {
        add_alone(window, groups, x, i, sums);
    } else if (by_taps == 0) {
        for (std::size_t row = 0; row <= 2 * window.reach; ++row) add_by_groups(row);
    } else {
        const Pixels p(window, own, x);
        for (std::size_t row = 0; row <= 2 * window.reach; ++row)
            if (by_taps >> row & 1)
                add_taps(window, p, row, x, sums);
            else
                add_by_groups(row);
    }
    const Float one = hn::Set(tag, 1.0f);
    const Float scale = one / hn::Max(sums.count, one);
    hn::StoreInterleaved3(sums.r * scale, sums.g * scale, sums.b * scale, tag, out);
}

/// Of the blocks from `first` on, as many as there are lanes, a bit for each whose whole window is
/// one group of valid pixels that all count.
std::uint64_t flat_windows(const FilterWindow& window, std::size_t first) {
    const GuideRow& own = *window.rows[window.reach];
    const auto get = [&](const GuideRow& row, GuideRow::Flat flat)
                         HWY_ATTR { return hn::LoadU(tag, row[flat] + first); };
    const Float lower = get(own, least_plane), upper = get(own, most_plane);
    Float least = lower, most = upper;
    Mask flat = lower == lower;
    for (const GuideRow* row : window.rows) {
        const Float planes = get(*row, least_plane);
        flat = hn::And(flat, planes == planes);
        for (const auto kind : {flat_surface, flat_nx, flat_ny, flat_nz})
            flat = hn::And(flat, equal_bits(get(*row, kind), get(own, kind)));
        least = hn::Min(least, planes);
        most = hn::Max(most, get(*row, most_plane));
    }
    const Float tolerance =
        hn::Set(tag, certain_share * window.plane_tolerance) * get(own, least_depth);
    return bits_of(hn::And(flat, hn::Max(most - lower, upper - least) <= tolerance));
}

/// A block whose whole window is one group.
void filter_flat(const FilterWindow& window, std::size_t block, float* out) {
    const std::size_t across = window.rows.size();
    const Float scale = hn::Set(tag, 1.0f) / hn::Set(tag, float(across * across));
    for (std::size_t i = 0; i < block_pixels; i += hn::Lanes(tag)) {
        Float r = hn::Zero(tag), g = hn::Zero(tag), b = hn::Zero(tag);
        for (const GuideRow* row : window.rows) {
            const auto& sums = row->groups[row->reaches[block].first].sums;
            r = r + hn::Load(tag, sums[0].values.data() + i);
            g = g + hn::Load(tag, sums[1].values.data() + i);
            b = b + hn::Load(tag, sums[2].values.data() + i);
        }
        hn::StoreInterleaved3(r * scale, g * scale, b * scale, tag, out + 3 * i);
    }
}

void filter_block(const FilterWindow& window, std::size_t block, float* out) {
    const std::uint64_t by_taps = rows_by_taps(window, block);
    for (std::size_t i = 0; i < block_pixels; i += hn::Lanes(tag))
        filter_lanes(window, block, i, by_taps, out + 3 * i);
}

void filter_all_lanes(const FilterWindow& window, std::size_t count, float* out) {
    std::uint64_t flat = 0;
    for (std::size_t x = 0, block = 0; x < count; x += block_pixels, ++block, flat >>= 1) {
        if (block % hn::Lanes(tag) == 0) flat = flat_windows(window, block);
        float last[3 * block_pixels];
        float* to = x + block_pixels <= count ? out + 3 * x : last;
        flat & 1 ? filter_flat(window, block, to) : filter_block(window, block, to);
        if (to == last) std::copy_n(last, 3 * (count - x), out + 3 * x);
    }
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace tessera {

HWY_EXPORT(filter_all_lanes);
HWY_EXPORT(prepare_all_lanes);

GuideRow::GuideRow(std::size_t blocks, std::size_t reach)
    : margin((reach + block_pixels - 1) / block_pixels * block_pixels),
      lines(blocks + 2 * (margin / block_pixels) + 1),
      values(guide_count * lines),
      ends(lines + 3),
      valid(lines + 3),
      reaches(blocks),
      groups((blocks + 1) * most_groups),
      flats(flat_count * ((blocks + block_pixels - 1) / block_pixels)) {
    forget();
}

void GuideRow::forget() {
    constexpr float nan = std::numeric_limits<float>::quiet_NaN();
    std::fill_n((*this)[seen], lines * block_pixels, nan);
    std::fill_n((*this)[least_plane], reaches.size(), nan);
    std::ranges::fill(reaches, Reach{});
}

void filter_row(const FilterWindow& window, std::size_t count, float* out) {
    HWY_DYNAMIC_DISPATCH(filter_all_lanes)(window, count, out);
}

void prepare_row(const PassRow& pixels, std::size_t at, std::size_t reach, float cosine,
                 GuideRow& out) {
    HWY_DYNAMIC_DISPATCH(prepare_all_lanes)(pixels, at, reach, cosine, out);
}

}  // namespace tessera
#endif
