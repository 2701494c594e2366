#include "server/scene_writer.h"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <map>
#include <utility>

#include "common/check.h"
#include "common/log.h"

namespace tessera {
namespace {

std::shared_ptr<const SceneVersion> numbered(std::uint64_t version, Scene scene) {
    return std::make_shared<const SceneVersion>(SceneVersion{version, std::move(scene)});
}

Scene with_unique_names(Scene scene) {
    make_names_unique(scene);
    return scene;
}

bool is_shape_for(const BlobId& mesh, const BlobId& shape, const BlobStore& blobs) {
    const auto whole = blobs.find(mesh), moved = blobs.find(shape);
    if (!whole || !moved) return false;
    try {
        return decode_shape(*moved).positions.size() == vertex_count(*whole);
    } catch (const std::runtime_error&) {
        return false;
    }
}

bool is_mesh_for(std::size_t materials, const BlobId& mesh, const BlobStore& blobs) {
    const auto blob = blobs.find(mesh);
    if (!blob) return false;
    try {
        const Mesh decoded = decode_mesh(*blob);
        return decoded.slots.empty() || std::ranges::max(decoded.slots) < materials;
    } catch (const std::runtime_error&) {
        return false;
    }
}

/// Finds what cannot be done for want of a fitting mesh or shape; looks at operations in order.
class Misfits {
public:
    Misfits(const Scene& scene, const BlobStore& blobs) : scene_(scene), blobs_(blobs) {}

    /// A sentence, or nothing.
    std::optional<std::string> about(const EditOperation& operation) {
        if (const auto* edit = std::get_if<CreateObject>(&operation)) {
            if (!is_mesh_for(edit->materials.size(), edit->mesh, blobs_))
                return fmt::format("'{}': that is no mesh with a material for each slot",
                                   edit->object);
            created_.emplace(edit->object, edit->mesh);
        }
        if (const auto* edit = std::get_if<SetShape>(&operation); edit && !fits(*edit))
            return fmt::format("'{}': that is no shape for it", edit->object);
        return std::nullopt;
    }

private:
    /// Whether the shape is one for every mesh that an object of that name has or may get. One that
    /// is not there is complained of elsewhere.
    bool fits(const SetShape& edit) const {
        const auto object = std::ranges::find(scene_.objects, edit.object, &Object::name);
        if (object != scene_.objects.end() &&
            !is_shape_for(scene_.meshes[object->mesh], edit.shape, blobs_))
            return false;
        const auto [first, last] = created_.equal_range(edit.object);
        return std::all_of(first, last, [&](const auto& created) {
            return is_shape_for(created.second, edit.shape, blobs_);
        });
    }

    const Scene& scene_;
    const BlobStore& blobs_;
    std::multimap<std::string, BlobId> created_;  ///< objects, and their meshes
};

Complaints take_out_misfits(std::vector<EditOperation>& operations, const Scene& scene,
                            const BlobStore& blobs) {
    Complaints complaints;
    Misfits misfits(scene, blobs);
    std::erase_if(operations, [&](const EditOperation& operation) {
        const auto problem = misfits.about(operation);
        if (problem) complaints.push_back(*problem);
        return problem.has_value();
    });
    return complaints;
}

}  // namespace

/// Scenes as they shall be, and who waits for that.
struct SceneWriter::Batch {
    std::vector<SceneChange> changes;
    std::vector<ScenePtr> scenes;  ///< of the changes; null: to be opened
    std::vector<std::pair<std::function<void(const Complaints&)>, Complaints>> answers;

