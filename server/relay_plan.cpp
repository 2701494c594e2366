#include "server/relay_plan.h"

#include <algorithm>
#include <bit>

namespace tessera {
namespace {

/// How many others a worker passes a blob on to.
constexpr int fan_out = 2;
constexpr std::size_t most_failures = 3;
/// A worker's own part of a hop, beside the way there and back twice.
constexpr double hop_seconds = 1e-3;

}  // namespace

bool relaying_pays(std::uint64_t bytes, std::size_t workers, const LinkSpeed& uplink) {
    if (workers < 2 || uplink.bytes_per_second <= 0) return false;
    const double saved = double(workers - 1) * double(bytes) / uplink.bytes_per_second;
    const int hops = std::bit_width(workers) - 1;
    return saved > hops * (2 * uplink.round_trip_seconds + hop_seconds);
}

void RelayPlan::add_worker(std::uint64_t worker, bool relays) { workers_[worker] = {relays, {}}; }

void RelayPlan::remove_worker(std::uint64_t worker) { workers_.erase(worker); }

void RelayPlan::failed(std::uint64_t worker, std::uint64_t peer) {
    const auto blamed = workers_.find(peer);
    if (blamed == workers_.end()) return;
    blamed->second.failed.push_back(worker);
    if (const auto found = workers_.find(worker); found != workers_.end())
        found->second.failed.push_back(peer);
}

bool RelayPlan::takes_part(std::uint64_t worker) const {
    const auto found = workers_.find(worker);
    return mode_ != RelayMode::off && found != workers_.end() && found->second.relays &&
           found->second.failed.size() < most_failures;
}

RelayPlan::Entry& RelayPlan::entry_of(const BlobId& id, const std::shared_ptr<const Bytes>& blob) {
    if (entries_.size() >= sweep_at_) {
        std::erase_if(entries_, [](const auto& item) { return item.second.blob.expired(); });
        sweep_at_ = 2 * entries_.size() + 1024;
    }
    Entry& entry = entries_[id];
    // Whoever had it when a scene had it last may have dropped it since.
    if (entry.blob.expired()) entry = {.blob = blob, .copies = {}};
    return entry;
}

RelayPlan::Copy* RelayPlan::sender_to(std::uint64_t worker, Entry& entry) const {
    std::erase_if(entry.copies, [&](const Copy& copy) {
        return copy.passed_on >= fan_out || !takes_part(copy.worker);
    });
    const std::vector<std::uint64_t>& failed = workers_.at(worker).failed;
    const auto found = std::ranges::find_if(entry.copies, [&](const Copy& copy) {
        return copy.worker != worker && std::ranges::count(failed, copy.worker) == 0;
    });
    return found == entry.copies.end() ? nullptr : &*found;
}

std::vector<RelayPlan::Share> RelayPlan::share(std::uint64_t worker, std::span<const BlobId> ids,
                                               const BlobStore& store, const LinkSpeed& uplink) {
    const auto size_of = [&](const BlobId& id) {
        const auto blob = store.find(id);
        return blob ? std::uint64_t(blob->size()) : 0;
    };
    std::uint64_t bytes = 0;
    for (const BlobId& id : ids) bytes += size_of(id);
    const bool part = takes_part(worker);
    const bool relay =
        part && (mode_ == RelayMode::on || relaying_pays(bytes, workers_.size(), uplink));
    std::map<std::uint64_t, Share> shares;
    for (const BlobId& id : ids) {
        std::uint64_t peer = 0;
        if (const auto blob = store.find(id); blob && part) {
            Entry& entry = entry_of(id, blob);
            if (Copy* copy = relay ? sender_to(worker, entry) : nullptr) {
                ++copy->passed_on;
                peer = copy->worker;
            }
            entry.copies.push_back({.worker = worker});
        }
        Share& share = shares[peer];
        share.peer = peer;
        share.blobs.push_back(id);
        share.bytes.push_back(size_of(id));
    }
    std::vector<Share> out;
    for (auto& [peer, share] : shares) out.push_back(std::move(share));
    return out;
}

}  // namespace tessera
