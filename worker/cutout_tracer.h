// Surfaces with holes: rays go on past hits on places that are not there. Wraps any tracer, outside
// its kernels, and only for scenes that have such materials.
#pragma once

#include <memory>

#include "worker/surface.h"
#include "worker/tracer.h"

namespace tessera {

/// `surfaces` must outlive the tracer. Places that are there in part stop a share of the rays,
/// chosen by a hash of ray and hit, so that the same ray always finds the same.
std::shared_ptr<const Tracer> with_cutouts(std::shared_ptr<const Tracer> tracer,
                                           const Surfaces& surfaces);

}  // namespace tessera
