// A folder of this process for files under fuzzing.
#pragma once

#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <span>

#include "common/check.h"

namespace tessera {

inline const std::filesystem::path& fuzz_folder() {
    static const std::filesystem::path folder = [] {
        std::string pattern =
            (std::filesystem::temp_directory_path() / "tessera-fuzz-XXXXXX").string();
        CHECK(mkdtemp(pattern.data()) != nullptr);
        return std::filesystem::path(pattern);
    }();
    return folder;
}

inline void write_file(const std::filesystem::path& file, std::span<const char> bytes) {
    std::ofstream(file, std::ios::binary).write(bytes.data(), std::streamsize(bytes.size()));
}

}  // namespace tessera
