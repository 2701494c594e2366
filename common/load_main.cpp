// tessera-load: reads scene files for tessera-server, which so starts without the hundreds of
// shared libraries that picture formats bring.

#include <cstdio>

#include "common/contained_load.h"

int main(int argc, char** argv) {
    if (const std::optional<int> status = tessera::load_for_parent(argc, argv)) return *status;
    std::fputs("tessera-load: tessera-server starts it to read scene files\n", stderr);
    return 2;
}
