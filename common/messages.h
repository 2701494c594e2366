// Who says what to whom: the protocol as plain values. proto/protocol.proto is the public contract;
// common/messages.cpp is the only place where Protocol Buffers become values and back.
//
//   worker -> server   Hello, BlobRequest, SceneReady, TileResults*, Failure, Pong,
//                      Leave
//   viewer -> server   Hello, SceneUpdate, BlobChunk*, SceneShare, SceneWatch, BlobRequest,
//                      SceneEdit, View, ViewEnd, FrameRequest, SumsChunk*, FrameSave, FrameCancel,
//                      StatusRequest, Ping, Pong
//   server -> worker   Welcome | Refused, SceneUpdate, BlobChunk*, SceneDrop, FrameBegin,
//                      BlobSource, TileTasks, FrameEnd, Ping
//   server -> viewer   Welcome | Refused, BlobRequest, SceneReady, SceneUpdate, BlobChunk*,
//                      EditResult, FrameProgress, SumsChunk*, PictureChunk*, ViewPicture,
//                      FrameDone, Failure, Status, Ping, Pong
//   worker -> worker   Hello, BlobRequest; and back Welcome | Refused, BlobChunk*
// (* carries a raw payload after the Protocol Buffers message)
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include "common/blob.h"
#include "common/scene_delta.h"
#include "common/scene_edit.h"
#include "common/tile.h"
#include "common/tone_map.h"

namespace tessera {

/// Raised when a message changes meaning; peers of different versions refuse each other.
inline constexpr std::uint32_t protocol_version = 5;

/// The peer broke the protocol: closes its session and no other.
struct ProtocolError : std::runtime_error {
    using std::runtime_error::runtime_error;
};

enum class Role : std::uint8_t { worker, viewer };

/// First message of every connection.
struct Hello {
    std::uint32_t protocol = protocol_version;
    Role role = Role::viewer;
    std::string build;  ///< program version, for people
    std::string token;
    std::string name;              ///< how logs and status call this peer
    std::uint32_t threads = 0;     ///< worker: render threads
    std::uint16_t relay_port = 0;  ///< worker: where it has blobs for other workers; 0: nowhere

    bool operator==(const Hello&) const = default;
};
struct Welcome {
    std::uint64_t peer = 0;
    std::string build;
    std::vector<std::string> scenes;  ///< scenes that the server holds, first loaded first
    std::string relay_token{};        ///< what workers show one another; empty: none relays

    bool operator==(const Welcome&) const = default;
};
/// The server will not talk to this peer; a sentence that says what to do. Closes the connection.
struct Refused {
    std::string reason;

    bool operator==(const Refused&) const = default;
};

/// Brings a scene from delta.base_version to delta.next_version. The receiver answers with
/// BlobRequest for what it lacks (possibly nothing) and, when it holds everything, with SceneReady.
/// A version that a newer update overtakes on the way may be left out: SceneReady then comes for
/// the newer one only. A delta from version 0 replaces the scene, whatever the receiver holds.
struct SceneUpdate {
    std::string scene;
    SceneDelta delta;
    TracerKind tracer = TracerKind::kdtree;  ///< what a worker builds before it calls itself ready

    bool operator==(const SceneUpdate&) const = default;
};
struct BlobRequest {
    std::string scene;
    std::vector<BlobId> blobs;
    std::uint64_t failed_peer = 0;  ///< from which they did not come; 0: none was to send them

    bool operator==(const BlobRequest&) const = default;
};
/// Another worker holds these blobs, or is getting them, and sends them to whom asks.
struct BlobSource {
    std::uint64_t peer = 0;
    std::string address;
    std::vector<BlobId> blobs;
    std::vector<std::uint64_t> bytes;  ///< of each

    bool operator==(const BlobSource&) const = default;
};
/// Bytes [offset, offset + payload) of a blob of `total` bytes, in order.
struct BlobChunk {
    BlobId blob;
    std::uint64_t offset = 0;
    std::uint64_t total = 0;

    bool operator==(const BlobChunk&) const = default;
};
/// Comes again, with more build_seconds, when a frame has made a worker build more.
struct SceneReady {
    std::string scene;
    std::uint64_t version = 0;
    double build_seconds = 0;
    std::vector<std::string> modelled;  ///< ScenePlan
    std::vector<std::string> left_out;

    bool operator==(const SceneReady&) const = default;
};
struct SceneDrop {
    std::string scene;

    bool operator==(const SceneDrop&) const = default;
};

/// A scene that this viewer has uploaded becomes open to all, for as long as the server runs.
struct SceneShare {
    std::string scene;

    bool operator==(const SceneShare&) const = default;
};
/// The viewer wants to hold this open scene: SceneUpdates follow, now and after every change.
struct SceneWatch {
    std::string scene;

    bool operator==(const SceneWatch&) const = default;
};
struct SceneEdit {
    std::uint64_t request = 0;  ///< the viewer's own number, echoed in EditResult
    std::string scene;
    std::vector<EditOperation> operations;
    std::vector<std::uint64_t> blob_bytes{};  ///< sizes of the blobs that are the payload

