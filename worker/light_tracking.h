// Which of many lights matter to a view: Wald, Benthin and Slusallek, "Interactive Global
// Illumination in Complex and Highly Occluded Environments" (2003). Paths from the eye ask lights
// for what they send, past all that is in the way, and add it up for each light.
//
// We differ in asking before the frame, too, and not only during the one before: a worker does so
// for itself, a few thousand paths, and comes to the same bits as every other, so that the first
// picture is as good as the next and nobody waits for anybody. What the frame before has found, as
// its tiles were rendered, comes with the frame.
#pragma once

#include "worker/camera.h"
#include "worker/eye.h"

namespace tessera {

/// Estimates what the lights send into the picture: the radiance of its pixels, summed up. Adds the
/// rays traced to `rays`.
LightEstimates scout_lights(const World& world, const Camera& camera, ImageSize size,
                            std::uint32_t seed, std::uint64_t& rays);

/// Adds what an earlier frame of the view has found, in proportion.
void recall(std::span<const LightEstimate> found, LightEstimates& estimates);

}  // namespace tessera
