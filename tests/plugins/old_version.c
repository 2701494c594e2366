/* A plug-in that workers refuse. */
#include "worker/tessera_shader.h"

static void shade(const float (*values)[3], tessera_shading* point) {
    (void)values;
    (void)point;
}

const tessera_shader* tessera_shader_entry(void) {
    static const tessera_shader shader = {999, 0, "old", 0, 0, shade};
    return &shader;
}
