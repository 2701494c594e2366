// One view of one viewer: keeps the newest camera on the newest scene rendering, begins anew when
// they change, and holds the newest picture until the viewer takes it. Lives on the server's
// strand; pictures are made on the pool.
//
// A frame that has not yet shown its first picture is finished first: a viewer that moves faster
// than pictures can be made would see none otherwise. One that only refines is cancelled at once.
#pragma once

#include <chrono>
#include <functional>
#include <memory>
#include <optional>

#include "server/render_farm.h"

namespace tessera {

/// What a view looks like by now.
struct LivePicture {
    View view;  ///< as it is shown
    ViewPicture about;
    std::shared_ptr<const Image> image;  ///< of channel view.shown
    std::vector<LightEstimate> lights;   ///< what they send into it, where they are tracked
};

class LiveView : public std::enable_shared_from_this<LiveView> {
public:
    /// `news` is called when there is a picture to take, `failed` when the view cannot be rendered
    /// as it is. The farm outlives the view.
    LiveView(RenderFarm& farm, std::function<void()> news,
             std::function<void(const std::string&)> failed);

    /// The view as it shall be from now on.
    void show(const View& view, ScenePtr scene);
    /// No more pictures; nothing is called any more.
    void end();

    /// The newest picture, unless it has been taken.
    std::optional<LivePicture> take();

private:
    void begin_if_due();
    void begin();
    std::function<void(const FrameSums&)> look(const FrameStatistics& statistics);
    void finish(const FinishedFrame& frame);
    std::function<void(const FrameSums&)> picture_maker(const FrameStatistics& statistics,
                                                        bool settled);
    void arrive(std::uint64_t frame, LivePicture picture);
    void watch(ScenePtr scene);

    RenderFarm& farm_;
    std::function<void()> news_;
    std::function<void(const std::string&)> failed_;
    View wanted_;
    ScenePtr scene_;
    bool stale_ = false;  ///< what is wanted is not what is being rendered
    View begun_;          ///< what is being rendered, or was last
    std::uint64_t version_ = 0;
    std::uint64_t frame_ = 0;  ///< being rendered; 0: none
    bool shown_ = false;       ///< it has made a picture
    bool making_ = false;      ///< its first picture is being made
    double first_seconds_ = 0;
    std::chrono::steady_clock::time_point last_made_;
    std::vector<LightEstimate> lights_;  ///< what they send into the view, changing smoothly
    std::optional<LivePicture> newest_;
    bool taken_ = true;
};

}  // namespace tessera
