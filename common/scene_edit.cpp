#include "common/scene_edit.h"

#include <fmt/format.h>

#include <algorithm>
#include <stdexcept>
#include <unordered_map>

namespace tessera {
namespace {

/// One table of a scene by name. Kept as long as nothing is deleted.
template <class T>
class NamedTable {
public:
    NamedTable(const char* kind, std::vector<T>& entries) : kind_(kind), entries_(entries) {}

    std::optional<std::uint32_t> find(const std::string& name) {
        if (index_.empty())
            for (std::uint32_t i = 0; i < entries_.size(); ++i) index_[entries_[i].name] = i;
        const auto found = index_.find(name);
        return found == index_.end() ? std::nullopt : std::optional(found->second);
    }
    /// Throws std::runtime_error when there is none of that name.
    std::uint32_t index(const std::string& name) {
        const auto found = find(name);
        if (!found) throw std::runtime_error(fmt::format("there is no {} '{}'", kind_, name));
        return *found;
    }
    T& at(const std::string& name) { return entries_[index(name)]; }

    /// Throws std::runtime_error when the name is taken.
    void add(T entry) {
        if (entry.name.empty())
            throw std::runtime_error(fmt::format("the new {} needs a name", kind_));
        if (find(entry.name))
            throw std::runtime_error(fmt::format("the {} '{}' exists already", kind_, entry.name));
        index_[entry.name] = std::uint32_t(entries_.size());
        entries_.push_back(std::move(entry));
    }

    /// The last entry takes the place, so that the difference is small.
    void remove(const std::string& name) {
        const std::uint32_t place = index(name);
        if (place + 1 < entries_.size()) entries_[place] = std::move(entries_.back());
        entries_.pop_back();
        index_.clear();
    }
    /// The same, when others point into the table: those at its end follow it to its new place.
    /// Throws std::runtime_error when one points to what shall go.
    template <class References>
    void remove(const std::string& name, const References& references) {
        const std::uint32_t place = index(name), last = std::uint32_t(entries_.size() - 1);
        if (std::ranges::count(references, place, [](auto* r) { return *r; }) > 0)
            throw std::runtime_error(fmt::format("the {} '{}' is in use", kind_, name));
        for (auto* reference : references)
            if (*reference == last) *reference = place;
        remove(name);
    }

private:
    const char* kind_;
    std::vector<T>& entries_;
    std::unordered_map<std::string, std::uint32_t> index_;  ///< empty until asked for
};

void require(bool good, const char* problem) {
    if (!good) throw std::runtime_error(problem);
}

bool within(const vec3& v, float low, float high) {
    return is_finite(v) && std::min({v.x, v.y, v.z}) >= low && max_component(v) <= high;
}
bool within(float v, float low, float high) { return v >= low && v <= high; }

void require_affine(const mat4& m) {
    for (int column = 0; column < 4; ++column)
        require(is_finite(vec3(m[column])) && m[column].w == (column == 3 ? 1.0f : 0.0f),
                "the transform is not affine");
}

void require_valid(const Material& m) {
    require(within(m.base_color, 0, 1), "base_color must be 0 to 1");
    require(within(m.metallic, 0, 1), "metallic must be 0 to 1");
    require(within(m.roughness, 0, 1), "roughness must be 0 to 1");
    require(within(m.emission, 0, std::numeric_limits<float>::max()),
            "emission must not be negative");
    require(m.shader_parameters.size() <= most_shader_parameters,
            "the shader has too many parameters");
    for (const ShaderParameter& p : m.shader_parameters)
        require(is_finite(p.value), "a shader's parameters must be finite");
}

void require_valid(const Light& l) {
    require(is_finite(l.position), "position must be finite");
    require(is_finite(l.direction) && dot(l.direction, l.direction) > 0,
            "direction must not be zero");
    require(within(l.intensity, 0, std::numeric_limits<float>::max()),
            "intensity must not be negative");
    require(within(l.inner_angle, 0, l.outer_angle) && l.outer_angle <= pi,
            "angles must be 0 <= inner_angle <= outer_angle <= pi");
}

void require_valid(const Camera& c) {
    const vec3 view = c.at - c.eye;
    require(is_finite(c.eye) && is_finite(c.at) && is_finite(c.up), "camera must be finite");
    require(length(cross(view, c.up)) > 1e-6f * length(view) * length(c.up),
            "the camera looks along its own up direction or nowhere");
    require(c.fov_y > 0 && c.fov_y < 180, "fov_y must be more than 0 and less than 180 degrees");
}

template <class T>
void set(T& field, const std::optional<T>& value) {
    if (value) field = *value;
}

void set(Material& material, const ShaderParameter& parameter) {
    auto& all = material.shader_parameters;
    const auto found = std::ranges::find(all, parameter.name, &ShaderParameter::name);
    if (found != all.end())
        found->value = parameter.value;
    else
        all.push_back(parameter);
}

/// A scene being edited. Each call of `apply` changes all that it says or throws
/// std::runtime_error and changes nothing.
class Editor {
public:
    explicit Editor(Scene& scene)
        : scene_(scene),
          objects_("object", scene.objects),
          instances_("instance", scene.instances),
          materials_("material", scene.materials),
          lights_("light", scene.lights),
          cameras_("camera", scene.cameras) {}

