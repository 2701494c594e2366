#include "client/motion_player.h"

#include <algorithm>
#include <cmath>
#include <utility>

namespace tessera {
namespace {

/// Motion waits no longer for a version of the scene: there is none, where nothing has changed.
constexpr std::chrono::milliseconds patience{1000};

}  // namespace

void MotionPlayer::seek(double seconds) {
    seconds_ = std::clamp(seconds, 0.0, duration_);
    playing_ = false;
}

std::optional<MotionEdits> MotionPlayer::step(const Scene& scene, std::uint64_t version,
                                              std::uint64_t seen_version, TimePoint now) {
    const auto before = std::exchange(stepped_, now).value_or(now);
    if (duration_ <= 0) return std::nullopt;
    if (playing_)
        seconds_ =
            std::fmod(seconds_ + std::chrono::duration<double>(now - before).count(), duration_);
    if (seconds_ == sent_seconds_ || (sent_seconds_ < 0 && seconds_ == 0 && !playing_))
        return std::nullopt;
    const bool seen = seen_version > sent_version_;
    const bool coming = version > sent_version_ || now - sent_at_ < patience;
    if (!seen && coming && sent_seconds_ >= 0) return std::nullopt;
    sent_version_ = version;
    sent_at_ = now;
    sent_seconds_ = seconds_;
    return edits_at(scene, motion_, seconds_, shape_error_);
}

}  // namespace tessera
