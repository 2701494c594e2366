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

/// Writes a binary glTF with everything a Scene holds but its environment, for which glTF has no
/// place, and shapes: what deforms is as its mesh has it. Of its motion the instances that are
/// carried are written. Throws UserError when the file cannot be written.
void save_glb(const SceneBundle& bundle, const std::filesystem::path& file);

/// Lights the scene from all sides: `file_or_radiance` is a number, the radiance, or a picture by
/// latitude and longitude. Throws UserError.
void set_environment(SceneBundle& bundle, const std::string& file_or_radiance);

}  // namespace tessera
