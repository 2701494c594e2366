#include "common/scene_delta.h"

#include <fmt/format.h>

#include <stdexcept>

namespace tessera {
namespace {

template <class T>
TableDelta<T> diff_table(const std::vector<T>& base, const std::vector<T>& next) {
    TableDelta<T> delta{.size = std::uint32_t(next.size()), .changed = {}};
    for (std::uint32_t i = 0; i < next.size(); ++i)
        if (i >= base.size() || base[i] != next[i]) delta.changed.emplace_back(i, next[i]);
    return delta;
}

template <class T>
std::vector<T> apply_table(const char* name, const std::vector<T>& base,
                           const TableDelta<T>& delta) {
    // New entries must all be set, so a table can only grow by what the delta itself carries.
    const std::size_t known = std::min<std::size_t>(base.size(), delta.size);
    if (delta.size - known > delta.changed.size())
        throw std::runtime_error(fmt::format("delta leaves new {} unset", name));
    std::vector<T> next(base.begin(), base.begin() + known);
    next.resize(delta.size);
    std::vector<bool> set(delta.size - known);
    for (const auto& [index, value] : delta.changed) {
        if (index >= delta.size)
            throw std::runtime_error(
                fmt::format("delta names {} {} of {}", name, index, delta.size));
        next[index] = value;
        if (index >= known) set[index - known] = true;
    }
    if (std::find(set.begin(), set.end(), false) != set.end())
        throw std::runtime_error(fmt::format("delta leaves new {} unset", name));
    return next;
}

}  // namespace

SceneDelta diff(const SceneVersion& base, const SceneVersion& next) {
    return {.base_version = base.version,
            .next_version = next.version,
            .meshes = diff_table(base.scene.meshes, next.scene.meshes),
            .textures = diff_table(base.scene.textures, next.scene.textures),
            .shapes = diff_table(base.scene.shapes, next.scene.shapes),
            .objects = diff_table(base.scene.objects, next.scene.objects),
            .instances = diff_table(base.scene.instances, next.scene.instances),
            .materials = diff_table(base.scene.materials, next.scene.materials),
            .lights = diff_table(base.scene.lights, next.scene.lights),
            .cameras = diff_table(base.scene.cameras, next.scene.cameras),
            .environment = next.scene.environment};
}

SceneVersion apply(const SceneVersion& base, const SceneDelta& delta) {
    if (delta.base_version != base.version)
        throw std::runtime_error(fmt::format("delta starts at version {}, the scene is at {}",
                                             delta.base_version, base.version));
    SceneVersion next{
        .version = delta.next_version,
        .scene = {.meshes = apply_table("meshes", base.scene.meshes, delta.meshes),
                  .textures = apply_table("textures", base.scene.textures, delta.textures),
                  .shapes = apply_table("shapes", base.scene.shapes, delta.shapes),
                  .objects = apply_table("objects", base.scene.objects, delta.objects),
                  .instances = apply_table("instances", base.scene.instances, delta.instances),
                  .materials = apply_table("materials", base.scene.materials, delta.materials),
                  .lights = apply_table("lights", base.scene.lights, delta.lights),
                  .cameras = apply_table("cameras", base.scene.cameras, delta.cameras),
                  .environment = delta.environment}};
    validate(next.scene);
    return next;
}

}  // namespace tessera
