// Ties a scene version's geometry and lights to the frames rendered from it.
#include "worker/renderer.h"

#include <array>
#include <atomic>
#include <bit>
#include <chrono>
#include <map>
#include <mutex>

#include "common/check.h"
#include "common/clock.h"
#include "worker/cutout_tracer.h"
#include "worker/igi.h"
#include "worker/light_paths.h"
#include "worker/light_tracking.h"
#include "worker/path.h"
#include "worker/plan.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

/// The geometry term is bounded at 1 / (this * diagonal of the scene)^2. Measured on a Cornell box
/// and a conference room, against time: at 0.14 spots around VPLs make a fifth more error, at 0.4
/// there is so much to compensate that the conference room takes twice the time.
constexpr float bound_share = 0.25f;

/// Eye points that decide which VPLs matter: about this many, on a grid over the picture. Twice as
/// many and half the candidates, or the reverse, come out worse at the same cost.
constexpr int pilot_count = 64;

/// A frame's VPLs and photons are kept for this many passes, more than one task has; older ones are
/// made again if a late task asks.
constexpr std::size_t kept_passes = 24;

VplConfig vpl_config(const RenderSettings& settings, const Box& bounds) {
    const float radius = bound_share * length(bounds.extent());
    return {.interleave = std::max(settings.interleave, 1u),
            .vpls = settings.vpls,
            .bounces = settings.bounces,
            .seed = hash(settings.seed, 2),
            .max_geometry = radius > 0 ? 1 / (radius * radius) : infinity};
}

/// First diffuse hits of a coarse picture from the same camera.
std::vector<Receiver> find_pilots(const World& world, const FrameSpec& spec) {
    const float shrink = std::sqrt(pilot_count / float(spec.size.pixels()));
    const auto coarse = [&](int pixels) { return std::max(int(float(pixels) * shrink), 1); };
    const ImageSize size{coarse(spec.size.width), coarse(spec.size.height)};
    std::vector<PixelSample> pixels(size.pixels());
    std::vector<Receiver> pilots;
    trace_eye_rays(world, Pinhole(spec.camera, size),
                   {size, {0, 0, size.width, size.height}, 0, hash(spec.settings.seed, 3)}, pixels,
                   pilots);
    return pilots;
}

/// All lights, or where there are many those that matter to the view.
std::shared_ptr<const Lights> lights_of(const FrameSpec& spec, const Surfaces& surfaces,
                                        const Lights& lights, const Tracer& tracer) {
    const RenderSettings& settings = spec.settings;
    if (settings.integrator != Integrator::igi || !settings.track_lights || !lights.has_tree())
        return {std::shared_ptr<void>(), &lights};
    const World world{surfaces, lights, tracer};
    std::uint64_t rays = 0;
    LightEstimates estimates =
        scout_lights(world, spec.camera, spec.size, hash(settings.seed, 5), rays);
    recall(spec.lights, estimates);
    return std::make_shared<const Lights>(lights.tracked(estimates));
}

/// Of each tile, whether lamps may be seen in it or beside it, straight from the eye.
std::vector<bool> tiles_at_lamps(const FrameSpec& spec, const Pinhole& camera,
                                 const Lights& lights) {
    std::vector<bool> out(tile_count(spec.size));
    const auto tile_at = [](float raster, int border, int pixels) {
        return int(std::clamp(raster + float(border), 0.0f, float(pixels - 1))) / tile_size;
    };
    for (std::size_t i = 0; i < lights.triangle_count(); ++i) {
        const WorldTriangle& lamp = lights.triangle(i);
        vec2 lo(infinity), hi(-infinity);
        bool in_front = false;
        for (const vec3& p : {lamp.p0, lamp.p1, lamp.p2}) {
            const std::optional<vec2> at = camera.raster(p);
            in_front = in_front || at;
            lo = at ? glm::min(lo, *at) : vec2(-infinity);
            hi = at ? glm::max(hi, *at) : vec2(infinity);
        }
        const auto [width, height] = spec.size;
        if (!(in_front && hi.x > -1 && hi.y > -1 && lo.x < float(width) + 1 &&
              lo.y < float(height) + 1))
            continue;
        for (int y = tile_at(lo.y, -1, height); y <= tile_at(hi.y, 1, height); ++y)
            for (int x = tile_at(lo.x, -1, width); x <= tile_at(hi.x, 1, width); ++x)
                out[std::size_t(y) * tiles_across(spec.size) + std::size_t(x)] = true;
    }
    return out;
}

