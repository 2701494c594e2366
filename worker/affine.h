// Affine maps between an object's space and the world, as instances use them (Wald 2004, chapter
// 9).
#pragma once

#include <optional>

#include "common/math.h"

namespace tessera {

/// The upper three rows of an affine matrix.
struct Affine {
    mat3 linear{1};
    vec3 translation{0};

    vec3 point(const vec3& p) const { return linear * p + translation; }
    vec3 vector(const vec3& v) const { return linear * v; }
};

/// The ray seen through `m`. Its direction is not normalised again, so t means the same on both
/// sides (Wald 2004, 9.3).
inline Ray transformed(const Ray& ray, const Affine& m) {
    return {m.point(ray.org), ray.tmin, m.vector(ray.dir), ray.tmax};
}

/// The inverse of an affine matrix; nothing when it is not finite or flattens space as far as float
/// can tell.
inline std::optional<Affine> inverse_affine(const mat4& m) {
    using glm::dmat3;
    using glm::dvec3;
    const dmat3 linear(m);
    const double volume = length(linear[0]) * length(linear[1]) * length(linear[2]);
    // Written so that NaN is singular too.
    if (!(std::abs(determinant(linear)) > 1e-6 * volume)) return std::nullopt;
    const dmat3 inverse_linear = inverse(linear);
    const Affine inverse{mat3(inverse_linear), vec3(-(inverse_linear * dvec3(m[3])))};
    if (!is_finite(inverse.linear[0]) || !is_finite(inverse.linear[1]) ||
        !is_finite(inverse.linear[2]) || !is_finite(inverse.translation))
        return std::nullopt;
    return inverse;
}

}  // namespace tessera
