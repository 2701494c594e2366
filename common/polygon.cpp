#include "common/polygon.h"

#include <numeric>

namespace tessera {
namespace {

/// Cutting ears costs up to the cube of the corners.
constexpr std::size_t max_ear_corners = 256;

/// Area and facing of a polygon of any shape (Newell).
vec3 newell_normal(std::span<const vec3> corners) {
    vec3 sum{0};
    for (std::size_t i = 0; i < corners.size(); ++i)
        sum += cross(corners[i] - corners[0], corners[(i + 1) % corners.size()] - corners[0]);
    return sum;
}

/// Positive where the path a, b, c turns left, seen against `normal`.
float turn(const vec3& a, const vec3& b, const vec3& c, const vec3& normal) {
    return dot(cross(b - a, c - b), normal);
}

bool is_convex(std::span<const vec3> corners, const vec3& normal) {
    const std::size_t n = corners.size();
    for (std::size_t i = 0; i < n; ++i)
        if (turn(corners[i], corners[(i + 1) % n], corners[(i + 2) % n], normal) < 0) return false;
    return true;
}

std::vector<uvec3> fan(std::span<const std::uint32_t> indices) {
    std::vector<uvec3> triangles;
    for (std::size_t i = 2; i < indices.size(); ++i)
        triangles.push_back({indices[0], indices[i - 1], indices[i]});
    return triangles;
}

class EarCutter {
public:
    EarCutter(std::span<const vec3> corners, const vec3& normal, std::vector<std::uint32_t> all)
        : corners_(corners), normal_(normal), left_(std::move(all)) {}

    std::vector<uvec3> cut() {
        std::vector<uvec3> triangles;
        for (std::size_t i = 0; left_.size() > 3 && i < left_.size();) {
            if (!is_ear(i)) {
                ++i;
                continue;
            }
            triangles.push_back({before(i), left_[i], after(i)});
            left_.erase(left_.begin() + std::ptrdiff_t(i));
            i = 0;
        }
        const std::vector<uvec3> remainder = fan(left_);
        triangles.insert(triangles.end(), remainder.begin(), remainder.end());
        return triangles;
    }

private:
    std::uint32_t before(std::size_t i) const {
        return left_[(i + left_.size() - 1) % left_.size()];
    }
    std::uint32_t after(std::size_t i) const { return left_[(i + 1) % left_.size()]; }

    bool is_ear(std::size_t i) const {
        const vec3 &a = corners_[before(i)], &b = corners_[left_[i]], &c = corners_[after(i)];
        if (!(turn(a, b, c, normal_) > 0)) return false;
        for (const std::uint32_t other : left_) {
            const vec3& p = corners_[other];
            if (p == a || p == b || p == c) continue;
            if (turn(a, b, p, normal_) >= 0 && turn(b, c, p, normal_) >= 0 &&
                turn(c, a, p, normal_) >= 0)
                return false;
        }
        return true;
    }

    std::span<const vec3> corners_;
    vec3 normal_;
    std::vector<std::uint32_t> left_;
};

}  // namespace

std::vector<uvec3> triangulate(std::span<const vec3> corners) {
    std::vector<std::uint32_t> all(corners.size());
    std::iota(all.begin(), all.end(), 0);
    const vec3 normal = newell_normal(corners);
    if (corners.size() <= 3 || corners.size() > max_ear_corners || is_convex(corners, normal))
        return fan(all);
    return EarCutter(corners, normal, std::move(all)).cut();
}

}  // namespace tessera
