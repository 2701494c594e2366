// One viewer: its scenes and its frames. Lives on the server's strand.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>

#include "common/picture_quality.h"
#include "server/limits.h"
#include "server/picture_parts.h"
#include "server/render_farm.h"
#include "server/scene_writer.h"

namespace tessera {

class ViewerSession : public std::enable_shared_from_this<ViewerSession> {
public:
    /// `status` describes the whole server. Who may not edit uses the scenes that are there.
    ViewerSession(const Hello& hello, std::shared_ptr<Connection> connection, bool may_edit,
                  const Limits& limits, std::function<Status()> status);

    /// Serves the viewer; throws ProtocolError or boost::system::system_error when that ends.
    asio::awaitable<void> run(RenderFarm& farm, SceneStore& store, SceneWriter& writer);
    /// To be called after `run`: ends the viewer's frames and gives up its scenes.
    void leave(RenderFarm& farm);
    /// Closes, and tells the viewer why.
    void dismiss(const std::string& reason) { connection_->dismiss(reason); }

    const std::string& description() const { return description_; }  ///< for logs

private:
    void handle(Message message, RenderFarm& farm, SceneStore& store, SceneWriter& writer);
    void count(const Message& message);
    /// Why there shall be no such picture beside those that are under way, in the place of one that
    /// has `replaced` bytes; else empty.
    std::string objection_to(const FrameSpec& spec, std::uint64_t replaced) const;
    asio::awaitable<void> wait_for_writes(std::size_t most);
    void publish_ready_scenes(RenderFarm& farm, SceneStore& store);
    void share(const SceneShare& share, RenderFarm& farm, SceneWriter& writer);
    void watch(const SceneWatch& watch, SceneStore& store);
    void edit(const SceneEdit& edit, const BlobStore& brought, SceneStore& store,
              SceneWriter& writer);
    void send_blobs_of(const BlobRequest& request, SceneStore& store);
    void show(const View& view, RenderFarm& farm, SceneStore& store);
    void end_view(std::uint64_t request);
    void begin_frame(const FrameRequest& request, RenderFarm& farm, SceneStore& store,
                     std::shared_ptr<FrameSums> sums = {});
    void expect_sums(const FrameRequest& request);
    void add_sums(const SumsChunk& chunk, std::span<const std::byte> bytes);
    asio::awaitable<void> resume_frame(RenderFarm& farm, SceneStore& store);
    void save_frame(std::uint64_t request, RenderFarm& farm);
    asio::awaitable<void> send_sums(std::uint64_t request, SavedFrame saved);
    void read_up_to(std::uint64_t stamp);
    void cancel_frame(std::uint64_t request, RenderFarm& farm);
    void fail(std::uint64_t request, const std::string& reason);
    asio::awaitable<void> send_frame(FinishedFrame frame, asio::any_io_executor pool);
    bool wants(const FrameRequest& request) const;

    struct Watched {
        ScenePtr scene;
        std::shared_ptr<const SceneVersion> sent;
    };
    std::pair<const std::string, Watched>* outdated_scene();
    void send_newest(std::pair<const std::string, Watched>& entry);
    std::optional<LivePicture> next_picture();
    asio::awaitable<void> send_picture(LivePicture picture, asio::any_io_executor pool);
    asio::awaitable<void> send_part(const PicturePart& part);
    asio::awaitable<void> keep_informed(asio::any_io_executor pool);

    std::string description_;
    std::shared_ptr<Connection> connection_;
    bool may_edit_;
    Limits limits_;
    std::function<Status()> status_;
    Rate requests_;
    SceneReceiver receiver_;
    std::map<std::string, ScenePtr> scenes_;  ///< uploaded, by the viewer's names
    std::map<std::string, Watched> watched_;
    struct Shown {
        std::shared_ptr<LiveView> live;
        std::uint64_t memory = 0;
    };
    std::map<std::uint64_t, Shown> views_;  ///< by the viewer's numbers
    std::uint64_t last_view_ = 0;           ///< whose picture was sent last
    std::uint64_t pictures_sent_ = 0;
    std::uint64_t pictures_read_ = 0;  ///< as far as the viewer has said
    /// A picture under way, between two pings.
    struct Travelling {
        std::chrono::steady_clock::time_point sent, begun;
        bool jpeg = false;
    };
    std::map<std::uint64_t, Travelling> travelling_;  ///< by number; at most two
    int jpeg_quality_ = best_jpeg_quality;            ///< that the link allows
    asio::steady_timer news_;     ///< cancelled whenever there is something to tell
    std::size_t unwritten_ = 0;   ///< changes that are not in the journal yet
    asio::steady_timer written_;  ///< cancelled whenever there are fewer
    unsigned blob_requests_ = 0;  ///< being answered
    struct Asked {
        std::uint64_t frame = 0;
        std::uint64_t memory = 0;
    };
    std::map<std::uint64_t, Asked> frames_;  ///< requests not answered
    /// A frame that goes on from sums which are still on their way.
    struct Resuming {
        FrameRequest request;
        Bytes sums;
    };
    std::optional<Resuming> resuming_;
    std::uint64_t saving_ = 0;  ///< request whose sums are being saved or sent; 0: none
};

}  // namespace tessera
