#include "worker/shaders.h"

#include <dlfcn.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "common/check.h"
#include "worker/solid_texture.h"

namespace tessera {
namespace {

static_assert(sizeof(std::array<float, 3>) == sizeof(float[3]));

using Library = std::shared_ptr<void>;

/// Throws std::runtime_error saying what is wrong.
Library open_library(const std::filesystem::path& file) {
    void* handle = dlopen(file.c_str(), RTLD_NOW | RTLD_LOCAL);
    if (!handle) throw std::runtime_error(dlerror());
    return {handle, [](void* library) { dlclose(library); }};
}

const tessera_shader* shader_of(const Library& library) {
    void* symbol = dlsym(library.get(), TESSERA_SHADER_ENTRY);
    if (!symbol) throw std::runtime_error("it has no function " TESSERA_SHADER_ENTRY);
    const tessera_shader* shader =
        reinterpret_cast<tessera_shader_entry_function>(symbol)();  // POSIX wants dlsym so
    if (!shader) throw std::runtime_error(TESSERA_SHADER_ENTRY " gives no shader");
    if (shader->version != TESSERA_SHADER_VERSION)
        throw std::runtime_error(
            fmt::format("it is made for version {} of tessera_shader.h, this is version {}",
                        shader->version, TESSERA_SHADER_VERSION));
    if (!shader->name || !shader->shade || (shader->parameter_count > 0 && !shader->parameters))
        throw std::runtime_error("its shader lacks a name, parameters or function");
    return shader;
}

std::vector<std::filesystem::path> shared_objects_in(const std::filesystem::path& folder) {
    std::vector<std::filesystem::path> files;
    std::error_code error;
    for (const auto& entry : std::filesystem::directory_iterator(folder, error))
        if (entry.path().extension() == ".so") files.push_back(entry.path());
    if (error) throw UserError(fmt::format("--plugins {}: {}", folder.string(), error.message()));
    std::ranges::sort(files);
    return files;
}

}  // namespace

ShaderTable::ShaderTable() {
    for (const tessera_shader& shader : solid_textures()) shaders_.push_back(&shader);
}

std::vector<std::string> ShaderTable::load(const std::filesystem::path& folder) {
    std::vector<std::string> complaints;
    for (const std::filesystem::path& file : shared_objects_in(folder)) {
        try {
            add(file);
        } catch (const std::runtime_error& e) {
            complaints.push_back(
                fmt::format("shader plug-in {} is left out: {}", file.string(), e.what()));
        }
    }
    return complaints;
}

void ShaderTable::add(const std::filesystem::path& file) {
    Library library = open_library(file);
    shaders_.push_back(shader_of(library));
    libraries_.push_back(std::move(library));
}

const tessera_shader* ShaderTable::find(const std::string& name) const {
    const auto found = std::find_if(shaders_.rbegin(), shaders_.rend(),
                                    [&](const tessera_shader* s) { return s->name == name; });
    return found == shaders_.rend() ? nullptr : *found;
}

std::shared_ptr<const ShaderTable> built_in_shaders() {
    static const auto table = std::make_shared<const ShaderTable>();
    return table;
}

void BoundShader::shade(tessera_shading& point) const {
    tessera_shading next = point;
    shader->shade(reinterpret_cast<const float(*)[3]>(values.data()), &next);
    const float sum = next.base_color[0] + next.base_color[1] + next.base_color[2] +
                      next.roughness + next.metallic + next.specular + next.transmission +
                      next.slope[0] + next.slope[1] + next.slope[2];
    if (std::isfinite(sum)) point = next;
}

BoundShader bind_shader(const ShaderTable& table, const Material& material,
                        std::vector<std::string>& complaints) {
    if (material.shader.empty()) return {};
    BoundShader bound{table.find(material.shader), {}};
    if (!bound.shader) {
        complaints.push_back(fmt::format("shader '{}' of material '{}': a worker does not have it",
                                         material.shader, material.name));
        return bound;
    }
    const std::span known(bound.shader->parameters, bound.shader->parameter_count);
    for (const tessera_shader_parameter& p : known)
        bound.values.push_back({p.value[0], p.value[1], p.value[2]});
    for (const ShaderParameter& p : material.shader_parameters) {
        const auto found =
            std::ranges::find_if(known, [&](const auto& k) { return p.name == k.name; });
        if (found == known.end())
            complaints.push_back(fmt::format("shader '{}' of material '{}' knows no parameter '{}'",
                                             material.shader, material.name, p.name));
        else
            bound.values[std::size_t(found - known.begin())] = {p.value.x, p.value.y, p.value.z};
    }
    return bound;
}

}  // namespace tessera
