#include "server/scene_store.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "common/check.h"

namespace tessera {
namespace {

/// Bytes kept of a viewer's name for a scene, so that the number still fits a message.
constexpr std::size_t longest_stem = 200;

void set_version(StoredScene& stored, SceneVersion version, const BlobStore& blobs) {
    stored.now.scene = std::make_shared<const SceneVersion>(std::move(version));
    stored.now.blobs = blobs;
    stored.bytes = blobs.bytes();
}

}  // namespace

ScenePtr SceneStore::load(const std::string& name, const SceneBundle& bundle) {
    if (find_loaded(name)) throw UserError(fmt::format("two scenes are called '{}'", name));
    loaded_.push_back(add(name, {.version = 1, .scene = bundle.scene}, bundle.blobs));
    return loaded_.back();
}

ScenePtr SceneStore::publish(const ScenePtr& before, const ReadyScene& uploaded) {
    const Scene& scene = uploaded.scene->scene;
    for (const ScenePtr& other : all())
        if (other->now.scene->scene == scene) return other;
    // Held by the viewer's session alone: its argument is a reference to what the session holds.
    if (before && before.use_count() == 1) {
        set_version(*before, {.version = before->now.scene->version + 1, .scene = scene},
                    uploaded.blobs);
        return before;
    }
    const std::string name =
        fmt::format("{}#{}", uploaded.name.substr(0, longest_stem), ++uploads_);
    return add(name, {.version = 1, .scene = scene}, uploaded.blobs);
}

ScenePtr SceneStore::find_loaded(const std::string& name) const {
    const auto found = std::find_if(loaded_.begin(), loaded_.end(),
                                    [&](const ScenePtr& s) { return s->now.name == name; });
    return found == loaded_.end() ? nullptr : *found;
}

std::vector<std::string> SceneStore::loaded_names() const {
    std::vector<std::string> names;
    for (const ScenePtr& scene : loaded_) names.push_back(scene->now.name);
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
