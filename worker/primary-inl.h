#if defined(TESSERA_PRIMARY_INL_H) == defined(HWY_TARGET_TOGGLE)
#ifdef TESSERA_PRIMARY_INL_H
#undef TESSERA_PRIMARY_INL_H
#else
#define TESSERA_PRIMARY_INL_H
#endif

#include "worker/shaft-inl.h"

HWY_BEFORE_NAMESPACE();
namespace tessera {
namespace HWY_NAMESPACE {

void closest_from(const Scene& scene, const vec3& origin, std::span<const vec3> dirs,
                  std::span<Hit> hits) {
    for (std::size_t i = 0; i < dirs.size(); ++i)
        hits[i] = trace<false>(scene, {origin, 0, dirs[i], infinity});
}

}  // namespace HWY_NAMESPACE
}  // namespace tessera
HWY_AFTER_NAMESPACE();

#endif
