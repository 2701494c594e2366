// What a scene is: plain data with indices. Large data (meshes, textures, shapes) is named by blob
// id and kept in a BlobStore beside the scene, so a Scene is small, cheap to copy, and compared by
// value.
//
// Two levels as in Wald's thesis (2004, chapter 9): objects hold geometry, instances place them.
// Units: metres; radiance in W/(sr m^2) per RGB channel. glTF's candela and nit are taken 1:1 as
// W/sr and W/(sr m^2), so that punctual lights and emissive surfaces of one file keep their ratio.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "common/blob.h"
#include "common/math.h"
#include "common/mesh.h"
#include "common/motion.h"

namespace tessera {

/// A texture as a material uses it: index into Scene::textures (-1: none) and glTF's texture
/// transform.
struct TextureMap {
    std::int32_t texture = -1;
    vec2 offset{0};
    vec2 scale{1};
    float rotation = 0;  ///< radians, counter-clockwise

    bool operator==(const TextureMap&) const = default;
};

/// More parameters than any shader has.
inline constexpr std::size_t most_shader_parameters = 256;

/// What alpha means: nothing; the surface is there or not; the share of it that is there.
enum class AlphaMode : std::uint8_t { opaque, mask, blend };

/// A number (three times) or a colour that a material hands to its shader.
struct ShaderParameter {
    std::string name;
    vec3 value{0};

    bool operator==(const ShaderParameter&) const = default;
};

/// glTF's metallic-roughness surface with its extensions. MTL's Kd is base_color with metallic and
/// specular 0: exactly Lambert.
struct Material {
    std::string name;
    vec3 base_color{0.8f};
    TextureMap base_color_map{};
    float metallic = 0;
    float roughness = 1;
    TextureMap metallic_roughness_map{};  ///< blue: metallic, green: roughness
    float specular = 0;      ///< strength of the reflecting coat of what is no metal; glTF's is 1
    float ior = 1.5f;        ///< index of refraction, at least 1
    float transmission = 0;  ///< share of light that passes through as through glass
    TextureMap transmission_map{};  ///< red
    bool thin_walled = false;       ///< light that passes is not refracted: a pane, no body
    vec3 emission{0};               ///< radiance
    TextureMap emission_map{};
    bool two_sided_emission = false;  ///< else only the front (counter-clockwise) side emits
    TextureMap normal_map{};          ///< tangent space: red along u, green against v
    float normal_scale = 1;           ///< how much red and green count
    AlphaMode alpha_mode = AlphaMode::opaque;
    float alpha = 1;            ///< times alpha of base_color_map: how much of the surface is there
    float alpha_cutoff = 0.5f;  ///< mask: with less alpha than this the surface is not there
    /// What changes these values from point to point: wood, marble, brick, or a plug-in of the
    /// worker. Empty: nothing.
    std::string shader{};
    std::vector<ShaderParameter> shader_parameters{};  ///< others are as the shader has them

    bool operator==(const Material&) const = default;
};

/// Geometry that moves as one: a mesh and the material of each of its slots. What deforms has its
/// vertices in a shape of its own, so that only they travel when they move.
struct Object {
    std::string name;
    std::uint32_t mesh = 0;                ///< index into Scene::meshes
    std::vector<std::uint32_t> materials;  ///< slot -> index into Scene::materials
    std::int32_t shape = -1;  ///< index into Scene::shapes: where the vertices are; -1: the mesh's

    bool operator==(const Object&) const = default;
};

struct Instance {
    std::string name;
    std::uint32_t object = 0;
    mat4 world_from_object{1};  ///< affine; may mirror, shear and scale
    bool moves = false;         ///< often: cheap to move, and costs rays more

    bool operator==(const Instance&) const = default;
};

enum class LightKind : std::uint8_t { point, spot, directional };

/// A punctual light. Area lights are emissive materials.
struct Light {
    std::string name;
    LightKind kind = LightKind::point;
    vec3 position{0};
    vec3 direction{0, 0, -1};    ///< unit, the way light travels (spot, directional)
    vec3 intensity{1};           ///< W/sr (point, spot); irradiance W/m^2 (directional)
    float inner_angle = 0;       ///< spot: half angle of full intensity, radians
    float outer_angle = pi / 4;  ///< spot: half angle where intensity reaches zero, radians

    bool operator==(const Light&) const = default;
};

/// Light from infinitely far away on all sides: radiance, times that of a float texture if there is
/// one. Its middle column lies towards -z, its top towards +y (latitude by longitude).
struct Environment {
    vec3 radiance{0};
    std::int32_t texture = -1;  ///< index into Scene::textures
    float rotation = 0;         ///< around +y, counter-clockwise from above, radians

    bool operator==(const Environment&) const = default;
};

struct Camera {
    std::string name;
    vec3 eye{0, 0, 1};
    vec3 at{0};
    vec3 up{0, 1, 0};
    float fov_y = 45;  ///< vertical field of view, degrees

    bool operator==(const Camera&) const = default;
};

struct Scene {
    std::vector<BlobId> meshes;
    std::vector<BlobId> textures;
    std::vector<BlobId> shapes;
    std::vector<Object> objects;
    std::vector<Instance> instances;
    std::vector<Material> materials;
    std::vector<Light> lights;
    std::vector<Camera> cameras;
    Environment environment;

    bool operator==(const Scene&) const = default;
};

/// A scene with the blobs it names, and how it moves: what a loader or generator makes.
struct SceneBundle {
    Scene scene;
    BlobStore blobs;
    Motion motion{};  ///< names what it moves, whose names are unique then
};

/// Adds `mesh` to the bundle (a mesh already there is shared); returns its index in Scene::meshes.
std::uint32_t add_mesh(SceneBundle& bundle, const Mesh& mesh);
/// The same for a texture; returns its index in Scene::textures.
std::uint32_t add_texture(SceneBundle& bundle, const Texture& texture);

/// Adds `shape`; returns its index in Scene::shapes, which no other object shares.
std::uint32_t add_shape(SceneBundle& bundle, const Shape& shape);

/// Blobs the scene names, each once, in order.
std::vector<BlobId> blobs_of(const Scene& scene);

/// Throws std::runtime_error naming the first index that points outside its table or value that is
/// not finite. Checks the scene alone, not its blobs.
void validate(const Scene& scene);

}  // namespace tessera
