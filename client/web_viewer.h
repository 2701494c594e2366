// One browser's view of the cluster. Its page speaks JSON; what it says becomes views, picks and
// edits of a render client, and the page gets pictures and what it shows beside them. No sockets
// here but the client's own: messages in, messages out.
//
// The page says, one object a message:
//
//   {"view": {"camera": {"eye": [x,y,z], "at": [x,y,z], "up": [x,y,z], "fov": degrees},
//             "size": [width, height], "exposure": stops, "filmic": true, "reference": false,
//             "channel": "picture", "stamp": n}}      what to show from now on
//   {"shown": true, "seconds": s}                     a picture is on the screen: the next, please;
//                                                     it came s after the message before it
//   {"play": true}, {"seek": seconds}                 of what moves by itself
//   {"pick": [x, y], "number": n}                     what lies there? (0, 1): middle of upper edge
//   {"select": "instance"}                            tell more about it; "": about none
//   {"edit": {...}}                                   as client/edit_json.h describes
//
// and hears
//
//   {"about": {...}}    scene, cameras, lights, selection; anew whenever the scene changes
//   {"picked": {...}}   "number" of the pick and, if anything lies there, what and where
//   {"status": {...}}   of the cluster, every second
//   {"motion": {...}}   "seconds", "duration", "playing"
//   {"coming": bytes}   right before each picture
//   {"notice": "..."}   a sentence for people
//   a picture, binary: the length of a JSON object (4 bytes, little-endian), the object, and a JPEG
//   or, once the picture has settled, PNG file
#pragma once

#include <chrono>
#include <deque>
#include <nlohmann/json_fwd.hpp>
#include <optional>
#include <string>
#include <vector>

#include "client/motion_player.h"
#include "client/page_json.h"
#include "client/pick.h"
#include "client/render_client.h"
#include "common/picture_quality.h"

namespace tessera {

enum class PageNews : std::uint8_t { about, picked, status, notice, motion, picture };

/// For the page. A newer one may replace one of the same kind that has not gone out yet; pictures
/// alone all go out, and come only as fast as the page shows them.
struct PageMessage {
    PageNews kind = PageNews::notice;
    std::string bytes;
};

struct WebViewerConfig {
    RenderClientConfig server;
    std::string scene;           ///< empty: the first that the server holds
    std::uint32_t passes = 256;  ///< after which a picture has settled
    Motion motion{};             ///< of the scene, to be played
};

class WebViewer {
public:
    /// Connects, and waits for the scene. Throws UserError when that is not possible.
    explicit WebViewer(const WebViewerConfig& config);

    /// Takes what the page says. Throws PageError.
    void hear(const std::vector<std::string>& messages);
    /// Waits for news from the server, but not longer than `patience` or until `wake`, and returns
    /// what is to be told to the page. Throws UserError when the server is lost.
    std::vector<PageMessage> news(std::chrono::milliseconds patience);
    /// From any thread.
    void wake() { client_.wake(); }

private:
    void hear(const nlohmann::json& message);
    void shown(const nlohmann::json& message);
    void pick(const nlohmann::json& message);
    void move();
    void tell_motion();
    void edit(const nlohmann::json& operation);
    void tell(PageNews kind, const nlohmann::json& message);
    void tell_about();
    void tell_picture(const ShownPicture& picture);
    nlohmann::json selection() const;
    const Picker& picker();
    const Scene& scene() const { return client_.scene().scene; }

    RenderClient client_;
    std::string scene_name_;
    Camera home_;
    std::optional<Picker> picker_;  ///< once something has been picked
    View wanted_;
    View asked_;
    std::string selected_;
    std::vector<PageMessage> news_;
    std::uint64_t told_version_ = 0;
    /// A picture under way to the screen.
    struct Unshown {
        std::chrono::steady_clock::time_point told;
        bool jpeg = false;
    };
    std::deque<Unshown> unshown_;
    int jpeg_quality_ = best_jpeg_quality;  ///< that the link to the page allows
    MotionPlayer player_;
    std::uint64_t seen_version_ = 0;  ///< of the newest picture
    double told_seconds_ = -1;        ///< of the motion
    bool told_playing_ = false;
    std::chrono::steady_clock::time_point status_asked_;
};

}  // namespace tessera
