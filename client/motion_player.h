// The motion of a scene as a viewer plays it: where it is now, and the edits that bring the scene
// there, a step at a time. Pure: `now` comes in, edits go out.
#pragma once

#include <chrono>
#include <optional>

#include "common/animate.h"

namespace tessera {

class MotionPlayer {
public:
    using TimePoint = std::chrono::steady_clock::time_point;

    /// `shape_error`: as edits_at() takes it.
    explicit MotionPlayer(Motion motion = {}, float shape_error = 0)
        : motion_(std::move(motion)), shape_error_(shape_error), duration_(motion_.duration()) {}

    double duration() const { return duration_; }  ///< seconds; 0: nothing moves
    double seconds() const { return seconds_; }    ///< where the motion is
    bool playing() const { return playing_; }
    void play(bool playing) { playing_ = playing; }
    void seek(double seconds);

    /// Edits to be sent now: once a picture of the last ones has been seen, so that none is
    /// skipped. `version` is the scene's, `seen_version` that of the newest picture.
    std::optional<MotionEdits> step(const Scene& scene, std::uint64_t version,
                                    std::uint64_t seen_version, TimePoint now);

private:
    Motion motion_;
    float shape_error_;
    double duration_;
    bool playing_ = false;
    double seconds_ = 0;
    double sent_seconds_ = -1;
    std::uint64_t sent_version_ = 0;  ///< the scene's when the last of it was sent
    TimePoint sent_at_;
    std::optional<TimePoint> stepped_;
};

}  // namespace tessera
