// The discontinuity buffer of Wald, Kollig, Benthin, Keller and Slusallek, "Interactive Global
// Illumination using Fast Ray Tracing" (2002) and Wald's thesis (2004), 13.1.5: neighbouring pixels
// use different sets of virtual point lights (interleaved sampling), and the irradiance of a pixel
// becomes the mean over the n x n window that holds each of the n x n sets once, leaving out pixels
// that show another surface. Only irradiance is filtered, so neither textures nor materials blur.
//
// Differences: the thesis tells surfaces apart by hit distance alone. We ask for the same surface
// id (instance, object, path length), similar normals, and a hit in the same plane or at nearly the
// same depth, where depth is along the direction of view, so that a pixel is as wide anywhere at
// it.
//
// Bias: where the window is complete, the mean has the expectation of the irradiance averaged over
// the window, each set weighing the same. Where neighbours are left out, or cut off at the border
// of the picture, their sets are missing from this pass; the mean over the accepted ones stays an
// unbiased estimate of what they show as long as the sets change places from pass to pass. What
// remains in the limit is the blur over at most n pixels of one surface, which the server takes
// back as noise goes (server/detail_blend.h).
#pragma once

#include <span>

#include "common/tile.h"

namespace tessera {

/// What decides whether two pixels show the same surface; the same for a whole frame.
struct DiscontinuityFilter {
    ImageSize picture;
    Camera camera;
    int window = 3;              ///< n: pixels across, the interleaving; even or below 3: no filter
    float normal_cosine = 0.9f;  ///< least cosine between the normals of one surface
    float plane_pixels = 2;      ///< most distance from the plane, in pixels at that depth: jitter
                                 ///< inside the pixel alone makes more than one
};

/// The channels of one pass over `area`, laid out as in Channel, rows of the area from its top.
struct PassView {
    Rect area;
    std::span<const float> irradiance;
    std::span<const float> normal;
    std::span<const float> depth;
    std::span<const float> surface;
};

/// Filters the irradiance of `rect`, which lies in `pass.area`, into the same pixels of `filtered`,
/// which covers `pass.area`. The result is bit for bit that of the whole picture as soon as the
/// area holds window / 2 pixels around `rect` or ends with the picture; so tiles with a border, and
/// bands in parallel, agree. Irradiance that is not finite counts nowhere; a pixel without any that
/// is accepted becomes zero.
void filter_irradiance(const DiscontinuityFilter& filter, const PassView& pass, const Rect& rect,
                       std::span<float> filtered);

}  // namespace tessera
