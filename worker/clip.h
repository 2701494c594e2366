// The part of a triangle that lies in a cell, for "perfect" splits (Wald 2004, 7.3.1.1).
#pragma once

#include "worker/triangle.h"

namespace tessera {

/// Bounds of the part of `triangle` inside `cell`, never too small and never outside the cell.
/// Empty when they do not meet.
Box clipped_bounds(const Triangle& triangle, const Box& cell);

}  // namespace tessera
