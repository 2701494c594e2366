// A loader under fuzzing: any bytes are a scene that validates, or a UserError.
#pragma once

#include <filesystem>

#include "common/check.h"
#include "common/scene_io.h"
#include "tests/fuzz/fuzz_folder.h"

namespace tessera {

/// Gives `bytes` to `load` as a file of that name, in a folder of this process.
inline void fuzz_loader(LoadedScene (*load)(const std::filesystem::path&), const char* name,
                        const std::uint8_t* bytes, std::size_t size) {
    const std::filesystem::path file = fuzz_folder() / name;
    write_file(file, {reinterpret_cast<const char*>(bytes), size});
    try {
        const LoadedScene loaded = load(file);
        validate(loaded.bundle.scene);
        for (const BlobId& id : loaded.bundle.scene.meshes)
            decode_mesh(*loaded.bundle.blobs.find(id));
    } catch (const UserError&) {
    }
}

}  // namespace tessera
