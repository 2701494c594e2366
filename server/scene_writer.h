// Changes of open scenes on their way through the journal: nothing is published, and nobody is told
// that it is done, before it is on disk. Lives on the server's strand; the journal has a thread of
// its own, so that the strand never waits for a disk.
//
// Group commit (Gawlick and Kinkade, "Varieties of Concurrency Control in IMS/VS Fast Path", 1985):
// what comes while a batch is being written makes up the next batch, so throughput does not hang on
// how long one write takes. Without a journal all happens at once.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "server/journal.h"
#include "server/render_farm.h"

namespace tessera {

/// A sentence for each thing that could not be done.
using Complaints = std::vector<std::string>;

class SceneWriter {
public:
    /// Store and farm outlive the writer. `journal` may be null; its scenes are opened.
    SceneWriter(SceneStore& store, RenderFarm& farm, std::unique_ptr<Journal> journal);
    /// Finishes what is being written; nobody hears of it.
    ~SceneWriter();

    /// `done` is called on the strand, when the scene has a version with the edits in it, as far as
    /// they could be done. What the operations name is in the scene or among the blobs `brought`
    /// along.
    void edit(const ScenePtr& scene, std::vector<EditOperation> operations,
              const BlobStore& brought, std::function<void(const Complaints&)> done);
    /// A new open scene, once `done` is called without complaints; the names in its tables become
    /// unique.
    void open(const ReadyScene& scene, std::function<void(const Complaints&)> done);
    /// The same before the strand runs; one that is open already gets these tables in a new
    /// version. Throws UserError.
    void open_now(const std::string& name, const SceneBundle& bundle);

private:
    struct Request {
        ScenePtr scene;  ///< to be edited; null:
        ReadyScene to_open;
        std::vector<EditOperation> operations;
        BlobStore brought;
        std::function<void(const Complaints&)> done;
    };
    struct Batch;

    void add(Request request);
    void write_next();
    Complaints stage_edit(const Request& request, Batch& batch) const;
    Complaints stage_open(const ReadyScene& scene, Batch& batch);
    void publish(const Batch& batch, const std::string& problem);

    SceneStore& store_;
    RenderFarm& farm_;
    std::unique_ptr<Journal> journal_;
    std::vector<Request> waiting_;  ///< bounded by what viewers may have unanswered
    bool writing_ = false;
    asio::thread_pool thread_{1};
};

}  // namespace tessera
