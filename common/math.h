// Vectors, boxes, frames and rays: GLM's types under the project's names, and the few pieces GLM
// lacks.
//
// Spaces: "world" is the scene's, "object" a mesh's own, "raster" pixels with the origin at the top
// left. Matrices are named by what they map: `world_from_object * p`.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <glm/glm.hpp>
#include <limits>

namespace tessera {

using glm::ivec2;
using glm::mat3;
using glm::mat4;
using glm::uvec3;
using glm::vec2;
using glm::vec3;
using glm::vec4;

inline constexpr float infinity = std::numeric_limits<float>::infinity();
inline constexpr float pi = 3.14159265358979323846f;

/// A ray segment: the points `org + t * dir` with tmin < t < tmax. `dir` need not be normalised.
struct Ray {
    vec3 org{0};
    float tmin = 0;
    vec3 dir{0, 0, 1};
    float tmax = infinity;
};

/// An axis-aligned box; empty (lo > hi) until something is added.
struct Box {
    vec3 lo{infinity};
    vec3 hi{-infinity};

    void add(const vec3& p) {
        lo = glm::min(lo, p);
        hi = glm::max(hi, p);
    }
    void add(const Box& b) {
        lo = glm::min(lo, b.lo);
        hi = glm::max(hi, b.hi);
    }
    bool empty() const { return !(lo.x <= hi.x && lo.y <= hi.y && lo.z <= hi.z); }
    vec3 extent() const { return empty() ? vec3(0) : hi - lo; }
    vec3 centre() const { return 0.5f * (lo + hi); }
    float area() const {
        const vec3 e = extent();
        return 2 * (e.x * e.y + e.y * e.z + e.z * e.x);
    }
    bool operator==(const Box&) const = default;
};

/// The box of the eight transformed corners of `b`.
inline Box transformed(const Box& b, const mat4& m) {
    Box out;
    for (int i = 0; i < 8 && !b.empty(); ++i)
        out.add(vec3(m * vec4(i & 1 ? b.hi.x : b.lo.x, i & 2 ? b.hi.y : b.lo.y,
                              i & 4 ? b.hi.z : b.lo.z, 1)));
    return out;
}

/// An orthonormal frame around the unit vector `n`
/// (Duff et al., "Building an Orthonormal Basis, Revisited", 2017).
struct Frame {
    vec3 s, t, n;

    explicit Frame(const vec3& normal) : n(normal) {
        const float sign = std::copysign(1.0f, n.z);
        const float a = -1.0f / (sign + n.z);
        const float b = n.x * n.y * a;
        s = vec3(1 + sign * n.x * n.x * a, sign * b, -sign * n.x);
        t = vec3(b, sign + n.y * n.y * a, -n.y);
    }
    vec3 world_from_local(const vec3& v) const { return s * v.x + t * v.y + n * v.z; }
    vec3 local_from_world(const vec3& v) const { return {dot(v, s), dot(v, t), dot(v, n)}; }
};

inline bool is_finite(const vec3& v) {
    return std::isfinite(v.x) && std::isfinite(v.y) && std::isfinite(v.z);
}
inline float max_component(const vec3& v) { return std::max(v.x, std::max(v.y, v.z)); }
inline float mean_component(const vec3& v) { return (v.x + v.y + v.z) / 3; }

}  // namespace tessera
