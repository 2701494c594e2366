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

/// Where the vertices of a mesh are now, object space: what of a deforming mesh changes. `normals`
/// is empty, so that the surface looks flat, or one per vertex.
struct Shape {
    std::vector<vec3> positions;
    std::vector<vec3> normals;

    bool operator==(const Shape&) const = default;
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
Bytes encode(const Shape& shape);
Bytes encode(const Texture& texture);

/// A shape in a third of the bytes: its coordinates are off by at most `error` (object space, more
/// than 0), components of its normals by a thousandth. decode_shape() reads it as any other.
Bytes encode_within(const Shape& shape, float error);
/// By how much the coordinates of an encoded shape may be off; 0 when it is one without loss.
float shape_error(std::span<const std::byte> shape);

/// Throws std::runtime_error with the reason when the bytes are no valid mesh: sizes that disagree,
/// vertex indices out of range. Never reads outside `bytes`, never allocates more than it holds.
Mesh decode_mesh(std::span<const std::byte> bytes);
Shape decode_shape(std::span<const std::byte> bytes);
Texture decode_texture(std::span<const std::byte> bytes);

/// How many vertices an encoded mesh has; 0 when it is none.
std::uint64_t vertex_count(std::span<const std::byte> mesh);

/// `mesh` with its vertices where `shape` has them. Throws std::runtime_error when it has not one
/// place for each.
Mesh reshaped(Mesh mesh, Shape shape);

}  // namespace tessera