bool holds(const Rect& rect, const ivec2& pixel) {
    return pixel.x >= rect.x0 && pixel.x < rect.x1 && pixel.y >= rect.y0 && pixel.y < rect.y1;
}

/// A frame between begin_frame and end_frame.
class FrameState {
public:
    FrameState(const FrameSpec& spec, const Surfaces& surfaces, const Lights& lights,
               const Caustics& caustics, std::shared_ptr<const Tracer> tracer, bool has_rest)
        : spec_(spec),
          tracer_(std::move(tracer)),
          lights_(lights_of(spec, surfaces, lights, *tracer_)),
          world_{surfaces, *lights_, *tracer_,
                 spec.settings.integrator == Integrator::path ? Lobes::all : Lobes::broad},
          camera_(spec.camera, spec.size),
          at_lamps_(tiles_at_lamps(spec, camera_, lights)),
          vpl_config_(vpl_config(spec.settings, surfaces.bounds())),
          has_rest_(has_rest),
          caustics_(caustics),
          photon_config_(plan_photons(world_, caustics, spec.settings.integrator, spec.size,
                                      hash(spec.settings.seed, 4))) {
        if (spec.settings.integrator != Integrator::igi) return;
        vpl_config_.paths = count_light_paths(world_, vpl_config_);
        pilots_ = find_pilots(world_, spec);
    }

    const FrameSpec& spec() const { return spec_; }

    /// The lights to choose from.
    const Lights& lights() const { return *lights_; }

    /// `part` of a tile, with the pixels around it that trace_eye_rays() asks about rims: beyond
    /// the tile's border only where it matters most.
    Rect with_neighbours(const Rect& part, std::uint32_t tile) const {
        const Rect within = at_lamps_[tile] ? Rect{0, 0, spec_.size.width, spec_.size.height}
                                            : tile_rect(spec_.size, tile);
        return {std::max(part.x0 - 1, within.x0), std::max(part.y0 - 1, within.y0),
                std::min(part.x1 + 1, within.x1), std::min(part.y1 + 1, within.y1)};
    }

    /// One pass of one tile, of which the pixels in `wanted` get their light; returns the number of
    /// rays traced. Adds what each light sends to `tally`, unless it is null.
    std::uint64_t trace(const TilePass& tile, const Rect& wanted, std::span<PixelSample> pixels,
                        LightTally* tally) {
        std::vector<Receiver> receivers;
        std::uint64_t rays = trace_eye_rays(world_, camera_, tile, pixels, receivers);
        if (wanted != tile.rect)
            std::erase_if(receivers,
                          [&](const Receiver& r) { return !holds(wanted, tile.raster(r.pixel)); });
        const RenderSettings& settings = spec_.settings;
        const bool has_photons = photon_config_.count > 0;
        if (settings.integrator == Integrator::path) {
            const auto pass = has_photons ? light_of(tile.pass, rays) : nullptr;
            return rays + trace_paths(world_, tile, settings.bounces,
                                      pass ? &pass->photons : nullptr, receivers, pixels);
        }
        const auto pass = light_of(tile.pass, rays);
        const IgiConfig config{
            .interleave = vpl_config_.interleave,
            .max_geometry = vpl_config_.max_geometry,
            .bounces = settings.bounces,
            .filter_angle = float(vpl_config_.interleave) * camera_.pixel_width(),
            .has_rest = has_rest_,
            .photons = has_photons ? &pass->photons : nullptr,
            .caustics = &caustics_,
            .tally = tally};
        rays += gather_direct(world_, tile, config, receivers, pixels);
        rays += gather_indirect(world_, tile, config, pass->sets, receivers, pixels);
        return rays + gather_rest(world_, tile, config, pass->sets, receivers, pixels);
    }

private:
    /// What walks from the lights leave behind.
    struct PassLight {
        std::once_flag made;
        VplSets sets;
        PhotonMap photons;
    };

    /// The first who asks for a pass makes its VPLs and photons and counts their rays; others wait
    /// for them.
    std::shared_ptr<const PassLight> light_of(std::uint32_t pass, std::uint64_t& rays) {
        const std::shared_ptr<PassLight> entry = entry_of(pass);
        std::call_once(entry->made, [&] {
            if (spec_.settings.integrator == Integrator::igi) {
                entry->sets = make_vpl_sets(world_, vpl_config_, pass, pilots_);
                rays += entry->sets.rays;
            }
            if (photon_config_.count > 0)
                entry->photons = make_photon_map(world_, caustics_, photon_config_, pass, rays);
        });
        return entry;
    }