    bool operator==(const SceneEdit&) const = default;
};
struct EditResult {
    std::uint64_t request = 0;
    std::string scene;
    std::uint64_t version = 0;  ///< the newest
    std::vector<std::string> complaints;

    bool operator==(const EditResult&) const = default;
};

/// How the picture shall come back.
enum class PictureFormat : std::uint8_t {
    linear_float,  ///< 32-bit floats, linear
    srgb8,         ///< 8-bit RGB, tone mapped on the server
    jpeg,          ///< the same, compressed; of views only
    automatic,     ///< in View only: jpeg, but srgb8 once the picture has settled
};
/// Asks for one picture; spec.frame and spec.version are the server's to fill.
struct FrameRequest {
    std::uint64_t request = 0;  ///< the viewer's own number, echoed in every answer
    FrameSpec spec;
    PictureFormat format = PictureFormat::linear_float;
    ToneMap tone_map;
    double time_limit = 0;   ///< seconds of rendering after which passes stop; 0: none
    double error_limit = 0;  ///< error estimate at which passes stop; 0: none
    /// Bytes of the sums that it goes on from, which follow as SumsChunks; 0: begins with the first
    /// pass.
    std::uint64_t sums_bytes = 0;

    bool operator==(const FrameRequest&) const = default;
};
/// The viewer wants to have what the frame has added up to so far, and the frame goes on.
struct FrameSave {
    std::uint64_t request = 0;

    bool operator==(const FrameSave&) const = default;
};
/// Bytes [offset, offset + payload) of a frame's sums, in order; a frame of the same spec on a
/// server of the same release goes on from them. `total` is 0 when there are none yet.
struct SumsChunk {
    std::uint64_t request = 0;
    std::uint64_t offset = 0;
    std::uint64_t total = 0;
    double render_seconds = 0;  ///< spent on them
    std::uint64_t rays = 0;

    bool operator==(const SumsChunk&) const = default;
};
/// Begins a view that the server keeps rendering, or changes the one of that number.
struct View {
    std::uint64_t request = 0;
    FrameSpec spec;  ///< settled after settings.passes
    PictureFormat format = PictureFormat::automatic;
    ToneMap tone_map;
    Channel shown = Channel::radiance;  ///< radiance: the picture
    double error_limit = 0;             ///< settled at this error estimate; 0: none
    std::uint64_t stamp = 0;            ///< the viewer's own, echoed in ViewPicture
    std::uint32_t jpeg_quality = 0;     ///< 1 to 100; 0: as the server finds the link to be

    bool operator==(const View&) const = default;
};
struct ViewEnd {
    std::uint64_t request = 0;

    bool operator==(const ViewEnd&) const = default;
};
/// Follows the last PictureChunk of a picture of a view.
struct ViewPicture {
    std::uint64_t request = 0;
    std::uint64_t stamp = 0;
    std::uint64_t version = 0;  ///< of the scene
    std::uint32_t passes = 0;
    bool settled = false;  ///< no better one comes until something changes
    double error_estimate = 0;
    double first_seconds = 0;   ///< first tile handed out to the end of the first passes
    double render_seconds = 0;  ///< to the end of these
    std::uint64_t rays = 0;

    bool operator==(const ViewPicture&) const = default;
};
struct FrameCancel {
    std::uint64_t request = 0;

    bool operator==(const FrameCancel&) const = default;
};
struct FrameProgress {
    std::uint64_t request = 0;
    std::uint64_t tiles_done = 0;  ///< tasks, over all passes
    std::uint64_t tiles_total = 0;
    std::uint32_t passes_done = 0;
    std::uint32_t workers = 0;
    double error_estimate = 0;

    bool operator==(const FrameProgress&) const = default;
};
/// Bytes [offset, offset + payload) of a channel's pixels: rows from the top, interleaved,
/// little-endian. The picture itself has channel `radiance`.
struct PictureChunk {
    std::uint64_t request = 0;
    Channel channel = Channel::radiance;
    PictureFormat format = PictureFormat::linear_float;
    std::uint32_t width = 0;
    std::uint32_t height = 0;
    std::uint32_t components = 3;
    std::uint64_t offset = 0;
    std::uint64_t total = 0;

    bool operator==(const PictureChunk&) const = default;
};
struct WorkerShare {
    std::string name;
    std::uint32_t threads = 0;
    std::uint64_t tiles = 0;
    std::uint64_t rays = 0;

