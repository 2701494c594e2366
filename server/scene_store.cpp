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

void set_version(StoredScene& stored, std::shared_ptr<const SceneVersion> version,
                 const BlobStore& blobs) {
    stored.now.scene = std::move(version);
    stored.now.blobs = blobs;
    stored.bytes = blobs.bytes();
}

}  // namespace

void SceneStore::reserve(const std::string& name) {
    if (is_taken(name)) throw UserError(fmt::format("two scenes are called '{}'", name));
    if (open_.size() + reserved_.size() >= most_open)
        throw UserError(fmt::format("the server holds {} open scenes already", most_open));
    reserved_.insert(name);
}

ScenePtr SceneStore::open(const ReadyScene& scene) {
    CHECK(reserved_.erase(scene.name) == 1);
    open_.push_back(add(scene));
    return open_.back();
}

ScenePtr SceneStore::publish(const ScenePtr& before, const ReadyScene& uploaded) {
    const Scene& scene = uploaded.scene->scene;
    for (const ScenePtr& other : all())
        if (other->now.scene->scene == scene && !is_open(other)) return other;
    // Held by the viewer's session alone: its argument is a reference to what the session holds.
    if (before && before.use_count() == 1) {
        set_version(*before,
                    std::make_shared<const SceneVersion>(
                        SceneVersion{before->now.scene->version + 1, scene}),
                    uploaded.blobs);
        return before;
    }
    const auto numbered = [&] {
        return fmt::format("{}#{}", uploaded.name.substr(0, longest_stem), ++uploads_);
    };
    std::string name = numbered();
    while (is_taken(name)) name = numbered();
    return add({.name = name,
                .scene = std::make_shared<const SceneVersion>(SceneVersion{1, scene}),
                .blobs = uploaded.blobs});
}

void SceneStore::advance(const ScenePtr& scene, std::shared_ptr<const SceneVersion> version,
                         const BlobStore& blobs) {
    set_version(*scene, std::move(version), blobs);
    const auto watchers = scene->watchers;  // they may come and go as they hear of it
    for (const auto& [who, tell] : watchers) tell();
}

bool SceneStore::is_taken(const std::string& name) const {
    const std::vector<ScenePtr> scenes = all();
    return reserved_.contains(name) ||
           std::any_of(scenes.begin(), scenes.end(),
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

ScenePtr SceneStore::add(const ReadyScene& scene) {
    std::erase_if(scenes_, [](const auto& weak) { return weak.expired(); });
    const auto stored = std::make_shared<StoredScene>();
    stored->now.name = scene.name;
    set_version(*stored, scene.scene, scene.blobs);
    scenes_.push_back(stored);
    return stored;
}

}  // namespace tessera
