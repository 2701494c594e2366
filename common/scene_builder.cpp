#include "common/scene_builder.h"

#include <fmt/format.h>

#include <utility>

#include "common/check.h"

namespace tessera {

std::uint32_t add_material(SceneBundle& bundle, Material material) {
    bundle.scene.materials.push_back(std::move(material));
    return std::uint32_t(bundle.scene.materials.size() - 1);
}

std::uint32_t add_object(SceneBundle& bundle, std::string name, const Mesh& mesh,
                         std::vector<std::uint32_t> materials) {
    bundle.scene.objects.push_back({std::move(name), add_mesh(bundle, mesh), std::move(materials)});
    return std::uint32_t(bundle.scene.objects.size() - 1);
}

std::uint32_t add_instance(SceneBundle& bundle, std::string name, std::uint32_t object,
                           const mat4& world_from_object) {
    bundle.scene.instances.push_back({std::move(name), object, world_from_object});
    return std::uint32_t(bundle.scene.instances.size() - 1);
}

std::size_t drop_unused_materials(Scene& scene) {
    std::vector<bool> used(scene.materials.size());
    for (const Object& object : scene.objects)
        for (const std::uint32_t material : object.materials) used[material] = true;
    std::vector<std::uint32_t> new_index(scene.materials.size());
    std::vector<Material> kept;
    for (std::size_t i = 0; i < used.size(); ++i) {
        new_index[i] = std::uint32_t(kept.size());
        if (used[i]) kept.push_back(std::move(scene.materials[i]));
    }
    for (Object& object : scene.objects)
        for (std::uint32_t& material : object.materials) material = new_index[material];
    scene.materials = std::move(kept);
    return used.size() - scene.materials.size();
}

void check_values(const Scene& scene, const std::string& file) {
    try {
        validate(scene);
    } catch (const std::runtime_error& error) {
        throw UserError(fmt::format("{}: {}; correct the file", file, error.what()));
    }
}

}  // namespace tessera
