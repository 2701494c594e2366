// A ring holds the window's rows, each prepared once; common/filter_block.h adds up the window.

#include "common/discontinuity.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "common/check.h"
#include "common/filter_block.h"

namespace tessera {
namespace {

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

class RectFilter {
public:
    RectFilter(const DiscontinuityFilter& filter, const PassView& pass, const Rect& rect)
        : pass_(pass),
          rect_(rect),
          reach_(filter.window / 2),
          rays_(filter.camera, filter.picture) {
        const std::size_t blocks = (std::size_t(rect.width()) + block_pixels - 1) / block_pixels;
        for (int i = 0; i < filter.window; ++i) ring_.emplace_back(blocks, std::size_t(reach_));
        window_ = {.rows = std::vector<const GuideRow*>(ring_.size()),
                   .reach = std::size_t(reach_),
                   .cosine = filter.normal_cosine,
                   .plane_tolerance = filter.plane_pixels * rays_.pixel_angle,
                   .pixel_angle = rays_.pixel_angle,
                   .across = rays_.across,
                   .down = rays_.down};
    }

    void run(std::span<float> filtered) {
        for (int y = rect_.y0 - reach_; y < rect_.y0 + reach_; ++y) prepare(y);
        for (int y = rect_.y0; y < rect_.y1; ++y) {
            prepare(y + reach_);
            for (int dy = -reach_; dy <= reach_; ++dy)
                window_.rows[std::size_t(dy + reach_)] = &row(y + dy);
            filter_row(window_, std::size_t(rect_.width()), &filtered[3 * index(rect_.x0, y)]);
        }
    }

private:
    GuideRow& row(int y) { return ring_[std::size_t(y - rect_.y0 + reach_) % ring_.size()]; }

    void prepare(int y);
    /// Of a pixel in the pass.
    std::size_t index(int x, int y) const {
        const Rect& area = pass_.area;
        return std::size_t(y - area.y0) * std::size_t(area.width()) + std::size_t(x - area.x0);
    }

    const PassView& pass_;
    const Rect rect_;
    const int reach_;
    const EyeRays rays_;
    std::vector<GuideRow> ring_;
    FilterWindow window_;
};

void RectFilter::prepare(int y) {
    GuideRow& out = row(y);
    const Rect& area = pass_.area;
    if (y < area.y0 || y >= area.y1) return out.forget();
    const int x0 = std::max(rect_.x0 - reach_, area.x0);
    const int x1 = std::min(rect_.x1 + reach_, area.x1);
    const std::size_t from = index(x0, y);
    const PassRow pixels{.irradiance = &pass_.irradiance[3 * from],
                         .normal = &pass_.normal[3 * from],
                         .depth = &pass_.depth[from],
                         .surface = &pass_.surface[from],
                         .count = std::size_t(x1 - x0),
                         .x = x0,
                         .corner = rays_.corner + float(y) * rays_.down,
                         .across = rays_.across};
    prepare_row(pixels, out.margin + std::size_t(x0) - std::size_t(rect_.x0), std::size_t(reach_),
                window_.cosine, out);
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
