// One viewer: its scenes and its frames. Lives on the server's strand.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>

#include "server/render_farm.h"
#include "server/scene_store.h"

namespace tessera {

class ViewerSession : public std::enable_shared_from_this<ViewerSession> {
public:
    /// `status` describes the whole server. Who may not edit uses the scenes that are there.
    ViewerSession(const Hello& hello, std::shared_ptr<Connection> connection, bool may_edit,
                  std::function<Status()> status);

    /// Serves the viewer; throws ProtocolError or boost::system::system_error when that ends.
    asio::awaitable<void> run(RenderFarm& farm, SceneStore& store);
    /// To be called after `run`: ends the viewer's frames and gives up its scenes.
    void leave(RenderFarm& farm);

    const std::string& description() const { return description_; }  ///< for logs

private:
    void handle(Message message, RenderFarm& farm, SceneStore& store);
    void publish_ready_scenes(RenderFarm& farm, SceneStore& store);
    void begin_frame(const FrameRequest& request, RenderFarm& farm, SceneStore& store);
    void cancel_frame(std::uint64_t request, RenderFarm& farm);
    void fail(std::uint64_t request, const std::string& reason);
    asio::awaitable<void> send_frame(FinishedFrame frame, asio::any_io_executor pool);
    bool wants(const FrameRequest& request) const;

    std::string description_;
    std::shared_ptr<Connection> connection_;
    bool may_edit_;
    std::function<Status()> status_;
    SceneReceiver receiver_;
    std::map<std::string, ScenePtr> scenes_;         ///< uploaded, by the viewer's names
    std::map<std::uint64_t, std::uint64_t> frames_;  ///< requests not answered -> frame
};

}  // namespace tessera
