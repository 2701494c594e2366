// Looking colours up in textures: glTF's texture transform, wrapping, bilinear interpolation.
#pragma once

#include "common/mesh.h"
#include "common/scene.h"

namespace tessera {

/// Texture coordinates as `map` transforms them: scaled, then turned counter-clockwise as seen in
/// the picture, then moved (KHR_texture_transform).
vec2 apply(const TextureMap& map, const vec2& uv);

/// Linear RGBA at `uv`, in [0, 1] unless the texture holds floats, bilinear between texel centres.
/// Zero when uv is not finite.
vec4 lookup(const Texture& texture, const vec2& uv);

/// Mean linear RGB of all texels.
vec3 mean_color(const Texture& texture);

}  // namespace tessera
