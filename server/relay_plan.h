// Who sends a mesh or texture to a worker: the server, or a worker that has it already or is
// getting it. In Wald's thesis ("Realtime Ray Tracing and Interactive Global Illumination", 2004,
// table 9.4) every update goes out once per machine, so that more machines made a deforming scene
// slower. Here the first worker that asks gets it from the server, and the others from those before
// them, each of which passes it on to two: what the server sends does not grow with the workers,
// and the last of n has it after log2(n) hops. Pure: values in, decisions out.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <span>
#include <vector>

#include "common/blob.h"
#include "common/tcp_link.h"

namespace tessera {

enum class RelayMode : std::uint8_t {
    automatic,  ///< when it is faster
    on,         ///< whenever there is somebody to relay
    off
};

/// Whether n workers have so many bytes each sooner by relays: what the server would still have to
/// send to the others, against the round trips of the hops. Not while the speed is not known.
bool relaying_pays(std::uint64_t bytes, std::size_t workers, const LinkSpeed& uplink);

class RelayPlan {
public:
    explicit RelayPlan(RelayMode mode) : mode_(mode) {}

    /// `relays`: others can reach it.
    void add_worker(std::uint64_t worker, bool relays);
    void remove_worker(std::uint64_t worker);

    /// Blobs that come from the same sender; 0: the server.
    struct Share {
        std::uint64_t peer = 0;
        std::vector<BlobId> blobs;
        std::vector<std::uint64_t> bytes;  ///< of each; 0 of one that is not in the store
    };
    /// Decides who sends each of `ids`, of the store, to the worker, in the order of senders.
    std::vector<Share> share(std::uint64_t worker, std::span<const BlobId> ids,
                             const BlobStore& store, const LinkSpeed& uplink);

    /// The worker could not have something from this peer, and is not sent there again. Whoever
    /// takes part in three such failures has no part in relays any more; a peer that is gone is
    /// nobody's fault.
    void failed(std::uint64_t worker, std::uint64_t peer);

private:
    struct Worker {
        bool relays = false;
        std::vector<std::uint64_t> failed;  ///< with whom, once for each failure
    };
    /// A worker that can still pass a blob on.
    struct Copy {
        std::uint64_t worker = 0;
        int passed_on = 0;
    };
    struct Entry {
        std::weak_ptr<const Bytes> blob;  ///< gone: no scene has it any more
        std::vector<Copy> copies;         ///< oldest first
    };

    bool takes_part(std::uint64_t worker) const;
    Entry& entry_of(const BlobId& id, const std::shared_ptr<const Bytes>& blob);
    /// Null when nobody can pass it on to the worker.
    Copy* sender_to(std::uint64_t worker, Entry& entry) const;

    RelayMode mode_;
    std::map<std::uint64_t, Worker> workers_;
    std::map<BlobId, Entry> entries_;
    std::size_t sweep_at_ = 1024;  ///< entries at which those without a blob are dropped
};

}  // namespace tessera
