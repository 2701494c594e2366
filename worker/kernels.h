// The tracing kernels: one source (worker/*-inl.h), compiled by Google Highway for each instruction
// set and chosen at run time. Nothing else knows instruction sets.
#pragma once

#include "worker/tracer.h"
#include "worker/wide_scene.h"

namespace tessera {

enum class Isa { scalar, sse4, avx2, avx512 };

/// What this machine runs best, or what the environment's TESSERA_SIMD names. Throws UserError for
/// a name that is unknown or that this machine cannot run.
Isa chosen_isa();

/// The lanes of one instruction, and so the children of a node.
int width_of(Isa isa);

/// Each does to a scene what Tracer's function of that name does.
template <int width>
struct Kernels {
    void (*closest_hits)(const WideScene<width>&, std::span<const Ray>, std::span<Hit>);
    void (*occluded)(const WideScene<width>&, std::span<const Ray>, std::span<std::uint8_t>);
    RayMask (*occluded_from)(const WideScene<width>&, const vec3& origin, const Targets&,
                             const RayMask& wanted, OccluderCache*);
    void (*closest_from)(const WideScene<width>&, const vec3& origin, std::span<const vec3> dirs,
                         std::span<Hit>);
};

/// `width` must be width_of(isa).
template <int width>
const Kernels<width>& kernels(Isa isa);

}  // namespace tessera
