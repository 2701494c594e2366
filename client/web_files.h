// The page of tessera-web, as client/web/ holds it; CMake makes them part of the program.
#pragma once

#include <string_view>

namespace tessera {

struct WebFile {
    std::string_view path, type, content;
};

extern const WebFile web_files[3];

}  // namespace tessera
