// Wood, marble and brick computed from the place alone: solid textures (Perlin, "An Image
// Synthesizer", 1985), as if the object were cut from a block, with bump mapping from the same
// functions' slopes.
//
// Noise is gradient noise with Perlin's later weights ("Improving Noise", 2002) and slopes in
// closed form; integers alone choose the gradients, and there is no call of a mathematical library,
// so that any machine gets the same bits. Nothing is drawn finer than the pixel that sees it: noise
// fades out before its period falls below the pixel's width, and what repeats is averaged over that
// width in closed form (after the filtered pulse trains of Apodaca and Gritz, "Advanced RenderMan",
// 2000). Colours are linear in what is filtered, so they keep their mean.
#pragma once

#include <span>

#include "common/math.h"
#include "worker/tessera_shader.h"

namespace tessera {

/// A function of the place, and how it grows along each axis.
struct Slope {
    float value = 0;
    vec3 gradient{0};
};

/// About -1 to 1, mean 0; period about 1.
Slope noise(const vec3& p);

/// A function of period 1 that is 0 at 0, rises to 1 at `peak` and falls back to 0.
struct Wave {
    float peak = 0.5f;  ///< in (0, 1)

    /// Mean value over the `width` around x, and how it grows with x.
    vec2 mean(float x, float width) const;
};

/// wood, marble and brick.
std::span<const tessera_shader> solid_textures();

}  // namespace tessera
