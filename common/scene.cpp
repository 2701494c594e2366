#include "common/scene.h"

#include <fmt/format.h>

#include <algorithm>
#include <set>
#include <stdexcept>

namespace tessera {
namespace {

std::uint32_t index_of(std::vector<BlobId>& table, const BlobId& id) {
    const auto index = std::uint32_t(std::find(table.begin(), table.end(), id) - table.begin());
    if (index == table.size()) table.push_back(id);
    return index;
}

void require(bool good, const char* what, std::size_t index, const char* problem) {
    if (!good) throw std::runtime_error(fmt::format("{} {}: {}", what, index, problem));
}

bool is_finite(const TextureMap& m) {
    return std::isfinite(m.offset.x) && std::isfinite(m.offset.y) && std::isfinite(m.scale.x) &&
           std::isfinite(m.scale.y) && std::isfinite(m.rotation);
}

bool is_finite(const mat4& m) {
    for (int column = 0; column < 4; ++column)
        for (int row = 0; row < 4; ++row)
            if (!std::isfinite(m[column][row])) return false;
    return true;
}

void validate_material(const Scene& scene, std::size_t i) {
    const Material& m = scene.materials[i];
    for (const TextureMap* map : {&m.base_color_map, &m.metallic_roughness_map, &m.transmission_map,
                                  &m.emission_map, &m.normal_map}) {
        require(map->texture >= -1 && map->texture < std::int64_t(scene.textures.size()),
                "material", i, "texture index out of range");
        require(is_finite(*map), "material", i, "texture transform is not finite");
    }
    require(tessera::is_finite(m.base_color) && tessera::is_finite(m.emission) &&
                std::isfinite(m.metallic) && std::isfinite(m.roughness) &&
                std::isfinite(m.specular) && std::isfinite(m.transmission) &&
                std::isfinite(m.normal_scale) && std::isfinite(m.alpha) &&
                std::isfinite(m.alpha_cutoff),
            "material", i, "values are not finite");
    require(m.shader_parameters.size() <= most_shader_parameters, "material", i,
            "too many parameters for a shader");
    for (const ShaderParameter& p : m.shader_parameters)
        require(tessera::is_finite(p.value), "material", i, "a shader's parameter is not finite");
    require(m.ior >= 1 && std::isfinite(m.ior), "material", i, "index of refraction is below 1");
}

}  // namespace

std::uint32_t add_mesh(SceneBundle& bundle, const Mesh& mesh) {
    return index_of(bundle.scene.meshes, bundle.blobs.insert(encode(mesh)));
}

std::uint32_t add_texture(SceneBundle& bundle, const Texture& texture) {
    return index_of(bundle.scene.textures, bundle.blobs.insert(encode(texture)));
}

std::uint32_t add_shape(SceneBundle& bundle, const Shape& shape) {
    bundle.scene.shapes.push_back(bundle.blobs.insert(encode(shape)));
    return std::uint32_t(bundle.scene.shapes.size() - 1);
}

std::vector<BlobId> blobs_of(const Scene& scene) {
    std::set<BlobId> ids(scene.meshes.begin(), scene.meshes.end());
    ids.insert(scene.textures.begin(), scene.textures.end());
    ids.insert(scene.shapes.begin(), scene.shapes.end());
    return {ids.begin(), ids.end()};
}

void validate(const Scene& scene) {
    for (std::size_t i = 0; i < scene.materials.size(); ++i) validate_material(scene, i);
    for (std::size_t i = 0; i < scene.objects.size(); ++i) {
        const Object& object = scene.objects[i];
        require(object.mesh < scene.meshes.size(), "object", i, "mesh index out of range");
        require(object.shape >= -1 && object.shape < std::int64_t(scene.shapes.size()), "object", i,
                "shape index out of range");
        for (const std::uint32_t material : object.materials)
            require(material < scene.materials.size(), "object", i, "material index out of range");
    }
    for (std::size_t i = 0; i < scene.instances.size(); ++i) {
        const Instance& instance = scene.instances[i];
        require(instance.object < scene.objects.size(), "instance", i, "object index out of range");
        require(is_finite(instance.world_from_object), "instance", i, "transform is not finite");
    }
    for (std::size_t i = 0; i < scene.lights.size(); ++i) {
        const Light& light = scene.lights[i];
        require(tessera::is_finite(light.position) && tessera::is_finite(light.direction) &&
                    tessera::is_finite(light.intensity) && std::isfinite(light.inner_angle) &&
                    std::isfinite(light.outer_angle),
                "light", i, "values are not finite");
    }
    for (std::size_t i = 0; i < scene.cameras.size(); ++i) {
        const Camera& camera = scene.cameras[i];
        require(tessera::is_finite(camera.eye) && tessera::is_finite(camera.at) &&
                    tessera::is_finite(camera.up) && std::isfinite(camera.fov_y),
                "camera", i, "values are not finite");
    }
    const Environment& environment = scene.environment;
    require(environment.texture >= -1 &&
                environment.texture < std::int64_t(scene.textures.size()) &&
                tessera::is_finite(environment.radiance) && std::isfinite(environment.rotation),
            "environment", 0, "texture index is out of range or values are not finite");
}

}  // namespace tessera
