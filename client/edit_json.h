// Edits and scenes as JSON, for scripts. A file of timed edits is
//
//   [{"time": 0.5, "edits": [
//       {"move": "lamp", "to": [1, 0.7, 2]},
//       {"set": "material", "name": "oak", "to": {"roughness": 0.2}},
//       {"set": "light", "name": "sun", "to": {"intensity": [3, 3, 3]}},
//       {"set": "camera", "name": "door", "to": {"eye": [0, 1, 3], "at": [0, 1, 0]}},
//       {"transform": "book", "to": [16 numbers, column by column]},
//       {"create": "cup 2", "object": "red cup", "to": [1, 0.7, 2]},
//       {"create light": "spot", "to": {"kind": "spot", "position": [0, 3, 0]}},
//       {"create material": "blue", "like": "oak", "to": {"base_color": [0.1, 0.1, 0.8]}},
//       {"create object": "blue cup", "like": "red cup", "materials": ["blue"]},
//       {"set": "environment", "to": {"radiance": [0.5, 0.6, 0.8]}},
//       {"delete": "chair"}, {"delete light": "sun"}, {"delete camera": "door"},
//       {"delete object": "chair"}, {"delete material": "oak"}]},
//    {"time": 0.7, "view": {"eye": [0, 1, 3], "at": [0, 1, 0], "up": [0, 1, 0], "fov": 45}}, ...]
//
// with times in seconds from the start, in order. What "create" has in "to" may be 16 numbers, too.
// A new object has the mesh of the one that it is like (or "mesh": 64 hexadecimal digits, of the
// scene), and its materials unless it says others; a new material all that the other has, with its
// textures, unless it says otherwise.
// A "view" is where somebody looks from then on; `tessera record` and the viewer write such files.
#pragma once

#include <nlohmann/json_fwd.hpp>
#include <string>
#include <vector>

#include "common/scene_edit.h"

namespace tessera {

/// The operation that changes `scene` so. Throws UserError saying what is wrong with it.
EditOperation operation_of_json(const nlohmann::json& json, const Scene& scene);

/// A number, or numbers between commas; otherwise text.
nlohmann::json value_of_text(const std::string& text);

struct TimedEdit {
    double seconds = 0;
    std::vector<EditOperation> operations;
    std::optional<Camera> view{};  ///< where somebody looks from now on
};

/// Edits of `scene`, and then of what has become of it. Throws UserError naming the file and the
/// edit that cannot be done.
std::vector<TimedEdit> load_timed_edits(const std::string& file, Scene scene);

const char* light_kind_name(LightKind kind);
nlohmann::json json_of(const vec3& v);
nlohmann::json json_of(const Material& material);
nlohmann::json json_of(const Camera& camera);
nlohmann::json json_of(const Scene& scene);
/// As they are read, but for textures of new materials. SetShape cannot be written.
nlohmann::json json_of(const EditOperation& operation);
nlohmann::json json_of(const TimedEdit& edit);

}  // namespace tessera