    std::shared_ptr<PassLight> entry_of(std::uint32_t pass) {
        const std::lock_guard lock(mutex_);
        std::shared_ptr<PassLight>& slot = passes_[pass];
        if (!slot) slot = std::make_shared<PassLight>();
        const std::shared_ptr<PassLight> entry = slot;
        if (passes_.size() > kept_passes) passes_.erase(passes_.begin());
        return entry;
    }

    FrameSpec spec_;
    std::shared_ptr<const Tracer> tracer_;
    std::shared_ptr<const Lights> lights_;
    World world_;
    Pinhole camera_;
    std::vector<bool> at_lamps_;  ///< by tile
    VplConfig vpl_config_;
    bool has_rest_;
    const Caustics& caustics_;
    PhotonConfig photon_config_;
    std::vector<Receiver> pilots_;
    std::mutex mutex_;
    std::map<std::uint32_t, std::shared_ptr<PassLight>> passes_;
};

/// Leaves those of `rect` that are in `part`.
void crop(std::vector<PixelSample>& samples, const Rect& rect, const Rect& part) {
    if (part == rect) return;
    std::size_t kept = 0;
    for (int y = part.y0; y < part.y1; ++y)
        for (int x = part.x0; x < part.x1; ++x)
            samples[kept++] = samples[std::size_t((y - rect.y0) * rect.width() + x - rect.x0)];
    samples.resize(kept);
}

/// The value of a channel with three floats.
vec3 value(Channel channel, const PixelSample& s, Integrator integrator) {
    const bool whole = integrator == Integrator::path;
    const vec3 brdf = s.albedo / pi;
    switch (channel) {
        case Channel::radiance:
            return whole ? s.emitted + brdf * (s.direct + s.indirect) : s.emitted;
        case Channel::irradiance:
            return s.direct + s.indirect;
        case Channel::albedo:
            return s.albedo;
        case Channel::normal:
            return s.normal;
        case Channel::direct:
            return s.emitted + brdf * s.direct;
        case Channel::indirect:
            return brdf * s.indirect;
        default:
            break;
    }
    return vec3(0);
}

bool summed(Channel channel) {
    return channel != Channel::normal && channel != Channel::depth && channel != Channel::surface &&
           channel != Channel::path_length;
}

/// Adds one channel of a pass to `plane`, the channel's part of the result. Returns the number of
/// values that were not finite.
std::uint64_t add_channel(Channel channel, Integrator integrator,
                          std::span<const PixelSample> samples, std::span<float> plane) {
    std::uint64_t sanitised = 0;
    for (std::size_t i = 0; i < samples.size(); ++i) {
        if (channel == Channel::depth) {
            plane[i] = samples[i].depth;
        } else if (channel == Channel::path_length) {
            plane[i] = samples[i].path_length;
        } else if (channel == Channel::surface) {
            plane[i] = std::bit_cast<float>(samples[i].surface);
        } else {
            const vec3 v = value(channel, samples[i], integrator);
            for (int c = 0; c < 3; ++c) {
                if (std::isfinite(v[c]))
                    plane[3 * i + c] += v[c];
                else
                    ++sanitised;
            }
        }
    }
    return sanitised;
}

void add_pass(const FrameSpec& spec, std::span<const PixelSample> samples, bool first,
              TileResult& result) {
    const ChannelSet channels = tile_channels(spec);
    std::size_t offset = 0;
    for (int c = 0; c < channel_count; ++c) {
        const auto channel = Channel(c);
        if (!channels.has(channel)) continue;
        const std::size_t size = samples.size() * floats_per_pixel(channel);
        if (first || summed(channel))
            result.sanitised += add_channel(channel, spec.settings.integrator, samples,
                                            std::span(result.data).subspan(offset, size));
        offset += size;
    }
}

bool has_cutouts(const Scene& scene) {
    return std::any_of(scene.materials.begin(), scene.materials.end(),
                       [](const Material& m) { return m.alpha_mode != AlphaMode::opaque; });
}

/// Null until it is asked for.
struct BuiltTracer {
    std::shared_ptr<const Tracer> before;  ///< of the version before, until it is built
    std::shared_ptr<const Tracer> plain;
    std::shared_ptr<const Tracer> tracer;  ///< that knows of holes
};

}  // namespace

