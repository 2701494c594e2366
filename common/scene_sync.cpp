#include "common/scene_sync.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace tessera {
namespace {

/// Blobs are kept for versions to come until so many more have arrived: shapes, of which every
/// version brings others, would fill the memory.
constexpr std::uint64_t most_unused_bytes = 256u << 20;

template <class... Args>
[[noreturn]] void refuse(fmt::format_string<Args...> format, Args&&... args) {
    throw ProtocolError(fmt::format(format, std::forward<Args>(args)...));
}

SceneVersion applied(const std::string& name, const SceneVersion& base, const SceneDelta& delta) {
    try {
        return apply(base, delta);
    } catch (const std::runtime_error& error) {
        refuse("scene '{}': {}", name, error.what());
    }
}

Message chunk_at(const BlobId& id, const std::shared_ptr<const Bytes>& blob, std::size_t offset) {
    const std::size_t size = std::min<std::size_t>(chunk_bytes, blob->size() - offset);
    return {.body = BlobChunk{.blob = id, .offset = offset, .total = blob->size()},
            .payload = {blob, std::span(*blob).subspan(offset, size)}};
}

}  // namespace

void SceneReceiver::hold(const std::string& name, SceneVersion version, const BlobStore& blobs) {
    know(blobs);
    scenes_[name] = {.scene = std::make_shared<const SceneVersion>(std::move(version)),
                     .missing = {},
                     .reported = true};
}

void SceneReceiver::know(const BlobStore& blobs) {
    blobs_.merge(blobs);
    held_bytes_ = blobs_.bytes();
}

BlobRequest SceneReceiver::update(const SceneUpdate& update) {
    const auto held = find(update.scene);
    if (!held && scenes_.size() >= limits_.scenes) refuse("more than {} scenes", limits_.scenes);
    const SceneVersion empty;
    const SceneVersion& base = held && update.delta.base_version != 0 ? *held : empty;
    Entry next{
        .scene = std::make_shared<const SceneVersion>(applied(update.scene, base, update.delta)),
        .missing = {}};
    BlobRequest request{.scene = update.scene, .blobs = {}};
    for (const BlobId& id : blobs_of(next.scene->scene)) {
        if (blobs_.contains(id)) continue;
        next.missing.insert(id);
        if (arrivals_.try_emplace(id).second) request.blobs.push_back(id);
    }
    scenes_[update.scene] = std::move(next);
    return request;
}

void SceneReceiver::add(const BlobChunk& chunk, std::span<const std::byte> bytes) {
    const auto it = arrivals_.find(chunk.blob);
    if (it == arrivals_.end())
        refuse("blob {} comes without having been asked for", short_name(chunk.blob));
    Arrival& arrival = it->second;
    if (!arrival.begun) {
        make_room(chunk.total);
        announced_bytes_ += chunk.total;
        arrival = {.begun = true, .total = chunk.total, .bytes = {}};
    }
    if (chunk.total != arrival.total || chunk.offset != arrival.bytes.size() ||
        bytes.size() > arrival.total - arrival.bytes.size())
        refuse("blob {} comes out of order", short_name(chunk.blob));
    arrival.bytes.insert(arrival.bytes.end(), bytes.begin(), bytes.end());
    if (arrival.bytes.size() < arrival.total) return;
    Bytes whole = std::move(arrival.bytes);
    arrivals_.erase(it);
    complete(chunk.blob, std::move(whole));
}

void SceneReceiver::complete(const BlobId& id, Bytes bytes) {
    announced_bytes_ -= bytes.size();
    held_bytes_ += bytes.size();
    if (blobs_.insert(std::move(bytes)) != id)
        refuse("blob {} comes with other content than its name says", short_name(id));
    for (auto& [name, entry] : scenes_) entry.missing.erase(id);
    drop_unused_blobs_now_and_then();
}

void SceneReceiver::supply(BlobStore blobs) {
    std::vector<BlobId> awaited;
    for (const auto& [id, arrival] : arrivals_)
        if (!arrival.begun) awaited.push_back(id);
    blobs.keep_only(awaited);
    make_room(blobs.bytes());
    know(blobs);
    const auto is_here = [&](const BlobId& id) { return blobs.contains(id); };
    std::erase_if(arrivals_, [&](const auto& arrival) { return is_here(arrival.first); });
    for (auto& [name, entry] : scenes_) std::erase_if(entry.missing, is_here);
    drop_unused_blobs_now_and_then();
}

