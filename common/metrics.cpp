#include "common/metrics.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>

#include "common/check.h"

namespace tessera {
namespace {

double difference(double a, double b) {
    if (a == b || (std::isnan(a) && std::isnan(b))) return 0;
    const double d = a - b;
    return std::isfinite(d) ? d : std::numeric_limits<double>::infinity();
}

/// NaN fails both comparisons and becomes 0.
double clamped(double v) { return v > 0 ? std::min(v, 1.0) : 0.0; }

double squared(double v) { return v * v; }

double squared_relative(double difference_of_pair, double reference) {
    if (difference_of_pair == 0 || !std::isfinite(difference_of_pair))
        return std::abs(difference_of_pair);
    return squared(difference_of_pair) / (squared(reference) + 0.01);
}

/// CIELAB of clamped linear sRGB.
std::array<double, 3> lab_from_rgb(const float* rgb) {
    const double r = clamped(rgb[0]), g = clamped(rgb[1]), b = clamped(rgb[2]);
    const auto f = [](double t) {
        constexpr double knee = 6.0 / 29;
        return t > knee * knee * knee ? std::cbrt(t) : t / (3 * knee * knee) + 4.0 / 29;
    };
    const double x = f((0.4124 * r + 0.3576 * g + 0.1805 * b) / 0.9505);
    const double y = f(0.2126 * r + 0.7152 * g + 0.0722 * b);
    const double z = f((0.0193 * r + 0.1192 * g + 0.9505 * b) / 1.0890);
    return {116 * y - 16, 500 * (x - y), 200 * (y - z)};
}

double mean_delta_e(const Image& a, const Image& b) {
    if (a.channels != 3 || a.data.empty()) return 0;
    double sum = 0;
    for (std::size_t i = 0; i < a.data.size(); i += 3) {
        const auto p = lab_from_rgb(&a.data[i]);
        const auto q = lab_from_rgb(&b.data[i]);
        sum += std::sqrt(squared(p[0] - q[0]) + squared(p[1] - q[1]) + squared(p[2] - q[2]));
    }
    return sum / double(a.size.pixels());
}

}  // namespace

Comparison compare(const Image& a, const Image& b) {
    if (a.size != b.size || a.channels != b.channels)
        throw UserError(fmt::format(
            "pictures differ in shape: {}x{} with {} channels against {}x{} with {}; compare "
            "pictures of one size",
            a.size.width, a.size.height, a.channels, b.size.width, b.size.height, b.channels));
    Comparison sum;
    for (std::size_t i = 0; i < a.data.size(); ++i) {
        const double va = a.data[i];
        const double vb = b.data[i];
        const double d = difference(va, vb);
        sum.rmse += squared(d);
        sum.rmse_clamped += squared(clamped(va) - clamped(vb));
        sum.relmse += squared_relative(d, vb);
        sum.max_abs = std::max(sum.max_abs, std::abs(d));
        sum.mean_a += va;
        sum.mean_b += vb;
    }
    const double n = double(std::max<std::size_t>(a.data.size(), 1));
    return {.rmse = std::sqrt(sum.rmse / n),
            .rmse_clamped = std::sqrt(sum.rmse_clamped / n),
            .relmse = sum.relmse / n,
            .delta_e = mean_delta_e(a, b),
            .max_abs = sum.max_abs,
            .mean_a = sum.mean_a / n,
            .mean_b = sum.mean_b / n,
            .identical = a.data.empty() || std::memcmp(a.data.data(), b.data.data(),
                                                       a.data.size() * sizeof(float)) == 0};
}

}  // namespace tessera
