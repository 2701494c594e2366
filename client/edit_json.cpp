#include "client/edit_json.h"

#include <fmt/format.h>

#include <fstream>
#include <map>
#include <nlohmann/json.hpp>
#include <sstream>

#include "common/check.h"

namespace tessera {
namespace {

using nlohmann::json;

const std::map<std::string, LightKind> light_kinds = {{"point", LightKind::point},
                                                      {"spot", LightKind::spot},
                                                      {"directional", LightKind::directional}};

template <class... Args>
[[noreturn]] void complain(fmt::format_string<Args...> format, Args&&... args) {
    throw UserError(fmt::format(format, std::forward<Args>(args)...));
}

/// Reads fields of an object, and complains of those that nobody has read.
class Fields {
public:
    explicit Fields(const json& object) : object_(object) {
        if (!object.is_object()) complain("{} is no object", object.dump());
    }
    Fields(const Fields&) = delete;

    bool has(const std::string& name) const { return object_.contains(name); }

    void read(const std::string& name, std::string& value) {
        if (const json* found = find(name); found && found->is_string())
            value = found->get<std::string>();
        else if (found)
            complain("`{}` is {}, must be text", name, found->dump());
    }
    void read(const std::string& name, std::optional<float>& value) {
        if (const json* found = find(name)) value = numbers(name, *found, 1)[0];
    }
    void read(const std::string& name, std::optional<vec3>& value) {
        const json* found = find(name);
        if (!found) return;
        const std::vector<float> v = numbers(name, *found, 3);
        value = vec3(v[0], v[1], v[2]);
    }
    void read(const std::string& name, std::optional<mat4>& value) {
        const json* found = find(name);
        if (!found) return;
        const std::vector<float> v = numbers(name, *found, 16);
        value.emplace();
        for (int i = 0; i < 16; ++i) (*value)[i / 4][i % 4] = v[std::size_t(i)];
    }
    template <class T>
    void read(const std::string& name, T& value) {
        std::optional<T> found;
        read(name, found);
        if (found) value = *found;
    }
    const json& at(const std::string& name) {
        const json* found = find(name);
        if (!found) complain("`{}` is missing in {}", name, object_.dump());
        return *found;
    }
    std::string text(const std::string& name) {
        at(name);
        std::string value;
        read(name, value);
        return value;
    }

    /// Fields named shader.NAME: colours, or numbers.
    std::vector<ShaderParameter> shader_parameters() {
        constexpr std::string_view prefix = "shader.";
        std::vector<ShaderParameter> out;
        for (const auto& [name, value] : object_.items()) {
            if (!name.starts_with(prefix)) continue;
            read_[name] = true;
            const std::vector<float> v =
                numbers(name, value, value.is_array() && value.size() > 1 ? 3 : 1);
            out.push_back(
                {name.substr(prefix.size()), v.size() == 3 ? vec3(v[0], v[1], v[2]) : vec3(v[0])});
        }
        return out;
    }

    void check_all_read() const {
        for (const auto& [name, value] : object_.items())
            if (!read_.contains(name)) complain("nobody knows what `{}` is", name);
    }

private:
    const json* find(const std::string& name) {
        read_[name] = true;
        return object_.contains(name) ? &object_.at(name) : nullptr;
    }
    static std::vector<float> numbers(const std::string& name, const json& value,
                                      std::size_t count) {
        std::vector<float> out;
        for (const json& number : value.is_array() ? value : json::array({value})) {
            if (!number.is_number()) complain("`{}` is {}, must be numbers", name, value.dump());
            out.push_back(number.get<float>());
        }
        if (out.size() != count)
            complain("`{}` has {} numbers, must have {}", name, out.size(), count);
        return out;
    }

