// The viewer's side of the protocol as a library: connect, bring a scene, ask for pictures, edit,
// and watch what the server keeps rendering.
//
// Most calls block. While one waits it calls the client's `tick` about ten times a second; an
// exception thrown there (the user interrupts, a child process died) ends the call. A live viewer
// calls `poll` instead, and takes what has arrived.
#pragma once

#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "common/check.h"
#include "common/image.h"
#include "common/keys.h"
#include "common/messages.h"
#include "common/scene.h"

namespace tessera {

struct RenderedFrame {
    std::vector<std::uint8_t> srgb8;    ///< the picture, when PictureFormat::srgb8 was asked for
    std::map<Channel, Image> channels;  ///< linear pictures; `radiance` is the picture itself
    FrameStatistics statistics;
};

/// A picture of a view.
struct ShownPicture {
    ViewPicture about;
    Channel shown = Channel::radiance;
    ImageSize size;
    std::vector<std::uint8_t> srgb8;  ///< unless PictureFormat::linear_float was asked for
    Image linear;
    Bytes jpeg;  ///< instead of srgb8, with RenderClientConfig::keep_jpeg
};

struct RenderClientConfig {
    std::string address;  ///< host:port
    Credentials credentials;
    std::function<void()> tick = [] {};
    /// When the server is lost after it has let this client in: connect again, for as long as it
    /// takes or `tick` allows; watched scene and views come back by themselves.
    bool reconnects = false;
    bool keep_jpeg = false;  ///< pictures that arrive as JPEG stay as they are
};

/// The server was lost in the midst of a call and is back, but knows nothing of it: ask again.
struct ServerLost : UserError {
    using UserError::UserError;
};

/// What a frame has added up to so far.
struct SavedSums {
    Bytes sums;  ///< empty: nothing
    double render_seconds = 0;
    std::uint64_t rays = 0;
};

class RenderClient {
public:
    /// Connects and shakes hands. Throws UserError when the server cannot be reached or refuses.
    explicit RenderClient(const RenderClientConfig& config);
    ~RenderClient();

    const Welcome& welcome() const;
    /// Whether the server is there, as far as is known.
    bool connected() const;

    /// Makes the server hold `bundle` as scene `name`; blobs that it has already are not sent
    /// again.
    void upload_scene(const std::string& name, const SceneBundle& bundle);

    /// Renders one picture; `progress` is called as reports arrive.
    /// Goes on from `begun`, the sums of such a frame, unless they are empty.
    /// Throws UserError with the server's reason when it cannot be done, ServerLost.
    RenderedFrame render(const FrameRequest& request,
                         const std::function<void(const FrameProgress&)>& progress,
                         const SavedSums& begun = {});
    /// Asks for the sums of the frame that is being rendered, without waiting.
    void ask_sums();
    /// Those asked for, once they are there; a frame that is done has none.
    std::optional<SavedSums> take_sums();

    Status status();

    /// Waits, and goes on with the network meanwhile.
    void wait_until(std::chrono::steady_clock::time_point time);

    /// Makes a scene that this client has uploaded open to all.
    void share_scene(const std::string& name);
    /// Holds an open scene from now on: the newest version that has arrived.
    void watch(const std::string& scene);
    /// Of the scene watched last.
    const SceneVersion& scene() const;
    /// Changes an open scene. What could not be done is in the result's complaints. If the server
    /// is lost before it answers, the same is asked again: the last value wins, but what was
    /// created or deleted already is complained about.
    EditResult edit(const std::string& scene, const std::vector<EditOperation>& operations,
                    const BlobStore& blobs = {});
    /// Meshes and textures of an open scene.
    BlobStore fetch_blobs(const std::string& scene, const std::vector<BlobId>& blobs);

    // ---- Live: nothing here waits ----
    /// Handles what has arrived, or arrives within `patience`. Throws UserError when the server is
    /// lost for good.
    void poll(std::chrono::milliseconds patience);
    /// Ends the patience of a `poll`; from any thread.
    void wake();
    /// Begins the view or changes it (View::request is the client's to choose, 1 is a good number).
    void show(const View& view);
    /// The newest picture of any view, unless it has been taken.
    std::optional<ShownPicture> take_picture();
    /// `blobs`: those that the operations name. Throws UserError when they are more than one edit
    /// can carry.
    void send_edit(const std::string& scene, std::vector<EditOperation> operations,
                   const BlobStore& blobs = {});
    void ask_status();
    std::optional<Status> take_status();
    /// Complaints of edits, and why views cannot be rendered.
    std::vector<std::string> take_complaints();

private:
    struct State;
    std::unique_ptr<State> state_;
};

}  // namespace tessera