struct Renderer::State {
    State(const Scene& scene, const BlobStore& blobs, const RendererConfig& renderer_config,
          State* before)
        : config(renderer_config),
          surfaces(scene, blobs, before ? &before->surfaces : nullptr, renderer_config.shaders),
          lights(surfaces, surfaces.bounds()),
          caustics(surfaces),
          has_rest(std::ranges::any_of(surfaces.scene().materials,
                                       [&](const Material& m) { return surfaces.has_rest(m); })),
          plan(make_plan(surfaces.scene(), surfaces, lights, caustics)) {
        if (!before) return;
        const std::lock_guard lock(before->build_mutex);
        for (std::size_t i = 0; i < tracers.size(); ++i)
            tracers[i].before = before->tracers[i].plain;
    }

    std::shared_ptr<const Tracer> tracer(TracerKind kind) {
        const std::lock_guard lock(build_mutex);
        BuiltTracer& slot = tracers[std::size_t(kind)];
        if (!slot.plain) {
            const auto start = Clock::now();
            slot.plain = build_tracer(kind, surfaces.tracer_objects(), surfaces.tracer_instances(),
                                      config.threads, slot.before.get());
            slot.before.reset();
            slot.tracer =
                has_cutouts(surfaces.scene()) ? with_cutouts(slot.plain, surfaces) : slot.plain;
            build_seconds = build_seconds + seconds_since(start);
        }
        return slot.tracer;
    }

    std::shared_ptr<FrameState> find(std::uint64_t frame) {
        const std::lock_guard lock(frames_mutex);
        const auto it = frames.find(frame);
        return it == frames.end() ? nullptr : it->second;
    }

    RendererConfig config;
    Surfaces surfaces;
    Lights lights;
    Caustics caustics;
    bool has_rest;
    ScenePlan plan;
    std::mutex build_mutex;
    std::array<BuiltTracer, 2> tracers;
    std::atomic<double> build_seconds = 0;
    std::mutex frames_mutex;
    std::map<std::uint64_t, std::shared_ptr<FrameState>> frames;
};

Renderer::Renderer(const Scene& scene, const BlobStore& blobs, const RendererConfig& config,
                   const Renderer* before)
    : state_(
          std::make_unique<State>(scene, blobs, config, before ? before->state_.get() : nullptr)) {}

Renderer::~Renderer() = default;

const ScenePlan& Renderer::plan() const { return state_->plan; }

double Renderer::build_seconds() const { return state_->build_seconds; }

void Renderer::prepare(TracerKind tracer) { state_->tracer(tracer); }

void Renderer::begin_frame(const FrameSpec& spec) {
    if (state_->find(spec.frame)) return;
    const auto frame =
        std::make_shared<FrameState>(spec, state_->surfaces, state_->lights, state_->caustics,
                                     state_->tracer(spec.settings.tracer), state_->has_rest);
    const std::lock_guard lock(state_->frames_mutex);
    state_->frames.emplace(spec.frame, frame);
}

void Renderer::end_frame(std::uint64_t frame) {
    const std::lock_guard lock(state_->frames_mutex);
    state_->frames.erase(frame);
}

std::optional<TileResult> Renderer::render(const TileTask& task) const {
    const std::shared_ptr<FrameState> frame = state_->find(task.frame);
    if (!frame) return {};
    const auto start = Clock::now();
    const FrameSpec& spec = frame->spec();
    CHECK(task.tile < tile_count(spec.size));
    const Rect part = rect_of(spec.size, task);
    const Rect rect = frame->with_neighbours(part, task.tile);
    TileResult result;
    result.task = task;
    result.data.resize(part.pixels() * std::size_t(floats_per_pixel(tile_channels(spec))));
    std::vector<PixelSample> samples;
    std::optional<LightTally> tally;
    if (frame->lights().is_tracked()) tally.emplace(frame->lights().size(), rect);
    for (std::uint32_t i = 0; i < task.pass_count; ++i) {
        samples.assign(rect.pixels(), {});
        result.rays += frame->trace({spec.size, rect, task.first_pass + i,
                                     hash(spec.settings.seed, 1), spec.settings.passes},
                                    part, samples, tally ? &*tally : nullptr);
        crop(samples, rect, part);
        add_pass(spec, samples, i == 0, result);
    }
    if (tally) {
        result.lights = tally->estimates();
        result.active_lights = std::uint32_t(frame->lights().active_count());
    }
    result.seconds = float(seconds_since(start));
    return result;
}

}  // namespace tessera
