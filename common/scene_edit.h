// Edits of a scene by name: what a person or a script wants changed, as values. Pure.
//
// Wald's thesis (2004, chapter 10) lets applications change the scene through calls like OpenGL's;
// here an edit is data, so that it travels, is repeated and is tested. Edits that cannot be done
// are complained about and left out; all others happen. They apply in order, so the last value
// wins.
#pragma once

#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "common/scene.h"

namespace tessera {

struct SetTransform {
    std::string instance;
    mat4 world_from_object{1};

    bool operator==(const SetTransform&) const = default;
};
struct CreateInstance {
    std::string instance;  ///< a new name
    std::string object;
    mat4 world_from_object{1};

    bool operator==(const CreateInstance&) const = default;
};
struct DeleteInstance {
    std::string instance;

    bool operator==(const DeleteInstance&) const = default;
};
/// The mesh must be in the scene or at hand, and have a material for each of its slots.
struct CreateObject {
    std::string object;  ///< a new name
    BlobId mesh;
    std::vector<std::string> materials;  ///< of each slot

    bool operator==(const CreateObject&) const = default;
};
/// Not while there is an instance of it.
struct DeleteObject {
    std::string object;

    bool operator==(const DeleteObject&) const = default;
};
struct CreateMaterial {
    Material material;  ///< with a new name; its textures are those of the scene

    bool operator==(const CreateMaterial&) const = default;
};
/// Not while an object has it.
struct DeleteMaterial {
    std::string material;

    bool operator==(const DeleteMaterial&) const = default;
};
/// What is not set stays as it is.
struct SetMaterial {
    std::string material;
    std::optional<vec3> base_color{};
    std::optional<float> metallic{};
    std::optional<float> roughness{};
    std::optional<vec3> emission{};
    std::optional<std::string> shader{};  ///< another one starts with its own parameters
    std::vector<ShaderParameter> shader_parameters{};  ///< others of that shader stay

    bool operator==(const SetMaterial&) const = default;
};
/// What is not set stays as it is.
struct SetLight {
    std::string light;
    std::optional<vec3> position{};
    std::optional<vec3> direction{};  ///< of any length but 0
    std::optional<vec3> intensity{};
    std::optional<float> inner_angle{};
    std::optional<float> outer_angle{};

    bool operator==(const SetLight&) const = default;
};
struct CreateLight {
    Light light;  ///< with a new name

    bool operator==(const CreateLight&) const = default;
};
struct DeleteLight {
    std::string light;

    bool operator==(const DeleteLight&) const = default;
};
/// Replaces the camera of that name, or adds it.
struct SetCamera {
    Camera camera;

    bool operator==(const SetCamera&) const = default;
};
struct DeleteCamera {
    std::string camera;

    bool operator==(const DeleteCamera&) const = default;
};
/// What is not set stays as it is; a picture of it, too.
struct SetEnvironment {
    std::optional<vec3> radiance{};
    std::optional<float> rotation{};

    bool operator==(const SetEnvironment&) const = default;
};

/// Puts an object's vertices elsewhere. The blob must be at hand and a shape for the object's mesh.
struct SetShape {
    std::string object;
    BlobId shape;

    bool operator==(const SetShape&) const = default;
};

using EditOperation =
    std::variant<SetTransform, CreateInstance, DeleteInstance, SetMaterial, SetLight, CreateLight,
                 DeleteLight, SetCamera, SetShape, CreateObject, DeleteObject, CreateMaterial,
                 DeleteMaterial, DeleteCamera, SetEnvironment>;

/// The blob that the operation names, which the scene may not hold yet.
std::optional<BlobId> blob_of(const EditOperation& operation);

struct EditedScene {
    Scene scene;
    std::vector<std::string> complaints;  ///< a sentence for each operation left out
};

/// The scene after these operations. Its names must be unique, and stay so; the result is valid if
/// `scene` is. Instances that are moved or new are marked as moving.
EditedScene apply_edits(Scene scene, const std::vector<EditOperation>& operations);

/// Puts the instance's origin at `to`, turned and scaled as it is.
SetTransform moved(const Instance& instance, const vec3& to);

/// Gives every entry of a table its own name: those without one are called after their table and
/// place, and a number is added to those that are taken.
void make_names_unique(Scene& scene);

}  // namespace tessera
