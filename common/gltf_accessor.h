// Reads glTF accessors, in any component type, dense or sparse, with every bound checked here:
// tinygltf hands on what the file claims.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "common/math.h"

namespace tinygltf {
class Model;
}

namespace tessera {

class AccessorReader {
public:
    /// `file` is for messages; both must outlive the reader.
    AccessorReader(const tinygltf::Model& model, const std::string& file)
        : model_(model), file_(file) {}

    /// The values of accessor `index`, which must have as many components as the type;
    /// normalised integers become [0, 1] or [-1, 1]. Throws UserError naming file and accessor.
    std::vector<vec2> vec2s(int index) const { return vectors<vec2>(index); }
    std::vector<vec3> vec3s(int index) const { return vectors<vec3>(index); }
    std::vector<vec4> vec4s(int index) const { return vectors<vec4>(index); }
    std::vector<glm::dmat4> mat4s(int index) const;
    /// The components of all values, one after another, whatever their type.
    std::vector<float> floats(int index) const;
    /// Vertex indices: unsigned integers, one component.
    std::vector<std::uint32_t> indices(int index) const;

private:
    template <class Vector>
    std::vector<Vector> vectors(int index) const;

    const tinygltf::Model& model_;
    const std::string& file_;
};

/// The bytes of buffer view `index`. Throws UserError beginning with `origin`.
struct ByteRange {
    const unsigned char* data = nullptr;
    std::uint64_t size = 0;
};
ByteRange buffer_view_bytes(const tinygltf::Model& model, int index, const std::string& origin);

}  // namespace tessera