    const json& object_;
    std::map<std::string, bool> read_;
};

template <class T>
const T* find(const std::vector<T>& table, const std::string& name) {
    const auto found = std::find_if(table.begin(), table.end(),
                                    [&](const T& entry) { return entry.name == name; });
    return found == table.end() ? nullptr : &*found;
}

template <class T>
const T& entry_of(const std::vector<T>& table, const char* kind, const std::string& name) {
    const T* found = find(table, name);
    if (!found) complain("there is no {} '{}'", kind, name);
    return *found;
}

/// Of a material, or of what changes one.
template <class T>
void read_material(Fields& fields, T& material) {
    fields.read("base_color", material.base_color);
    fields.read("metallic", material.metallic);
    fields.read("roughness", material.roughness);
    fields.read("emission", material.emission);
    if (fields.has("shader")) material.shader = fields.text("shader");
    if (auto parameters = fields.shader_parameters(); !parameters.empty())
        material.shader_parameters = std::move(parameters);
}

EditOperation material_of(const std::string& name, const json& values) {
    SetMaterial edit{.material = name};
    Fields fields(values);
    read_material(fields, edit);
    fields.check_all_read();
    return edit;
}

EditOperation new_material_of(Fields& fields, const Scene& scene) {
    Material material;
    if (fields.has("like")) material = entry_of(scene.materials, "material", fields.text("like"));
    material.name = fields.text("create material");
    if (!fields.has("to")) return CreateMaterial{material};
    Fields values(fields.at("to"));
    read_material(values, material);
    values.read("specular", material.specular);
    values.read("ior", material.ior);
    values.read("transmission", material.transmission);
    values.check_all_read();
    return CreateMaterial{material};
}

BlobId blob_id_of(const std::string& hex) {
    BlobId id;
    if (hex.size() != 2 * id.digest.size() ||
        hex.find_first_not_of("0123456789abcdef") != std::string::npos)
        complain("`{}` must be 64 hexadecimal digits", hex);
    for (std::size_t i = 0; i < id.digest.size(); ++i)
        id.digest[i] = std::uint8_t(std::stoul(hex.substr(2 * i, 2), nullptr, 16));
    return id;
}

EditOperation new_object_of(Fields& fields, const Scene& scene) {
    CreateObject edit{.object = fields.text("create object"), .mesh = {}, .materials = {}};
    if (fields.has("mesh")) {
        edit.mesh = blob_id_of(fields.text("mesh"));
    } else {
        const Object& model = entry_of(scene.objects, "object", fields.text("like"));
        edit.mesh = scene.meshes[model.mesh];
        for (const std::uint32_t m : model.materials)
            edit.materials.push_back(scene.materials[m].name);
    }
    if (!fields.has("materials")) return edit;
    edit.materials.clear();
    for (const json& name : fields.at("materials")) {
        if (!name.is_string()) complain("`materials` has {}, must have names", name.dump());
        edit.materials.push_back(name.get<std::string>());
    }
    return edit;
}

EditOperation environment_of(const json& values) {
    SetEnvironment edit;
    Fields fields(values);
    fields.read("radiance", edit.radiance);
    fields.read("rotation", edit.rotation);
    fields.check_all_read();
    return edit;
}

/// Of a light, or of what changes one.
template <class T>
void read_light(Fields& fields, T& light) {
    fields.read("position", light.position);
    fields.read("direction", light.direction);
    fields.read("intensity", light.intensity);
    fields.read("inner_angle", light.inner_angle);
    fields.read("outer_angle", light.outer_angle);
}

EditOperation light_of(const std::string& name, const json& values) {
    SetLight edit{.light = name};
    Fields fields(values);
    read_light(fields, edit);
    fields.check_all_read();
    return edit;
}

EditOperation new_light_of(const std::string& name, const json& values) {
    Light light{.name = name};
    Fields fields(values);
    std::string kind = "point";
    fields.read("kind", kind);
    if (!light_kinds.contains(kind)) complain("light kind `{}`: point, spot or directional", kind);
    light.kind = light_kinds.at(kind);
    read_light(fields, light);
    fields.check_all_read();
    return CreateLight{light};
}

/// What is not told stays as it is.
Camera camera_of(const json& values, Camera camera) {
    Fields fields(values);
    fields.read("eye", camera.eye);
    fields.read("at", camera.at);
    fields.read("up", camera.up);
    fields.read("fov", camera.fov_y);
    fields.check_all_read();
    return camera;
}

EditOperation set_camera_of(const std::string& name, const json& values, const Scene& scene) {
    const Camera* held = find(scene.cameras, name);
    return SetCamera{camera_of(values, held ? *held : Camera{.name = name})};
}

EditOperation set_of(Fields& fields, const Scene& scene) {
    const std::string kind = fields.text("set");
    const json& values = fields.at("to");
    if (kind == "environment") return environment_of(values);
    const std::string name = fields.text("name");
    if (kind == "material") return material_of(name, values);
    if (kind == "light") return light_of(name, values);
    if (kind == "camera") return set_camera_of(name, values, scene);
    complain("cannot set a `{}`: material, light, camera or environment", kind);
}

EditOperation move_of(Fields& fields, const Scene& scene) {
    const std::string name = fields.text("move");
    const Instance& instance = entry_of(scene.instances, "instance", name);
    fields.at("to");
    vec3 to(0);
    fields.read("to", to);
    return moved(instance, to);
}

EditOperation transform_of(Fields& fields) {
    SetTransform edit{.instance = fields.text("transform")};
    fields.at("to");
    fields.read("to", edit.world_from_object);
    return edit;
}

EditOperation create_of(Fields& fields) {
    CreateInstance edit{.instance = fields.text("create"), .object = fields.text("object")};
    if (fields.has("to") && fields.at("to").size() == 16) {
        fields.read("to", edit.world_from_object);
        return edit;
    }
    vec3 to(0);
    fields.read("to", to);
    edit.world_from_object[3] = vec4(to, 1);
    return edit;
}

EditOperation operation_of(Fields& fields, const Scene& scene) {
    if (fields.has("set")) return set_of(fields, scene);
    if (fields.has("move")) return move_of(fields, scene);
    if (fields.has("transform")) return transform_of(fields);
    if (fields.has("create")) return create_of(fields);
    if (fields.has("create light"))
        return new_light_of(fields.text("create light"), fields.at("to"));
    if (fields.has("delete")) return DeleteInstance{fields.text("delete")};
    if (fields.has("delete light")) return DeleteLight{fields.text("delete light")};
    if (fields.has("create object")) return new_object_of(fields, scene);
    if (fields.has("delete object")) return DeleteObject{fields.text("delete object")};
    if (fields.has("create material")) return new_material_of(fields, scene);
    if (fields.has("delete material")) return DeleteMaterial{fields.text("delete material")};
    if (fields.has("delete camera")) return DeleteCamera{fields.text("delete camera")};
    complain(
        "no edit: set, move, transform, create or delete is wanted, the last two with nothing, "
        "object, material, light or camera behind them");
}

json parse_file(const std::string& file) {
    std::ifstream in(file);
    if (!in) complain("{}: cannot be read", file);
    json parsed = json::parse(in, nullptr, false);
    if (!parsed.is_array()) complain("{}: is no JSON list of timed edits", file);
    return parsed;
}

TimedEdit timed_edit_of(const json& entry, Scene& scene) {
    Fields fields(entry);
    TimedEdit timed;
    std::optional<float> seconds;
    fields.read("time", seconds);
    timed.seconds = seconds.value_or(0);
    if (fields.has("view")) timed.view = camera_of(fields.at("view"), {});
    if (!fields.has("edits") && timed.view) {
        fields.check_all_read();
        return timed;
    }
    for (const json& edit : fields.at("edits")) {
        timed.operations.push_back(operation_of_json(edit, scene));
        EditedScene edited = apply_edits(std::move(scene), {timed.operations.back()});
        if (!edited.complaints.empty()) throw UserError(edited.complaints.front());
        scene = std::move(edited.scene);
    }
    fields.check_all_read();
    return timed;
}

}  // namespace

EditOperation operation_of_json(const json& object, const Scene& scene) {
    Fields fields(object);
    EditOperation operation = operation_of(fields, scene);
    fields.check_all_read();
    return operation;
}

json value_of_text(const std::string& text) {
    json list = json::array();
    std::istringstream in(text);
    for (std::string part; std::getline(in, part, ',');) {
        json number = json::parse(part, nullptr, false);
        if (!number.is_number()) return text;
        list.push_back(number);
    }
    if (list.empty()) return text;
    return list;
}

std::vector<TimedEdit> load_timed_edits(const std::string& file, Scene scene) {
    const json parsed = parse_file(file);
    std::vector<TimedEdit> out;
    double now = 0;
    std::size_t number = 0;
    try {
        for (const json& entry : parsed) {
            ++number;
            out.push_back(timed_edit_of(entry, scene));
            if (out.back().seconds < now) complain("its time is before that of the one before");
            now = out.back().seconds;
        }
    } catch (const UserError& error) {
        complain("{}: entry {}: {}", file, number, error.what());
    }
    return out;
}

const char* light_kind_name(LightKind kind) {
    for (const auto& [name, value] : light_kinds)
        if (value == kind) return name.c_str();
    return "light";
}

json json_of(const vec3& v) { return {v.x, v.y, v.z}; }

json json_of(const Material& m) {
    return {
        {"name", m.name},           {"base_color", json_of(m.base_color)}, {"metallic", m.metallic},
        {"roughness", m.roughness}, {"emission", json_of(m.emission)},     {"shader", m.shader}};
}

json json_of(const Camera& c) {
    return {{"name", c.name},
            {"eye", json_of(c.eye)},
            {"at", json_of(c.at)},
            {"up", json_of(c.up)},
            {"fov", c.fov_y}};
}

json json_of(const Scene& scene) {
    json out = {{"objects", json::array()},
                {"instances", json::array()},
                {"materials", json::array()},
                {"lights", json::array()},
                {"cameras", json::array()}};
    for (const Object& o : scene.objects) out["objects"].push_back({{"name", o.name}});
    for (const Instance& i : scene.instances) {
        const float* m = &i.world_from_object[0][0];
        out["instances"].push_back({{"name", i.name},
                                    {"object", scene.objects[i.object].name},
                                    {"world_from_object", std::vector<float>(m, m + 16)}});
    }
    for (const Material& m : scene.materials) out["materials"].push_back(json_of(m));
    for (const Light& l : scene.lights)
        out["lights"].push_back({{"name", l.name},
                                 {"kind", light_kind_name(l.kind)},
                                 {"position", json_of(l.position)},
                                 {"direction", json_of(l.direction)},
                                 {"intensity", json_of(l.intensity)},
                                 {"inner_angle", l.inner_angle},
                                 {"outer_angle", l.outer_angle}});
    for (const Camera& c : scene.cameras) out["cameras"].push_back(json_of(c));
    out["environment"] = {{"radiance", json_of(scene.environment.radiance)},
                          {"rotation", scene.environment.rotation}};
    return out;
}

namespace {

std::vector<float> numbers_of(const mat4& m) { return {&m[0][0], &m[0][0] + 16}; }

template <class T>
void set(json& fields, const char* name, const std::optional<T>& value) {
    if (!value) return;
    if constexpr (std::is_same_v<T, vec3>)
        fields[name] = json_of(*value);
    else
        fields[name] = *value;
}

json fields_of(const Camera& c) {
    json out = json_of(c);
    out.erase("name");
    return out;
}

json fields_of(const Light& l) {
    return {{"kind", light_kind_name(l.kind)},   {"position", json_of(l.position)},
            {"direction", json_of(l.direction)}, {"intensity", json_of(l.intensity)},
            {"inner_angle", l.inner_angle},      {"outer_angle", l.outer_angle}};
}

json write(const SetTransform& e) {
    return {{"transform", e.instance}, {"to", numbers_of(e.world_from_object)}};
}
json write(const CreateInstance& e) {
    return {{"create", e.instance}, {"object", e.object}, {"to", numbers_of(e.world_from_object)}};
}
json write(const DeleteInstance& e) { return {{"delete", e.instance}}; }
void set(json& fields, const std::vector<ShaderParameter>& parameters) {
    for (const ShaderParameter& p : parameters) fields["shader." + p.name] = json_of(p.value);
}
json write(const SetMaterial& e) {
    json to = json::object();
    set(to, "base_color", e.base_color);
    set(to, "metallic", e.metallic);
    set(to, "roughness", e.roughness);
    set(to, "emission", e.emission);
    set(to, "shader", e.shader);
    set(to, e.shader_parameters);
    return {{"set", "material"}, {"name", e.material}, {"to", to}};
}
json write(const SetLight& e) {
    json to = json::object();
    set(to, "position", e.position);
    set(to, "direction", e.direction);
    set(to, "intensity", e.intensity);
    set(to, "inner_angle", e.inner_angle);
    set(to, "outer_angle", e.outer_angle);
    return {{"set", "light"}, {"name", e.light}, {"to", to}};
}
json write(const CreateLight& e) {
    return {{"create light", e.light.name}, {"to", fields_of(e.light)}};
}
json write(const DeleteLight& e) { return {{"delete light", e.light}}; }
json write(const SetCamera& e) {
    return {{"set", "camera"}, {"name", e.camera.name}, {"to", fields_of(e.camera)}};
}
json write(const CreateObject& e) {
    return {{"create object", e.object}, {"mesh", full_name(e.mesh)}, {"materials", e.materials}};
}
json write(const DeleteObject& e) { return {{"delete object", e.object}}; }
json write(const CreateMaterial& e) {
    json to = json_of(e.material);
    to.erase("name");
    to["specular"] = e.material.specular;
    to["ior"] = e.material.ior;
    to["transmission"] = e.material.transmission;
    set(to, e.material.shader_parameters);
    return {{"create material", e.material.name}, {"to", to}};
}
json write(const DeleteMaterial& e) { return {{"delete material", e.material}}; }
json write(const DeleteCamera& e) { return {{"delete camera", e.camera}}; }
json write(const SetEnvironment& e) {
    json to = json::object();
    set(to, "radiance", e.radiance);
    set(to, "rotation", e.rotation);
    return {{"set", "environment"}, {"to", to}};
}
json write(const SetShape& e) { complain("the vertices of '{}' cannot be written", e.object); }

}  // namespace

json json_of(const EditOperation& operation) {
    return std::visit([](const auto& edit) { return write(edit); }, operation);
}

json json_of(const TimedEdit& edit) {
    json out = {{"time", edit.seconds}};
    if (edit.view) out["view"] = fields_of(*edit.view);
    for (const EditOperation& operation : edit.operations)
        out["edits"].push_back(json_of(operation));
    if (!edit.view && edit.operations.empty()) out["edits"] = json::array();
    return out;
}

}  // namespace tessera