    SceneChange* find(const std::string& scene) {
        for (SceneChange& change : changes)
            if (change.scene == scene) return &change;
        return nullptr;
    }
    void change(ScenePtr scene, SceneChange change) {
        changes.push_back(std::move(change));
        scenes.push_back(std::move(scene));
    }
};

SceneWriter::SceneWriter(SceneStore& store, RenderFarm& farm, std::unique_ptr<Journal> journal)
    : store_(store), farm_(farm), journal_(std::move(journal)) {
    if (!journal_) return;
    for (const ReadyScene& scene : journal_->restore()) {
        spdlog::info("scene {} comes back from the journal at version {}", scene.name,
                     scene.scene->version);
        store_.reserve(scene.name);
        farm_.keep_ready(store_.open(scene));
    }
}

SceneWriter::~SceneWriter() { thread_.join(); }

void SceneWriter::edit(const ScenePtr& scene, std::vector<EditOperation> operations,
                       const BlobStore& brought, std::function<void(const Complaints&)> done) {
    add({.scene = scene,
         .to_open = {},
         .operations = std::move(operations),
         .brought = brought,
         .done = std::move(done)});
}

void SceneWriter::open(const ReadyScene& scene, std::function<void(const Complaints&)> done) {
    add({.scene = {}, .to_open = scene, .operations = {}, .brought = {}, .done = std::move(done)});
}

void SceneWriter::open_now(const std::string& name, const SceneBundle& bundle) {
    const ScenePtr held = store_.find_open(name);
    if (!held) store_.reserve(name);
    Batch batch;
    batch.change(held, {.scene = name,
                        .before = {},
                        .after = numbered(held ? held->now.scene->version + 1 : 1,
                                          with_unique_names(bundle.scene)),
                        .blobs = bundle.blobs});
    try {
        if (journal_) journal_->commit(batch.changes);
    } catch (const JournalError& error) {
        throw UserError(fmt::format("scene {}: {}", name, error.what()));
    }
    publish(batch, {});
}

/// Later, so that changes that arrive together are written together.
void SceneWriter::add(Request request) {
    waiting_.push_back(std::move(request));
    if (!journal_) return write_next();
    if (std::exchange(writing_, true)) return;
    asio::post(farm_.strand(), [this] { write_next(); });
}

void SceneWriter::write_next() {
    const auto batch = std::make_shared<Batch>();
    for (Request& request : std::exchange(waiting_, {})) {
        Complaints complaints =
            request.scene ? stage_edit(request, *batch) : stage_open(request.to_open, *batch);
        batch->answers.emplace_back(std::move(request.done), std::move(complaints));
    }
    if (!journal_ || batch->changes.empty()) return publish(*batch, {});
    asio::post(thread_, [this, batch] {
        std::string problem;
        try {
            journal_->commit(batch->changes);
        } catch (const JournalError& error) {
            problem = error.what();
        }
        asio::post(farm_.strand(), [this, batch, problem] { publish(*batch, problem); });
    });
}

/// Makes the change on top of those that the batch holds already.
Complaints SceneWriter::stage_edit(const Request& request, Batch& batch) const {
    const ReadyScene& now = request.scene->now;
    SceneChange* const staged = batch.find(now.name);
    const SceneVersion& newest = staged ? *staged->after : *now.scene;
    BlobStore blobs = staged ? staged->blobs : now.blobs;
    blobs.merge(request.brought);
    std::vector<EditOperation> possible = request.operations;
    Complaints complaints = take_out_misfits(possible, newest.scene, blobs);
    EditedScene edited = apply_edits(newest.scene, possible);
    std::ranges::move(edited.complaints, std::back_inserter(complaints));
    if (edited.scene == newest.scene) return complaints;
    blobs.keep_only(blobs_of(edited.scene));
    auto after = numbered(newest.version + 1, std::move(edited.scene));
    if (staged) {
        staged->after = std::move(after);
        staged->blobs = std::move(blobs);
    } else {
        batch.change(request.scene,
                     {.scene = now.name, .before = now.scene, .after = after, .blobs = blobs});
    }
    return complaints;
}

Complaints SceneWriter::stage_open(const ReadyScene& scene, Batch& batch) {
    try {
        store_.reserve(scene.name);
    } catch (const UserError& error) {
        return {error.what()};
    }
    batch.change(nullptr, {.scene = scene.name,
                           .before = {},
                           .after = numbered(1, with_unique_names(scene.scene->scene)),
                           .blobs = scene.blobs});
    return {};
}

/// Shows everybody the changes, unless there was a problem, and answers those who wait.
void SceneWriter::publish(const Batch& batch, const std::string& problem) {
    if (!problem.empty()) spdlog::error("{}", problem);
    for (std::size_t i = 0; i < batch.changes.size(); ++i) {
        const SceneChange& change = batch.changes[i];
        const ScenePtr& scene = batch.scenes[i];
        if (!problem.empty()) {
            if (!scene) store_.release(change.scene);
        } else if (scene) {
            store_.advance(scene, change.after, change.blobs);
            farm_.scene_changed(change.scene);
        } else {
            farm_.keep_ready(store_.open({change.scene, change.after, change.blobs}));
        }
    }
    for (const auto& [done, complaints] : batch.answers)
        done(problem.empty() ? complaints : Complaints{problem});
    writing_ = !waiting_.empty();
    if (writing_) write_next();
}

}  // namespace tessera
