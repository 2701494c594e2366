// Works on rows of separate components, so that the compiler turns the loops over x into SIMD code.
// A ring holds the window's rows; each is prepared once. Taps are added in the order of the window,
// row by row, for every pixel, which fixes the order of all sums.

#include "common/discontinuity.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <vector>

#include "common/check.h"

namespace tessera {
namespace {

/// One row of the rect and `window / 2` pixels to either side. Pixels outside the area have valid 0
/// and leftovers elsewhere.
struct GuideRow {
    std::vector<float> red, green, blue;        // irradiance
    std::vector<float> nx, ny, nz;              // normal
    std::vector<float> px, py, pz;              // hit relative to the eye, as if seen directly
    std::vector<float> depth, plane;            // plane: dot(normal, hit)
    std::vector<std::uint32_t> surface, valid;  // valid: all ones where irradiance is finite

    explicit GuideRow(std::size_t width)
        : red(width),
          green(width),
          blue(width),
          nx(width),
          ny(width),
          nz(width),
          px(width),
          py(width),
          pz(width),
          depth(width),
          plane(width),
          surface(width),
          valid(width) {}
};

struct SumRow {
    std::vector<float> red, green, blue, count;

    explicit SumRow(std::size_t width) : red(width), green(width), blue(width), count(width) {}
    void clear() {
        for (auto* row : {&red, &green, &blue, &count}) std::fill(row->begin(), row->end(), 0.0f);
    }
};

/// Directions from the eye through pixel centres.
struct EyeRays {
    vec3 corner, across, down;  // unnormalised direction is corner + x * across + y * down
    float pixel_angle;          // width of a pixel at distance 1

