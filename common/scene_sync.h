// Brings scenes from one peer to another; the same for server -> worker and viewer -> server.
//
// After the state synchronisation of Winstein and Balakrishnan, "Mosh: An Interactive Remote Shell
// for Mobile Clients" (2012): the receiver holds numbered states and applies a diff only to the
// state that it was made from. Where we differ: TCP keeps the order, so nothing is acknowledged or
// sent twice, and large data travels beside the diffs, by content, each blob once:
//
//   sender                                receiver
//   SceneUpdate {delta}          ->
//                                <-       BlobRequest {the blobs it lacks, perhaps none}
//   BlobChunk* of each, in order ->
//                                <-       SceneReady, once built
//
// A version that a newer update overtakes before it is whole is never reported whole: only the
// newest one counts.
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <vector>

#include "common/connection.h"
#include "common/messages.h"

namespace tessera {

/// A scene version with all its blobs.
struct ReadyScene {
    std::string name;
    std::shared_ptr<const SceneVersion> scene;
    BlobStore blobs;  ///< those that the scene names
};

struct SceneLimits {
    std::uint64_t scenes = 64;
    std::uint64_t blob_bytes = std::uint64_t(16) << 30;  ///< held, of all scenes together
    const char* option = nullptr;  ///< by which an operator raises blob_bytes, if he can
};

/// What has come of a blob.
struct BlobPart {
    bool begun = false;  ///< else nothing has, not even its size
    std::uint64_t total = 0;
    std::span<const std::byte> bytes;  ///< valid until something else comes
};

/// The receiving end: all scenes of one peer. Pure. Whatever it throws is a ProtocolError.
class SceneReceiver {
public:
    explicit SceneReceiver(const SceneLimits& limits = {}) : limits_(limits) {}

    /// Starts from a scene that is known by other means, so that deltas made from it apply and its
    /// blobs are not asked for. It is not reported by take_ready.
    void hold(const std::string& name, SceneVersion version, const BlobStore& blobs);

    /// Blobs that are not to be asked for, while there is room for them.
    void know(const BlobStore& blobs);

    /// Applies the update and returns the answer: the blobs to send, which are neither held nor on
    /// their way. A delta from version 0 replaces the scene whatever version is held; any other
    /// applies to the version held only.
    BlobRequest update(const SceneUpdate& update);

    /// Takes the next bytes of a blob that was asked for; the last ones are checked against its id.
    void add(const BlobChunk& chunk, std::span<const std::byte> bytes);

    /// Takes from elsewhere what was asked for and has not begun to come; nothing else.
    void supply(BlobStore blobs);

    /// What is here of a blob; none of one that is neither held nor asked for.
    std::optional<BlobPart> part(const BlobId& id) const;

    /// Forgets what has come of these blobs, unless they are whole, and returns the requests for
    /// those that scenes still wait for: where they were to come from, they do not.
    std::vector<BlobRequest> ask_again(std::span<const BlobId> ids);

    /// The next scene whose newest version has become whole; every version at most once.
    std::optional<ReadyScene> take_ready();

    /// Forgets a scene (none of that name: nothing to do).
    void drop(const std::string& name);

    /// The newest version of a scene, whole or not; null when there is none of that name.
    std::shared_ptr<const SceneVersion> find(const std::string& name) const;
    /// Every whole blob held: of all scenes, and earlier ones while there is room.
    const BlobStore& blobs() const { return blobs_; }

private:
    struct Entry {
        std::shared_ptr<const SceneVersion> scene;
        std::set<BlobId> missing;
        bool reported = false;
    };
    struct Arrival {
        bool begun = false;
        std::uint64_t total = 0;
        Bytes bytes;
    };

    void make_room(std::uint64_t bytes);
    void drop_unused_blobs();
    /// When many have come since that was done last.
    void drop_unused_blobs_now_and_then();
    void complete(const BlobId& id, Bytes bytes);

    SceneLimits limits_;
    std::map<std::string, Entry> scenes_;
    BlobStore blobs_;
    std::map<BlobId, Arrival> arrivals_;  ///< blobs asked for and not yet whole
    std::uint64_t announced_bytes_ = 0;   ///< of all arrivals, once whole
    std::uint64_t held_bytes_ = 0;        ///< of blobs_
    std::uint64_t held_when_dropped_ =
        0;  ///< of blobs_, when it was last cleared of what is unused
};

/// A blob cut into messages of chunk_bytes that share its memory; at least one.
std::vector<Message> chunks_of(const BlobId& id, const std::shared_ptr<const Bytes>& blob);

/// Answers a BlobRequest: feeds the blobs into the connection's bulk lane whenever little waits
/// there, so that memory stays bounded and control messages never wait. Throws ProtocolError for
/// a blob that `blobs` does not hold, boost::system::system_error when the connection closes.
asio::awaitable<void> send_blobs(std::shared_ptr<Connection> connection, BlobStore blobs,
                                 std::vector<BlobId> ids);

}  // namespace tessera
