// A loader under fuzzing: any bytes are a scene that validates, or a UserError.
#pragma once

#include <unistd.h>

#include <filesystem>
#include <fstream>

#include "common/check.h"
#include "common/scene_io.h"

namespace tessera {

/// Gives `bytes` to `load` as a file of that name, in a folder of this process.
inline void fuzz_loader(LoadedScene (*load)(const std::filesystem::path&), const char* name,
                        const std::uint8_t* bytes, std::size_t size) {
    static const std::filesystem::path folder = [] {
        std::string pattern =
            (std::filesystem::temp_directory_path() / "tessera-fuzz-XXXXXX").string();
        CHECK(mkdtemp(pattern.data()) != nullptr);
        return std::filesystem::path(pattern);
    }();
    std::ofstream(folder / name, std::ios::binary)
        .write(reinterpret_cast<const char*>(bytes), std::streamsize(size));
    try {
        const LoadedScene loaded = load(folder / name);
        validate(loaded.bundle.scene);
        for (const BlobId& id : loaded.bundle.scene.meshes)
            decode_mesh(*loaded.bundle.blobs.find(id));
    } catch (const UserError&) {
    }
}

}  // namespace tessera