    EyeRays(const Camera& camera, ImageSize size) {
        const vec3 forward = normalize(camera.at - camera.eye);
        const vec3 right = normalize(cross(forward, camera.up));
        const vec3 up = cross(right, forward);
        pixel_angle = 2 * std::tan(0.5f * camera.fov_y * (pi / 180)) / float(size.height);
        across = right * pixel_angle;
        down = -up * pixel_angle;
        corner = forward + across * (0.5f - 0.5f * float(size.width)) +
                 down * (0.5f - 0.5f * float(size.height));
    }
};

/// One offset of the window for one row of pixels.
struct Tap {
    const GuideRow &p, &q;    // the row itself, and the neighbour's
    std::size_t here, there;  // where they begin
    float cosine;             // least
    float plane_tolerance;    // distance from the plane at depth 1
    float depth_tolerance;    // difference at depth 1
};

/// Adds what counts of one tap. The same arithmetic whatever the instruction set, so the same bits.
[[gnu::always_inline]] inline void add_tap_in_rows(const Tap& tap, SumRow& sums,
                                                   std::vector<std::uint32_t>& accepted_pixels) {
    const std::size_t n = sums.count.size();
    const float* __restrict p_nx = tap.p.nx.data() + tap.here;
    const float* __restrict p_ny = tap.p.ny.data() + tap.here;
    const float* __restrict p_nz = tap.p.nz.data() + tap.here;
    const float* __restrict p_plane = tap.p.plane.data() + tap.here;
    const float* __restrict p_depth = tap.p.depth.data() + tap.here;
    const std::uint32_t* __restrict p_surface = tap.p.surface.data() + tap.here;
    const float* __restrict q_nx = tap.q.nx.data() + tap.there;
    const float* __restrict q_ny = tap.q.ny.data() + tap.there;
    const float* __restrict q_nz = tap.q.nz.data() + tap.there;
    const float* __restrict q_px = tap.q.px.data() + tap.there;
    const float* __restrict q_py = tap.q.py.data() + tap.there;
    const float* __restrict q_pz = tap.q.pz.data() + tap.there;
    const float* __restrict q_depth = tap.q.depth.data() + tap.there;
    const float* __restrict q_red = tap.q.red.data() + tap.there;
    const float* __restrict q_green = tap.q.green.data() + tap.there;
    const float* __restrict q_blue = tap.q.blue.data() + tap.there;
    const std::uint32_t* __restrict q_surface = tap.q.surface.data() + tap.there;
    const std::uint32_t* __restrict q_valid = tap.q.valid.data() + tap.there;
    float* __restrict red = sums.red.data();
    float* __restrict green = sums.green.data();
    float* __restrict blue = sums.blue.data();
    float* __restrict count = sums.count.data();
    std::uint32_t* __restrict accepted = accepted_pixels.data();

    for (std::size_t i = 0; i < n; ++i) {
        const float alike = p_nx[i] * q_nx[i] + p_ny[i] * q_ny[i] + p_nz[i] * q_nz[i];
        const float height = p_nx[i] * q_px[i] + p_ny[i] * q_py[i] + p_nz[i] * q_pz[i] - p_plane[i];
        const std::uint32_t in_plane =
            std::abs(height) <= tap.plane_tolerance * p_depth[i] ? ~0u : 0u;
        const std::uint32_t close =
            std::abs(q_depth[i] - p_depth[i]) <= tap.depth_tolerance * p_depth[i] ? ~0u : 0u;
        const std::uint32_t facing = alike >= tap.cosine ? ~0u : 0u;
        const std::uint32_t object = p_surface[i] == q_surface[i] ? ~0u : 0u;
        accepted[i] = object & facing & (in_plane | close) & q_valid[i];
    }
    for (std::size_t i = 0; i < n; ++i) {
        const float weight = float(std::int32_t(accepted[i] & 1));
        red[i] += weight * q_red[i];
        green[i] += weight * q_green[i];
        blue[i] += weight * q_blue[i];
        count[i] += weight;
    }
}

using AddTap = void (*)(const Tap& tap, SumRow& sums, std::vector<std::uint32_t>& accepted);

void add_tap_anywhere(const Tap& tap, SumRow& sums, std::vector<std::uint32_t>& accepted) {
    add_tap_in_rows(tap, sums, accepted);
}

#if defined(__x86_64__)
[[gnu::target("avx2")]] void add_tap_avx2(const Tap& tap, SumRow& sums,
                                          std::vector<std::uint32_t>& accepted) {
    add_tap_in_rows(tap, sums, accepted);
}

AddTap best_add_tap() { return __builtin_cpu_supports("avx2") ? add_tap_avx2 : add_tap_anywhere; }
#else
AddTap best_add_tap() { return add_tap_anywhere; }
#endif

class RectFilter {
public:
    RectFilter(const DiscontinuityFilter& filter, const PassView& pass, const Rect& rect)
        : filter_(filter),
          pass_(pass),
          rect_(rect),
          reach_(filter.window / 2),
          rays_(filter.camera, filter.picture),
          sums_(std::size_t(rect.width())),
          counts_(std::size_t(rect.width())) {
        const std::size_t width = std::size_t(rect.width() + 2 * reach_);
        for (int i = 0; i < filter.window; ++i) ring_.emplace_back(width);
    }

    void run(std::span<float> filtered) {
        for (int y = rect_.y0 - reach_; y < rect_.y0 + reach_; ++y) prepare(y);
        for (int y = rect_.y0; y < rect_.y1; ++y) {
            prepare(y + reach_);
            sums_.clear();
            for (int dy = -reach_; dy <= reach_; ++dy)
                for (int dx = -reach_; dx <= reach_; ++dx)
                    if (dx == 0 && dy == 0)
                        add_self(row(y));
                    else
                        add_tap(row(y), row(y + dy), dx, std::abs(dx) + std::abs(dy));
            store(y, filtered);
        }
    }

private:
    GuideRow& row(int y) { return ring_[std::size_t(y - rect_.y0 + reach_) % ring_.size()]; }

    void prepare(int y);
    void add_self(const GuideRow& row);
    void add_tap(const GuideRow& p, const GuideRow& q, int dx, int distance);
    void store(int y, std::span<float> filtered) const;