std::optional<BlobPart> SceneReceiver::part(const BlobId& id) const {
    if (const auto blob = blobs_.find(id)) return BlobPart{true, blob->size(), *blob};
    const auto found = arrivals_.find(id);
    if (found == arrivals_.end()) return std::nullopt;
    return BlobPart{found->second.begun, found->second.total, found->second.bytes};
}

std::vector<BlobRequest> SceneReceiver::ask_again(std::span<const BlobId> ids) {
    std::set<BlobId> lost(ids.begin(), ids.end());
    for (const BlobId& id : ids)
        if (const auto found = arrivals_.find(id); found != arrivals_.end()) {
            announced_bytes_ -= found->second.total;
            arrivals_.erase(found);
        }
    std::vector<BlobRequest> requests;
    for (const auto& [name, entry] : scenes_) {
        BlobRequest request{.scene = name, .blobs = {}};
        for (const BlobId& id : entry.missing)
            if (lost.erase(id) > 0) request.blobs.push_back(id);
        for (const BlobId& id : request.blobs) arrivals_.try_emplace(id);
        if (!request.blobs.empty()) requests.push_back(std::move(request));
    }
    return requests;
}

void SceneReceiver::make_room(std::uint64_t bytes) {
    const auto fits = [&] {
        const std::uint64_t used = held_bytes_ + announced_bytes_;
        return used <= limits_.blob_bytes && bytes <= limits_.blob_bytes - used;
    };
    if (fits()) return;
    drop_unused_blobs();
    if (!fits())
        refuse("brings scenes with more than {} MB of meshes and textures{}{}",
               limits_.blob_bytes >> 20, limits_.option ? ": limited by " : "",
               limits_.option ? limits_.option : "");
}

void SceneReceiver::drop_unused_blobs_now_and_then() {
    if (held_bytes_ > held_when_dropped_ + most_unused_bytes) drop_unused_blobs();
}

void SceneReceiver::drop_unused_blobs() {
    std::vector<BlobId> wanted;
    for (const auto& [name, entry] : scenes_) {
        const std::vector<BlobId> ids = blobs_of(entry.scene->scene);
        wanted.insert(wanted.end(), ids.begin(), ids.end());
    }
    blobs_.keep_only(wanted);
    held_bytes_ = held_when_dropped_ = blobs_.bytes();
}

std::optional<ReadyScene> SceneReceiver::take_ready() {
    const auto is_ready = [](const auto& item) {
        return !item.second.reported && item.second.missing.empty();
    };
    const auto it = std::find_if(scenes_.begin(), scenes_.end(), is_ready);
    if (it == scenes_.end()) return std::nullopt;
    it->second.reported = true;
    ReadyScene ready{.name = it->first, .scene = it->second.scene, .blobs = blobs_};
    ready.blobs.keep_only(blobs_of(ready.scene->scene));
    return ready;
}

void SceneReceiver::drop(const std::string& name) {
    scenes_.erase(name);
    drop_unused_blobs();
}

std::shared_ptr<const SceneVersion> SceneReceiver::find(const std::string& name) const {
    const auto it = scenes_.find(name);
    return it == scenes_.end() ? nullptr : it->second.scene;
}

std::vector<Message> chunks_of(const BlobId& id, const std::shared_ptr<const Bytes>& blob) {
    std::vector<Message> chunks;
    std::size_t offset = 0;
    do {
        chunks.push_back(chunk_at(id, blob, offset));
        offset += chunks.back().payload.bytes.size();
    } while (offset < blob->size());
    return chunks;
}

asio::awaitable<void> send_blobs(std::shared_ptr<Connection> connection, BlobStore blobs,
                                 std::vector<BlobId> ids) {
    for (const BlobId& id : ids) {
        const auto blob = blobs.find(id);
        if (!blob) refuse("asks for blob {}, which its scenes do not name", short_name(id));
        for (Message& chunk : chunks_of(id, blob)) {
            co_await connection->wait_until_drained(chunk_bytes);
            connection->send_bulk(std::move(chunk));
        }
    }
}

}  // namespace tessera
