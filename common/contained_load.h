// Scene files and pictures are parsed by libraries that meet whatever somebody has written. So a
// child process parses them: without network and other programs, with bounds on memory and time. It
// says what it found in messages of the protocol, which the parent checks as those of any peer. A
// crash ends the child. The child is the program `tessera-load`, or any other that reads files
// anyway, started anew by that name.
//
//   child -> parent   SceneUpdate, BlobChunk*, SceneReady {left_out: notes}   or   Failure
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>

#include "common/scene_io.h"

namespace tessera {

/// The name by which the child knows what it is there for.
inline constexpr const char* reader_name = "tessera-load";

struct LoadLimits {
    std::uint64_t memory_bytes = std::uint64_t(16) << 30;  ///< address space; not under ASan
    unsigned seconds = 600;                                ///< of CPU time, and twice that in all
};

/// As load_scene(), but for the motion, and then, unless `environment` is empty, set_environment().
/// What needs no file needs no child. `program` is one whose main() begins with load_for_parent().
/// Throws UserError naming the file, also when the child crashes or exceeds its limits.
LoadedScene load_contained(const std::string& file_or_name, const std::string& environment = {},
                           const LoadLimits& limits = {},
                           const std::filesystem::path& program = "/proc/self/exe");

/// The child's part: if this process was started to load, does so and returns its exit status.
std::optional<int> load_for_parent(int argc, char** argv);

}  // namespace tessera
