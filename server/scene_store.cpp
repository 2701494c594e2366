#include "server/scene_store.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "common/check.h"

namespace tessera {
namespace {

/// Bytes kept of a viewer's name for a scene, so that the number still fits a message.
constexpr std::size_t longest_stem = 200;
/// Open scenes stay, so viewers may not make them without end.
constexpr std::size_t most_open = 64;

void set_version(StoredScene& stored, SceneVersion version, const BlobStore& blobs) {
    stored.now.scene = std::make_shared<const SceneVersion>(std::move(version));
    stored.now.blobs = blobs;
    stored.bytes = blobs.bytes();
}

/// Whether the shape is one for the mesh of its object. An object that is not there is complained
/// of elsewhere.
bool fits(const SetShape& edit, const Scene& scene, const BlobStore& blobs) {
    const auto object = std::ranges::find(scene.objects, edit.object, &Object::name);
    if (object == scene.objects.end()) return true;
    const auto mesh = blobs.find(scene.meshes[object->mesh]), shape = blobs.find(edit.shape);
    if (!mesh || !shape) return false;
    try {
        return decode_shape(*shape).positions.size() == vertex_count(*mesh);
    } catch (const std::runtime_error&) {
        return false;
    }
}

}  // namespace

ScenePtr SceneStore::open(const std::string& name, Scene scene, const BlobStore& blobs) {
    if (is_taken(name)) throw UserError(fmt::format("two scenes are called '{}'", name));
    if (open_.size() >= most_open)
        throw UserError(fmt::format("the server holds {} open scenes already", most_open));
    make_names_unique(scene);
    open_.push_back(add(name, {.version = 1, .scene = std::move(scene)}, blobs));
    return open_.back();
}

ScenePtr SceneStore::publish(const ScenePtr& before, const ReadyScene& uploaded) {
    const Scene& scene = uploaded.scene->scene;
    for (const ScenePtr& other : all())
        if (other->now.scene->scene == scene && !is_open(other)) return other;
    // Held by the viewer's session alone: its argument is a reference to what the session holds.
    if (before && before.use_count() == 1) {
        set_version(*before, {.version = before->now.scene->version + 1, .scene = scene},
                    uploaded.blobs);
        return before;
    }
    const auto numbered = [&] {
        return fmt::format("{}#{}", uploaded.name.substr(0, longest_stem), ++uploads_);
    };
    std::string name = numbered();
    while (is_taken(name)) name = numbered();
    return add(name, {.version = 1, .scene = scene}, uploaded.blobs);
}

std::vector<std::string> SceneStore::edit(const ScenePtr& scene,
                                          const std::vector<EditOperation>& operations,
                                          const BlobStore& brought) {
    const SceneVersion& now = *scene->now.scene;
    BlobStore blobs = scene->now.blobs;
    blobs.merge(brought);
    std::vector<std::string> complaints;
    std::vector<EditOperation> possible = operations;
    std::erase_if(possible, [&](const EditOperation& operation) {
        const auto* edit = std::get_if<SetShape>(&operation);
        if (!edit || fits(*edit, now.scene, blobs)) return false;
        complaints.push_back(fmt::format("'{}': that is no shape for it", edit->object));
        return true;
    });
    EditedScene edited = apply_edits(now.scene, possible);
    std::ranges::move(edited.complaints, std::back_inserter(complaints));
    if (edited.scene == now.scene) return complaints;
    blobs.keep_only(blobs_of(edited.scene));
    set_version(*scene, {.version = now.version + 1, .scene = std::move(edited.scene)}, blobs);
    const auto watchers = scene->watchers;  // they may come and go as they hear of it
    for (const auto& [who, tell] : watchers) tell();
    return complaints;
}

bool SceneStore::is_taken(const std::string& name) const {
    const std::vector<ScenePtr> scenes = all();
    return std::any_of(scenes.begin(), scenes.end(),
                       [&](const ScenePtr& s) { return s->now.name == name; });
}

bool SceneStore::is_open(const ScenePtr& scene) const {
    return std::find(open_.begin(), open_.end(), scene) != open_.end();
}

ScenePtr SceneStore::find_open(const std::string& name) const {
    const auto found = std::find_if(open_.begin(), open_.end(),
                                    [&](const ScenePtr& s) { return s->now.name == name; });
    return found == open_.end() ? nullptr : *found;
}

std::vector<std::string> SceneStore::open_names() const {
    std::vector<std::string> names;
    for (const ScenePtr& scene : open_) names.push_back(scene->now.name);
    return names;
}

std::vector<ScenePtr> SceneStore::all() const {
    std::vector<ScenePtr> out;
    for (const auto& weak : scenes_)
        if (ScenePtr scene = weak.lock()) out.push_back(std::move(scene));
    return out;
}

ScenePtr SceneStore::add(const std::string& name, SceneVersion version, const BlobStore& blobs) {
    std::erase_if(scenes_, [](const auto& weak) { return weak.expired(); });
    const auto stored = std::make_shared<StoredScene>();
    stored->now.name = name;
    set_version(*stored, std::move(version), blobs);
    scenes_.push_back(stored);
    return stored;
}

}  // namespace tessera
