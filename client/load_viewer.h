// A viewer that asks for frame after frame along a path of cameras, and measures how long they take
// and whether every pixel is right.
#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <vector>

#include "client/render_client.h"
#include "common/connection.h"

namespace tessera {

/// One frame as a viewer saw it; times in seconds.
struct LoadFrame {
    std::chrono::steady_clock::time_point asked;
    std::chrono::steady_clock::time_point done;
    double first = 0;  ///< from asking to the first pixel
    double final = 0;  ///< and to the last
    std::uint64_t wrong_pixels = 0;
};

/// Views to ask for in turn, and the pictures that must come back.
struct LoadScript {
    std::vector<FrameRequest> views;  ///< 8-bit pictures
    std::vector<Scene> scenes;        ///< of each view
    std::vector<std::vector<std::uint8_t>> expected;
};

class LoadViewer : public std::enable_shared_from_this<LoadViewer> {
public:
    /// `first_view`: where in the script it begins.
    LoadViewer(const RenderClientConfig& config, std::shared_ptr<const LoadScript> script,
               std::size_t first_view, unsigned in_flight)
        : config_(config),
          script_(std::move(script)),
          next_view_(first_view),
          in_flight_(in_flight) {}

    /// Asks until it is stopped. Throws what Connection::receive throws, UserError for what the
    /// server cannot do.
    asio::awaitable<void> run(const SceneBundle& bundle);
    /// No more frames.
    void stop();

    const std::vector<LoadFrame>& frames() const { return frames_; }
    std::uint64_t bytes_received() const { return connection_ ? connection_->bytes_received() : 0; }

private:
    struct Pending {
        std::size_t view = 0;
        LoadFrame frame;
        bool begun = false;
        std::vector<std::uint8_t> pixels;
    };

    asio::awaitable<Message> receive();
    void bring(const Scene& scene);
    void ask_what_is_due();
    void ask();
    void place(const PictureChunk& chunk, std::span<const std::byte> bytes);
    void finish(std::uint64_t request);

    RenderClientConfig config_;
    std::shared_ptr<const LoadScript> script_;
    std::size_t next_view_;
    unsigned in_flight_;
    std::shared_ptr<Connection> connection_;
    std::uint64_t last_request_ = 0;
    SceneVersion held_;         ///< by the server, or soon
    bool scene_ready_ = false;  ///< and ready there
    unsigned due_ = 0;          ///< frames to ask for
    std::map<std::uint64_t, Pending> pending_;
    std::vector<LoadFrame> frames_;
};

}  // namespace tessera