    const DiscontinuityFilter& filter_;
    const PassView& pass_;
    const Rect rect_;
    const int reach_;
    const EyeRays rays_;
    std::vector<GuideRow> ring_;
    SumRow sums_;
    std::vector<std::uint32_t> counts_;  // all ones where a tap counts
    const AddTap add_tap_ = best_add_tap();
};

void RectFilter::prepare(int y) {
    GuideRow& out = row(y);
    std::fill(out.valid.begin(), out.valid.end(), 0u);
    const Rect& area = pass_.area;
    if (y < area.y0 || y >= area.y1) return;
    const int x0 = std::max(rect_.x0 - reach_, area.x0);
    const int x1 = std::min(rect_.x1 + reach_, area.x1);
    const vec3 row_start = rays_.corner + float(y) * rays_.down;
    for (int x = x0; x < x1; ++x) {
        const std::size_t from =
            std::size_t(y - area.y0) * std::size_t(area.width()) + std::size_t(x - area.x0);
        const std::size_t to = std::size_t(x - rect_.x0 + reach_);
        const float* e = &pass_.irradiance[3 * from];
        const float* n = &pass_.normal[3 * from];
        // Zero times anything finite is zero, zero times infinity is not a number.
        const bool valid = (e[0] + e[1] + e[2]) * 0 == 0;
        out.red[to] = valid ? e[0] : 0;
        out.green[to] = valid ? e[1] : 0;
        out.blue[to] = valid ? e[2] : 0;
        out.valid[to] = valid ? ~0u : 0u;
        const vec3 direction = row_start + float(x) * rays_.across;
        const float depth = pass_.depth[from];
        const vec3 p = direction * (depth / std::sqrt(dot(direction, direction)));
        out.nx[to] = n[0];
        out.ny[to] = n[1];
        out.nz[to] = n[2];
        out.px[to] = p.x;
        out.py[to] = p.y;
        out.pz[to] = p.z;
        out.depth[to] = depth;
        out.plane[to] = n[0] * p.x + n[1] * p.y + n[2] * p.z;
        out.surface[to] = std::bit_cast<std::uint32_t>(pass_.surface[from]);
    }
}

void RectFilter::add_self(const GuideRow& row) {
    for (std::size_t i = 0; i < sums_.count.size(); ++i) {
        const std::size_t at = i + std::size_t(reach_);
        sums_.red[i] += row.red[at];
        sums_.green[i] += row.green[at];
        sums_.blue[i] += row.blue[at];
        sums_.count[i] += row.valid[at] ? 1.0f : 0.0f;
    }
}

/// Adds to each pixel of row `p` the pixel of row `q` that lies `dx` to the right. In one plane is
/// what keeps within plane_pixels of it, or differs in depth by no more than the pixels are apart:
/// behind a mirror the normal belongs to the true surface and the hit to its image, so that the
/// plane says nothing there. Comparisons with what is not a number fail, so such pixels stay alone.
void RectFilter::add_tap(const GuideRow& p, const GuideRow& q, int dx, int distance) {
    const Tap tap{.p = p,
                  .q = q,
                  .here = std::size_t(reach_),
                  .there = std::size_t(reach_ + dx),
                  .cosine = filter_.normal_cosine,
                  .plane_tolerance = filter_.plane_pixels * rays_.pixel_angle,
                  .depth_tolerance = float(distance) * rays_.pixel_angle};
    add_tap_(tap, sums_, counts_);
}

void RectFilter::store(int y, std::span<float> filtered) const {
    const Rect& area = pass_.area;
    float* out = &filtered[3 * (std::size_t(y - area.y0) * std::size_t(area.width()) +
                                std::size_t(rect_.x0 - area.x0))];
    for (std::size_t i = 0; i < sums_.count.size(); ++i) {
        const float scale = 1 / std::max(sums_.count[i], 1.0f);
        out[3 * i] = sums_.red[i] * scale;
        out[3 * i + 1] = sums_.green[i] * scale;
        out[3 * i + 2] = sums_.blue[i] * scale;
    }
}

}  // namespace

void filter_irradiance(const DiscontinuityFilter& filter, const PassView& pass, const Rect& rect,
                       std::span<float> filtered) {
    CHECK(filtered.size() == 3 * pass.area.pixels() && pass.irradiance.size() == filtered.size());
    CHECK(pass.normal.size() == filtered.size() && pass.depth.size() == pass.area.pixels() &&
          pass.surface.size() == pass.area.pixels());
    CHECK(rect.x0 >= pass.area.x0 && rect.x1 <= pass.area.x1 && rect.y0 >= pass.area.y0 &&
          rect.y1 <= pass.area.y1);
    if (rect.pixels() == 0) return;
    DiscontinuityFilter used = filter;
    if (used.window % 2 == 0 || used.window < 3) used.window = 1;
    RectFilter(used, pass, rect).run(filtered);
}

}  // namespace tessera
