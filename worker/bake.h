// Instances that are traced as one object in world space, so that rays need not be transformed for
// each, nor find their way among boxes that overlap.
//
// Wald, "Realtime Ray Tracing and Interactive Global Illumination" (2004), chapter 9, tells what is
// static, and one object, from what moves as a whole, and from what deforms. We differ in that
// objects used once are static unless they are said to move, and so are others as far as memory
// allows.
#pragma once

#include <span>
#include <vector>

#include "common/raw_vector.h"
#include "worker/tracer.h"

namespace tessera {

/// For each instance whether it is to be baked: those of objects that are used once, then all of
/// those objects that have the fewest triangles, until `most` triangles are baked. Never what
/// moves, what deforms, and what is singular.
std::vector<std::uint8_t> choose_baked(std::span<const TracerObject> objects,
                                       std::span<const TracerInstance> instances, std::size_t most);

/// How many triangles are worth baking: twice as many as the objects have, for the memory; few are
/// always.
std::size_t bakeable_triangles(std::span<const TracerObject> objects,
                               std::span<const TracerInstance> instances);

/// A baked triangle as the caller knows it.
struct TriangleName {
    std::uint32_t instance = 0;
    std::uint32_t triangle = 0;

    auto operator<=>(const TriangleName&) const = default;
};

/// Names of baked triangles, in their order.
class TriangleNames {
public:
    /// Each instance's triangles begin at a multiple of this.
    static constexpr std::uint32_t run = 8;

    TriangleNames() = default;
    explicit TriangleNames(std::size_t triangles) : runs_(triangles / run) {}

    TriangleName operator[](std::uint32_t baked) const {
        const TriangleName& first = runs_[baked / run];
        return {first.instance, first.triangle + baked % run};
    }
    /// Names the run that begins at `baked`.
    void set(std::size_t baked, const TriangleName& first) { runs_[baked / run] = first; }
    std::size_t memory_bytes() const { return runs_.capacity() * sizeof(TriangleName); }

private:
    RawVector<TriangleName> runs_;
};

/// What baking makes, in world space. Between instances lie degenerate triangles.
struct BakedMesh {
    RawVector<vec3> positions;
    RawVector<uvec3> triangles;
    TriangleNames names;
};

/// Where a corner of a baked triangle stands, and so where rays hit it.
inline vec3 baked_position(const mat4& world_from_object, const vec3& p) {
    return vec3(world_from_object * vec4(p, 1));
}

/// In parallel on the caller's oneTBB arena.
BakedMesh bake(std::span<const TracerObject> objects, std::span<const TracerInstance> instances,
               std::span<const std::uint8_t> baked);

}  // namespace tessera