    bool operator==(const WorkerShare&) const = default;
};
struct FrameStatistics {
    double build_seconds = 0;   ///< the slowest worker's
    double render_seconds = 0;  ///< first tile handed out to last pixel
    std::uint32_t passes = 0;
    std::uint64_t rays = 0;
    std::uint64_t sanitised = 0;
    std::uint64_t tiles_reissued = 0;
    double error_estimate = 0;  ///< expected RMSE of the picture clamped to [0, 1]; 0 when unknown
    std::vector<std::string> modelled;
    std::vector<std::string> left_out;
    std::vector<WorkerShare> workers;
    std::vector<LightEstimate> lights{};  ///< those that send most, where lights are tracked
    std::uint32_t active_lights = 0;      ///< that the view gets something of; 0: not tracked

    bool operator==(const FrameStatistics&) const = default;
};
/// Follows the last PictureChunk.
struct FrameDone {
    std::uint64_t request = 0;
    FrameStatistics statistics;

    bool operator==(const FrameDone&) const = default;
};

struct FrameBegin {
    FrameSpec spec;

    bool operator==(const FrameBegin&) const = default;
};
/// The frame is finished or superseded: drop what is kept for it and its tasks not yet begun.
struct FrameEnd {
    std::uint64_t frame = 0;

    bool operator==(const FrameEnd&) const = default;
};

/// Tasks for a worker, in the order in which they are wanted.
struct TileTasks {
    std::vector<TileTask> tasks;

    bool operator==(const TileTasks&) const = default;
};
/// Finished tasks in any order. The payload holds their pixels, packed (common/tile_codec.h), one
/// tile after the other.
struct TileResults {
    std::vector<TileReport> tiles;

    bool operator==(const TileResults&) const = default;
};

/// Something asked for cannot be done. `request` is the viewer's request, from a worker the frame,
/// and 0 when it concerns neither (a scene that cannot be built).
struct Failure {
    std::uint64_t request = 0;
    std::string reason;

    bool operator==(const Failure&) const = default;
};

struct StatusRequest {
    bool operator==(const StatusRequest&) const = default;
};
struct WorkerStatus {
    std::uint64_t peer = 0;
    std::string name;
    std::string address;
    std::uint32_t threads = 0;
    std::uint32_t leases = 0;  ///< tasks handed out and not returned
    std::uint64_t tiles = 0;
    std::uint64_t rays = 0;
    double round_trip_seconds = 0;
    std::uint32_t prefetch = 0;       ///< tasks that it may hold at the pace it shows
    double task_seconds = 0;          ///< of one of its threads for a task; 0: not known yet
    std::uint64_t memory_bytes = 0;   ///< resident; 0: not known
    bool overdue = false;             ///< has let a lease expire and not been heard of since
    double busy_seconds = 0;          ///< of its threads, spent on tiles
    std::uint64_t relayed_bytes = 0;  ///< of blobs, sent to other workers
    std::uint64_t sent_bytes = 0;     ///< by the server to it, of all messages

    bool operator==(const WorkerStatus&) const = default;
};
struct SceneStatus {
    std::string name;
    std::uint64_t version = 0;
    std::uint64_t instances = 0;
    std::uint64_t bytes = 0;  ///< meshes and textures

    bool operator==(const SceneStatus&) const = default;
};
struct Status {
    std::string build;
    double uptime_seconds = 0;
    std::uint32_t viewers = 0;
    std::uint32_t frames_in_flight = 0;
    std::uint64_t frames_done = 0;
    std::vector<SceneStatus> scenes;
    std::vector<WorkerStatus> workers;
    std::uint64_t memory_bytes = 0;  ///< the server's, resident
    std::uint64_t worker_bytes = 0;  ///< that have come from workers, also from those that left

    bool operator==(const Status&) const = default;
};

struct Ping {
    std::uint64_t stamp = 0;  ///< the sender's own; comes back in Pong

    bool operator==(const Ping&) const = default;
};
struct Pong {
    std::uint64_t stamp = 0;
    std::uint64_t memory_bytes = 0;   ///< a worker's, resident; 0: not told
    std::uint64_t relayed_bytes = 0;  ///< of blobs that a worker has sent to others

    bool operator==(const Pong&) const = default;
};

/// The worker wants to end: it gets no more tasks, and the server closes the connection once it
/// has answered those that it holds.
struct Leave {
    bool operator==(const Leave&) const = default;
};

using MessageBody =
    std::variant<Hello, Welcome, Refused, SceneUpdate, BlobRequest, BlobChunk, SceneReady,
                 SceneDrop, FrameRequest, FrameCancel, FrameProgress, PictureChunk, FrameDone,
                 FrameBegin, FrameEnd, TileTasks, TileResults, Failure, StatusRequest, Status, Ping,
                 Pong, SceneShare, SceneWatch, SceneEdit, EditResult, View, ViewEnd, ViewPicture,
                 Leave, FrameSave, SumsChunk, BlobSource>;

/// Raw bytes that travel after the message, kept alive by `owner`; never copied through protobuf.
struct Payload {
    std::shared_ptr<const void> owner;
    std::span<const std::byte> bytes;
};

struct Message {
    MessageBody body;
    Payload payload;

    template <class T>
    const T* get() const {
        return std::get_if<T>(&body);
    }
};

}  // namespace tessera
