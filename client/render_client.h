// The viewer's side of the protocol as a library: connect, bring a scene, ask for pictures.
//
// Calls block. While one waits it calls the client's `tick` about ten times a second; an exception
// thrown there (the user interrupts, a child process died) ends the call.
#pragma once

#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

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

struct RenderClientConfig {
    std::string address;  ///< host:port
    Credentials credentials;
    std::function<void()> tick = [] {};
};

class RenderClient {
public:
    /// Connects and shakes hands. Throws UserError when the server cannot be reached or refuses.
    explicit RenderClient(const RenderClientConfig& config);
    ~RenderClient();

    const Welcome& welcome() const;

    /// Makes the server hold `bundle` as scene `name`; blobs that it has already are not sent
    /// again.
    void upload_scene(const std::string& name, const SceneBundle& bundle);

    /// Renders one picture; `progress` is called as reports arrive.
    /// Throws UserError with the server's reason when it cannot be done.
    RenderedFrame render(const FrameRequest& request,
                         const std::function<void(const FrameProgress&)>& progress);

    Status status();

private:
    struct State;
    std::unique_ptr<State> state_;
};

}  // namespace tessera