    void apply(const SetTransform& edit) {
        require_affine(edit.world_from_object);
        Instance& instance = instances_.at(edit.instance);
        if (instance.world_from_object == edit.world_from_object) return;
        instance.world_from_object = edit.world_from_object;
        instance.moves = true;
    }

    void apply(const CreateInstance& edit) {
        require_affine(edit.world_from_object);
        instances_.add({.name = edit.instance,
                        .object = objects_.index(edit.object),
                        .world_from_object = edit.world_from_object,
                        .moves = true});
    }

    void apply(const DeleteInstance& edit) { instances_.remove(edit.instance); }

    void apply(const CreateObject& edit) {
        require(!edit.materials.empty(), "the new object needs a material");
        Object object{.name = edit.object, .mesh = mesh_index(edit.mesh), .materials = {}};
        for (const std::string& material : edit.materials)
            object.materials.push_back(materials_.index(material));
        objects_.add(object);
        if (object.mesh == scene_.meshes.size()) scene_.meshes.push_back(edit.mesh);
    }

    void apply(const DeleteObject& edit) {
        std::vector<std::uint32_t*> references;
        for (Instance& instance : scene_.instances) references.push_back(&instance.object);
        const Object object = objects_.at(edit.object);
        objects_.remove(edit.object, references);
        drop_if_unused(scene_.meshes, object.mesh, &Object::mesh);
        if (object.shape >= 0) drop_if_unused(scene_.shapes, object.shape, &Object::shape);
    }

    void apply(const CreateMaterial& edit) {
        const Material& m = edit.material;
        require_valid(m);
        require(within(m.specular, 0, 1) && within(m.transmission, 0, 1) && within(m.alpha, 0, 1),
                "specular, transmission and alpha must be 0 to 1");
        Scene alone;
        alone.textures = scene_.textures;
        alone.materials = {m};
        validate(alone);
        materials_.add(m);
    }

    void apply(const DeleteMaterial& edit) {
        std::vector<std::uint32_t*> references;
        for (Object& object : scene_.objects)
            for (std::uint32_t& material : object.materials) references.push_back(&material);
        materials_.remove(edit.material, references);
    }

    void apply(const SetMaterial& edit) {
        Material& held = materials_.at(edit.material);
        Material material = held;
        set(material.base_color, edit.base_color);
        set(material.metallic, edit.metallic);
        set(material.roughness, edit.roughness);
        set(material.emission, edit.emission);
        if (edit.shader && *edit.shader != material.shader) material.shader_parameters.clear();
        set(material.shader, edit.shader);
        for (const ShaderParameter& p : edit.shader_parameters) set(material, p);
        require_valid(material);
        held = std::move(material);
    }

    void apply(const SetLight& edit) {
        Light& held = lights_.at(edit.light);
        Light light = held;
        set(light.position, edit.position);
        set(light.direction, edit.direction);
        set(light.intensity, edit.intensity);
        set(light.inner_angle, edit.inner_angle);
        set(light.outer_angle, edit.outer_angle);
        require_valid(light);
        light.direction = normalize(light.direction);
        held = std::move(light);
    }

    void apply(const CreateLight& edit) {
        require_valid(edit.light);
        Light light = edit.light;
        light.direction = normalize(light.direction);
        lights_.add(std::move(light));
    }

