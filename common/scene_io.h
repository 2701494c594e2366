// Files and generator names -> scenes, and scenes -> .glb files.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "common/scene.h"

namespace tessera {

struct LoadedScene {
    SceneBundle bundle;
    /// One sentence each, for the log: what was dropped and counted (degenerate triangles, vertices
    /// that are not finite, empty meshes, unused materials) and what the format had that we do not
    /// model.
    std::vector<std::string> notes;
};

/// Loads .obj (+.mtl), .ply, .gltf or .glb, or generates the scene of that name (`cornell`,
/// `office`...). Throws UserError naming the file, and its line or byte where one is known, and
/// what to do.
LoadedScene load_scene(const std::string& file_or_name);

LoadedScene load_obj(const std::filesystem::path& file);
LoadedScene load_ply(const std::filesystem::path& file);
LoadedScene load_gltf(const std::filesystem::path& file);

/// Writes a binary glTF with everything a Scene holds. Throws UserError when the file cannot be
/// written.
void save_glb(const SceneBundle& bundle, const std::filesystem::path& file);

}  // namespace tessera
