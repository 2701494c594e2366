/* What a material shader is, for those who write one as a shared object: `tessera-worker --plugins
   FOLDER` loads every .so of the folder, and a material that names the shader gets its values from
   it. After Wald, "Realtime Ray Tracing and Interactive Global Illumination" (2004), 13.3.3: the
   shader runs once where a ray hits and says how the surface looks there; how light is scattered
   remains the worker's business.

   A plug-in defines

       const tessera_shader* tessera_shader_entry(void)

   and needs nothing of Tessera but this file. It is called by many threads at once, must give the
   same for the same point on every machine, and keeps nothing. */
#ifndef TESSERA_SHADER_H
#define TESSERA_SHADER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Goes up whenever anything below changes; workers refuse other versions. */
#define TESSERA_SHADER_VERSION 1u

/* A point of a surface. Places, lengths and directions are those of the object's own space, so that
   what is computed from them moves with the object. */
typedef struct tessera_shading {
    /* Given. */
    float position[3];
    float normal[3]; /* of the triangle's front, unit */
    float uv[2];     /* 0 without texture coordinates */
    float footprint; /* width of what the pixel sees there; 0: a point */
    /* To be changed: at first what the material and its textures say. */
    float base_color[3]; /* 0 to 1 */
    float roughness;     /* see TESSERA_SHADER_ROUGHENS */
    float metallic;      /* this and those below: see TESSERA_SHADER_RESHAPES */
    float specular;
    float transmission;
    /* At first 0: how the height of the surface grows per length along x, y and z, which tilts its
       normal (bump mapping). */
    float slope[3];
} tessera_shading;

/* What a shader changes beside colour and slope. What it does not announce is not taken. */
enum {
    TESSERA_SHADER_ROUGHENS = 1, /* roughness, never below the material's own */
    TESSERA_SHADER_RESHAPES = 2  /* roughness, metallic, specular, transmission; costs more */
};

typedef struct tessera_shader_parameter {
    const char* name;
    float value[3]; /* where the material says nothing; a number stands in all three */
} tessera_shader_parameter;

typedef struct tessera_shader {
    uint32_t version; /* TESSERA_SHADER_VERSION */
    uint32_t changes; /* bits of the above */
    const char* name; /* by which materials ask for it */
    uint32_t parameter_count;
    const tessera_shader_parameter* parameters;
    /* `values`: of the parameters, in their order. */
    void (*shade)(const float (*values)[3], tessera_shading* point);
} tessera_shader;

typedef const tessera_shader* (*tessera_shader_entry_function)(void);
#define TESSERA_SHADER_ENTRY "tessera_shader_entry"

#ifdef __cplusplus
}
#endif

#endif