    void apply(const DeleteLight& edit) { lights_.remove(edit.light); }

    void apply(const SetCamera& edit) {
        require_valid(edit.camera);
        if (cameras_.find(edit.camera.name))
            cameras_.at(edit.camera.name) = edit.camera;
        else
            cameras_.add(edit.camera);
    }

    void apply(const DeleteCamera& edit) { cameras_.remove(edit.camera); }

    void apply(const SetEnvironment& edit) {
        Environment environment = scene_.environment;
        set(environment.radiance, edit.radiance);
        set(environment.rotation, edit.rotation);
        require(within(environment.radiance, 0, std::numeric_limits<float>::max()),
                "the environment's radiance must not be negative");
        require(std::isfinite(environment.rotation), "the environment's rotation must be finite");
        scene_.environment = environment;
    }

    void apply(const SetShape& edit) {
        Object& object = objects_.at(edit.object);
        const auto uses = [&](const Object& other) { return other.shape == object.shape; };
        if (object.shape >= 0 && std::ranges::count_if(scene_.objects, uses) == 1) {
            scene_.shapes[std::size_t(object.shape)] = edit.shape;
        } else {
            object.shape = std::int32_t(scene_.shapes.size());
            scene_.shapes.push_back(edit.shape);
        }
    }

private:
    /// Of that mesh; of the one to be added, when it is new.
    std::uint32_t mesh_index(const BlobId& mesh) const {
        return std::uint32_t(std::ranges::find(scene_.meshes, mesh) - scene_.meshes.begin());
    }

    /// The last blob takes the place.
    template <class Index>
    void drop_if_unused(std::vector<BlobId>& table, Index place, Index Object::*index) {
        if (std::ranges::count(scene_.objects, place, index) > 0) return;
        const auto last = Index(table.size() - 1);
        for (Object& object : scene_.objects)
            if (object.*index == last) object.*index = place;
        table[std::size_t(place)] = table.back();
        table.pop_back();
    }

    Scene& scene_;
    NamedTable<Object> objects_;
    NamedTable<Instance> instances_;
    NamedTable<Material> materials_;
    NamedTable<Light> lights_;
    NamedTable<Camera> cameras_;
};

template <class T>
void make_unique(const char* kind, std::vector<T>& entries) {
    std::unordered_map<std::string, int> copies;  // of each name so far
    for (std::size_t i = 0; i < entries.size(); ++i) {
        std::string& name = entries[i].name;
        if (name.empty()) name = fmt::format("{} {}", kind, i);
        const std::string stem = name;
        while (copies.contains(name)) name = fmt::format("{} ({})", stem, ++copies[stem]);
        copies[name] = 1;
    }
}

/// What is wrong with the operation, or nothing.
std::optional<std::string> complaint_about(const EditOperation& operation, Editor& editor) {
    try {
        std::visit([&](const auto& edit) { editor.apply(edit); }, operation);
        return std::nullopt;
    } catch (const std::runtime_error& complaint) {
        return complaint.what();
    }
}

}  // namespace

std::optional<BlobId> blob_of(const EditOperation& operation) {
    if (const auto* shaped = std::get_if<SetShape>(&operation)) return shaped->shape;
    if (const auto* created = std::get_if<CreateObject>(&operation)) return created->mesh;
    return std::nullopt;
}

EditedScene apply_edits(Scene scene, const std::vector<EditOperation>& operations) {
    EditedScene out{.scene = std::move(scene), .complaints = {}};
    Editor editor(out.scene);
    for (const EditOperation& operation : operations)
        if (auto complaint = complaint_about(operation, editor))
            out.complaints.push_back(std::move(*complaint));
    return out;
}

SetTransform moved(const Instance& instance, const vec3& to) {
    SetTransform edit{.instance = instance.name, .world_from_object = instance.world_from_object};
    edit.world_from_object[3] = vec4(to, 1);
    return edit;
}

void make_names_unique(Scene& scene) {
    make_unique("object", scene.objects);
    make_unique("instance", scene.instances);
    make_unique("material", scene.materials);
    make_unique("light", scene.lights);
    make_unique("camera", scene.cameras);
}

}  // namespace tessera
