/* The example of a shader plug-in: cubes of two colours. Build it with

       cc -shared -fPIC -I. -o checker.so tests/plugins/checker.c

   in the root of the repository, and give its folder to `tessera-worker --plugins`. */
#include <math.h>

#include "worker/tessera_shader.h"

enum { size, color };

static const tessera_shader_parameter parameters[] = {
    {"size", {0.1f, 0.1f, 0.1f}},
    {"color", {0, 0, 0}},
};

static void shade(const float (*values)[3], tessera_shading* point) {
    int cell = 0;
    for (int i = 0; i < 3; ++i) cell += (int)floorf(point->position[i] / values[size][0]);
    if (cell & 1)
        for (int c = 0; c < 3; ++c) point->base_color[c] = values[color][c];
}

const tessera_shader* tessera_shader_entry(void) {
    static const tessera_shader checker = {TESSERA_SHADER_VERSION, 0, "checker", 2, parameters,
                                           shade};
    return &checker;
}
