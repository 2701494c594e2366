#include "client/recording.h"

#include <fmt/format.h>

#include <fstream>
#include <map>
#include <nlohmann/json.hpp>

#include "common/check.h"

namespace tessera {
namespace {

template <class T>
std::map<std::string, const T*> by_name(const std::vector<T>& table) {
    std::map<std::string, const T*> out;
    for (const T& entry : table) out[entry.name] = &entry;
    return out;
}

/// Calls `gone`, `come` and `changed` for the entries of a table that differ.
template <class T, class Gone, class Come, class Changed>
void compare(const std::vector<T>& before, const std::vector<T>& after, const Gone& gone,
             const Come& come, const Changed& changed) {
    const auto old = by_name(before), now = by_name(after);
    for (const auto& [name, entry] : old)
        if (!now.contains(name)) gone(*entry);
    for (const auto& [name, entry] : now)
        if (const auto held = old.find(name); held == old.end())
            come(*entry);
        else if (*held->second != *entry)
            changed(*held->second, *entry);
}

template <class T>
std::optional<T> if_changed(const T& before, const T& after) {
    return before == after ? std::nullopt : std::optional(after);
}

std::vector<ShaderParameter> changed(const std::vector<ShaderParameter>& before,
                                     std::vector<ShaderParameter> after) {
    std::erase_if(after,
                  [&](const ShaderParameter& p) { return std::ranges::count(before, p) > 0; });
    return after;
}

std::vector<std::string> material_names(const Object& object, const Scene& scene) {
    std::vector<std::string> names;
    for (const std::uint32_t m : object.materials) names.push_back(scene.materials[m].name);
    return names;
}

CreateInstance creation(const Instance& instance, const Scene& scene) {
    return {.instance = instance.name,
            .object = scene.objects[instance.object].name,
            .world_from_object = instance.world_from_object};
}

}  // namespace

SceneChanges changes_between(const Scene& before, const Scene& after) {
    SceneChanges out;
    std::vector<EditOperation>& edits = out.operations;
    std::vector<EditOperation> deletions;  // of what others may use until they are gone
    compare(
        before.materials, after.materials,
        [&](const Material& m) { deletions.push_back(DeleteMaterial{m.name}); },
        [&](const Material& m) { edits.push_back(CreateMaterial{m}); },
        [&](const Material& was, const Material& is) {
            edits.push_back(SetMaterial{
                .material = is.name,
                .base_color = if_changed(was.base_color, is.base_color),
                .metallic = if_changed(was.metallic, is.metallic),
                .roughness = if_changed(was.roughness, is.roughness),
                .emission = if_changed(was.emission, is.emission),
                .shader = if_changed(was.shader, is.shader),
                .shader_parameters = changed(was.shader_parameters, is.shader_parameters)});
        });
    compare(
        before.objects, after.objects,
        [&](const Object& o) { deletions.insert(deletions.begin(), DeleteObject{o.name}); },
        [&](const Object& o) {
            edits.push_back(CreateObject{o.name, after.meshes[o.mesh], material_names(o, after)});
        },
        [](const Object&, const Object&) {});
    compare(
        before.instances, after.instances,
        [&](const Instance& i) { edits.push_back(DeleteInstance{i.name}); },
        [&](const Instance& i) { edits.push_back(creation(i, after)); },
        [&](const Instance& was, const Instance& is) {
            if (before.objects[was.object].name == after.objects[is.object].name)
                return edits.push_back(SetTransform{is.name, is.world_from_object});
            edits.push_back(DeleteInstance{is.name});
            edits.push_back(creation(is, after));
        });
    compare(
        before.lights, after.lights, [&](const Light& l) { edits.push_back(DeleteLight{l.name}); },
        [&](const Light& l) { edits.push_back(CreateLight{l}); },
        [&](const Light& was, const Light& is) {
            if (was.kind != is.kind) {
                edits.push_back(DeleteLight{is.name});
                return edits.push_back(CreateLight{is});
            }
            edits.push_back(SetLight{.light = is.name,
                                     .position = if_changed(was.position, is.position),
                                     .direction = if_changed(was.direction, is.direction),
                                     .intensity = if_changed(was.intensity, is.intensity),
                                     .inner_angle = if_changed(was.inner_angle, is.inner_angle),
                                     .outer_angle = if_changed(was.outer_angle, is.outer_angle)});
        });
    const auto keep = [&](const Camera& c) { edits.push_back(SetCamera{c}); };
    compare(
        before.cameras, after.cameras,
        [&](const Camera& c) { edits.push_back(DeleteCamera{c.name}); }, keep,
        [&](const Camera&, const Camera& is) { keep(is); });
    if (before.environment != after.environment)
        edits.push_back(SetEnvironment{.radiance = after.environment.radiance,
                                       .rotation = after.environment.rotation});
    edits.insert(edits.end(), deletions.begin(), deletions.end());
    out.shapes = before.shapes != after.shapes;
    return out;
}

/// The last step, or a new one when it is of an earlier time.
TimedEdit& Recorder::step_at(double seconds) {
    if (steps_.empty() || steps_.back().seconds < seconds)
        steps_.push_back({.seconds = seconds, .operations = {}, .view = {}});
    return steps_.back();
}

void Recorder::see(double seconds, const Scene& scene) {
    SceneChanges changes = changes_between(scene_, scene);
    scene_ = scene;
    shapes_ += changes.shapes;
    if (changes.operations.empty()) return;
    std::vector<EditOperation>& operations = step_at(seconds).operations;
    operations.insert(operations.end(), std::make_move_iterator(changes.operations.begin()),
                      std::make_move_iterator(changes.operations.end()));
}

void Recorder::see(double seconds, const Camera& camera) {
    const auto last = std::find_if(steps_.rbegin(), steps_.rend(),
                                   [](const TimedEdit& step) { return step.view.has_value(); });
    if (last == steps_.rend() || *last->view != camera) step_at(seconds).view = camera;
}

void Recorder::save(const std::string& file) const {
    std::ofstream out(file);
    out << "[";
    const char* comma = "\n";
    for (const TimedEdit& step : steps_) out << std::exchange(comma, ",\n") << json_of(step).dump();
    out << "\n]\n";
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", file));
}

}  // namespace tessera
