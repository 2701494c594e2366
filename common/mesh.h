// Triangle meshes and textures: the large, immutable data of a scene, and their encoding as blobs.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "common/blob.h"
#include "common/math.h"

namespace tessera {

/// An indexed triangle mesh in object space. `normals` and `texcoords` are empty or one per vertex;
/// `slots` is empty (all zero) or one per triangle and picks the object's material.
struct Mesh {
    std::vector<vec3> positions;
    std::vector<vec3> normals;
    std::vector<vec2> texcoords;
    std::vector<uvec3> triangles;
    std::vector<std::uint16_t> slots;

    bool operator==(const Mesh&) const = default;
};

enum class Wrap : std::uint8_t { repeat, mirror, clamp };

/// A picture, rows from the top; texture coordinate (0,0) is its top left corner (glTF). Either
/// 8-bit RGBA or, for light of any strength, linear float RGB.
struct Texture {
    std::uint32_t width = 0;
    std::uint32_t height = 0;
    bool srgb = true;  ///< colour values are sRGB encoded (base colour, emission), not linear
    Wrap wrap_u = Wrap::repeat;
    Wrap wrap_v = Wrap::repeat;
    std::vector<std::uint8_t> rgba;  ///< 4 per pixel, or empty:
    std::vector<vec3> radiance{};    ///< one per pixel

    bool operator==(const Texture&) const = default;
};

/// encode / decode: `decode_mesh(encode(m)) == m`. Little-endian, version byte first.
Bytes encode(const Mesh& mesh);
Bytes encode(const Texture& texture);

/// Throws std::runtime_error with the reason when the bytes are no valid mesh: sizes that disagree,
/// vertex indices out of range. Never reads outside `bytes`, never allocates more than it holds.
Mesh decode_mesh(std::span<const std::byte> bytes);
Texture decode_texture(std::span<const std::byte> bytes);

}  // namespace tessera
