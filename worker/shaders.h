// The material shaders that a worker has: those built in, and plug-ins from a folder of its own
// machine. Nothing of them travels: a scene names a shader and its parameters, and a worker that
// lacks it shades with the plain material and says so.
#pragma once

#include <array>
#include <filesystem>
#include <memory>
#include <string>
#include <vector>

#include "common/scene.h"
#include "worker/tessera_shader.h"

namespace tessera {

class ShaderTable {
public:
    /// wood, marble and brick.
    ShaderTable();

    /// Adds the shaders of all shared objects in `folder`, by file name; a later one takes the
    /// place of an earlier one of its name. Returns a sentence for each file that cannot be used.
    /// Throws UserError when the folder cannot be read.
    std::vector<std::string> load(const std::filesystem::path& folder);

    /// Null when there is none.
    const tessera_shader* find(const std::string& name) const;

private:
    void add(const std::filesystem::path& file);

    std::vector<std::shared_ptr<void>> libraries_;
    std::vector<const tessera_shader*> shaders_;
};

/// The built-in ones alone.
std::shared_ptr<const ShaderTable> built_in_shaders();

/// A shader with the parameters of one material.
struct BoundShader {
    const tessera_shader* shader = nullptr;  ///< null: the material is plain
    std::vector<std::array<float, 3>> values;

    bool may(std::uint32_t change) const { return shader && (shader->changes & change) != 0; }
    /// Call only when there is a shader. What it makes is left aside where it is not finite.
    void shade(tessera_shading& point) const;
};

/// Adds a sentence to `complaints` for a shader that is not there, and for each parameter that it
/// does not know.
BoundShader bind_shader(const ShaderTable& table, const Material& material,
                        std::vector<std::string>& complaints);

}  // namespace tessera
