// Embree behind the tracer's interface: the independent second opinion and the yardstick.
#pragma once

#include "worker/tracer.h"

namespace tessera {

/// Builds Embree scenes of high quality, with robust traversal unless the stability benchmark wants
/// Embree's default. Keeps the rules of Tracer except that
/// among equally close hits Embree's own order decides, and that triangles of zero area may be hit
/// through rounding.
std::unique_ptr<Tracer> build_embree_tracer(std::span<const TracerObject> objects,
                                            std::span<const TracerInstance> instances, int threads,
                                            bool robust = true);

}  // namespace tessera
