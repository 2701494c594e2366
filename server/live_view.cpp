#include "server/live_view.h"

#include <algorithm>
#include <functional>
#include <map>
#include <utility>

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

/// Refinement is shown no more often: making a picture takes time from making it better.
constexpr auto refinement_interval = std::chrono::milliseconds(100);

/// Whether the same samples serve both.
bool same_rendering(const View& a, const View& b) {
    return a.spec == b.spec && a.shown == b.shown && a.error_limit == b.error_limit;
}

FrameRequest request_of(const View& view) {
    FrameRequest request;
    request.request = view.request;
    request.spec = view.spec;
    request.error_limit = view.error_limit;
    if (view.shown != Channel::radiance) request.spec.extra = request.spec.extra.with(view.shown);
    return request;
}

Image image_of(const FrameSums& sums, Channel channel) {
    return channel == Channel::radiance ? sums.picture() : sums.channel(channel);
}

/// Lights that a view remembers from one frame to the next.
constexpr std::size_t most_lights_kept = 1024;

/// Estimates that follow the newest ones without jumping (Wald 2004, 14.4.2).
std::vector<LightEstimate> smoothed(const std::vector<LightEstimate>& before,
                                    const std::vector<LightEstimate>& now) {
    constexpr float share_of_newest = 0.5f;
    if (before.empty()) return now;
    std::map<std::uint32_t, float> sums;
    for (const LightEstimate& e : before) sums[e.light] += (1 - share_of_newest) * e.radiance;
    for (const LightEstimate& e : now) sums[e.light] += share_of_newest * e.radiance;
    std::vector<LightEstimate> out;
    for (const auto& [light, radiance] : sums) out.push_back({light, radiance});
    std::ranges::stable_sort(out, std::greater(), &LightEstimate::radiance);
    out.resize(std::min(out.size(), most_lights_kept));
    std::ranges::sort(out, {}, &LightEstimate::light);
    return out;
}

}  // namespace

LiveView::LiveView(RenderFarm& farm, std::function<void()> news,
                   std::function<void(const std::string&)> failed)
    : farm_(farm), news_(std::move(news)), failed_(std::move(failed)) {}

void LiveView::show(const View& view, ScenePtr scene) {
    const bool rendered_already = scene == scene_ && same_rendering(view, wanted_);
    wanted_.jpeg_quality = begun_.jpeg_quality = view.jpeg_quality;
    if (rendered_already && view == wanted_) return;  // of the pictures to come
    wanted_ = view;
    watch(std::move(scene));
    if (!rendered_already) {
        stale_ = true;
        return begin_if_due();
    }
    begun_.tone_map = view.tone_map;
    begun_.format = view.format;
    begun_.stamp = view.stamp;
    if (!newest_ || stale_) return;
    newest_->view = begun_;
    newest_->about.stamp = view.stamp;
    taken_ = false;
    news_();
}

void LiveView::watch(ScenePtr scene) {
    if (scene == scene_) return;
    if (scene_) scene_->watchers.erase(this);
    scene_ = std::move(scene);
    if (!scene_) return;
    scene_->watchers[this] = [this] {
        stale_ = true;
        begin_if_due();
    };
}

void LiveView::end() {
    watch(nullptr);
    if (frame_) farm_.cancel_frame(std::exchange(frame_, 0));
    stale_ = false;
    newest_.reset();
}

std::optional<LivePicture> LiveView::take() {
    if (taken_ || !newest_) return std::nullopt;
    taken_ = true;
    return newest_;
}

void LiveView::begin_if_due() {
    if (!stale_ || (frame_ && !shown_)) return;
    if (frame_) farm_.cancel_frame(std::exchange(frame_, 0));
    begin();
}

void LiveView::begin() {
    stale_ = shown_ = making_ = false;
    begun_ = wanted_;
    version_ = scene_->now.scene->version;
    const auto weak = weak_from_this();
    FrameRequest request = request_of(begun_);
    request.spec.lights = lights_;
    frame_ = farm_.begin_frame(
        request, scene_->now,
        {.progress = [](const FrameProgress&) {},
         .done =
             [weak](const FinishedFrame& frame) {
                 if (const auto self = weak.lock()) self->finish(frame);
             },
         .failed =
             [weak](const std::string& reason) {
                 const auto self = weak.lock();
                 if (!self) return;
                 self->frame_ = 0;
                 self->failed_(reason);
                 self->begin_if_due();
             },
         .look =
             [weak](const FrameStatistics& statistics) -> std::function<void(const FrameSums&)> {
             const auto self = weak.lock();
             return self ? self->look(statistics) : nullptr;
         }});
}

/// Whether a picture of the passes there are now is wanted, and how to make it.
std::function<void(const FrameSums&)> LiveView::look(const FrameStatistics& statistics) {
    const bool last = statistics.passes >= begun_.spec.settings.passes;
    const bool due = shown_ ? Clock::now() - last_made_ >= refinement_interval : !making_;
    if (last || !due) return {};
    return picture_maker(statistics, false);
}

void LiveView::finish(const FinishedFrame& frame) {
    asio::post(farm_.pool(),
               [make = picture_maker(frame.statistics, true), sums = frame.sums] { make(*sums); });
}

std::function<void(const FrameSums&)> LiveView::picture_maker(const FrameStatistics& statistics,
                                                              bool settled) {
    if (!shown_) first_seconds_ = statistics.render_seconds;
    making_ = true;
    last_made_ = Clock::now();
    LivePicture picture{.view = begun_,
                        .about = {.request = begun_.request,
                                  .stamp = begun_.stamp,
                                  .version = version_,
                                  .passes = statistics.passes,
                                  .settled = settled,
                                  .error_estimate = statistics.error_estimate,
                                  .first_seconds = first_seconds_,
                                  .render_seconds = statistics.render_seconds,
                                  .rays = statistics.rays},
                        .image = {},
                        .lights = {}};
    return [weak = weak_from_this(), strand = farm_.strand(), frame = frame_,
            picture](const FrameSums& sums) {
        LivePicture made = picture;
        made.image = std::make_shared<const Image>(image_of(sums, made.view.shown));
        made.lights = sums.lights(most_lights_kept);
        asio::post(strand, [weak, frame, made] {
            if (const auto self = weak.lock()) self->arrive(frame, made);
        });
    };
}

void LiveView::arrive(std::uint64_t frame, LivePicture picture) {
    if (frame != frame_) return;  // begun anew in the meantime
    shown_ = true;
    lights_ = smoothed(lights_, picture.lights);
    if (picture.about.settled) frame_ = 0;
    // Format and tone may have changed since.
    picture.view = begun_;
    picture.about.stamp = begun_.stamp;
    newest_ = std::move(picture);
    taken_ = false;
    news_();
    begin_if_due();
}

}  // namespace tessera
