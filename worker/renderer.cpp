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

/// A frame's VPLs are kept for this many passes; older ones are made again if a late task asks.
constexpr std::size_t kept_passes = 8;

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

/// A frame between begin_frame and end_frame.
class FrameState {
public:
    FrameState(const FrameSpec& spec, const Surfaces& surfaces, const Lights& lights,
               std::shared_ptr<const Tracer> tracer, bool has_rest)
        : spec_(spec),
          tracer_(std::move(tracer)),
          world_{surfaces, lights, *tracer_,
                 spec.settings.integrator == Integrator::path ? Lobes::all : Lobes::broad},
          camera_(spec.camera, spec.size),
          vpl_config_(vpl_config(spec.settings, surfaces.bounds())),
          has_rest_(has_rest) {
        if (spec.settings.integrator != Integrator::igi) return;
        vpl_config_.paths = count_light_paths(world_, vpl_config_);
        pilots_ = find_pilots(world_, spec);
    }

    const FrameSpec& spec() const { return spec_; }

    /// One pass of one tile; returns the number of rays traced.
    std::uint64_t trace(const TilePass& tile, std::span<PixelSample> pixels) {
        std::vector<Receiver> receivers;
        std::uint64_t rays = trace_eye_rays(world_, camera_, tile, pixels, receivers);
        const RenderSettings& settings = spec_.settings;
        if (settings.integrator == Integrator::path)
            return rays + trace_paths(world_, tile, settings.bounces, receivers, pixels);
        const IgiConfig config{
            .interleave = vpl_config_.interleave,
            .max_geometry = vpl_config_.max_geometry,
            .bounces = settings.bounces,
            .filter_angle = float(vpl_config_.interleave) * camera_.pixel_width(),
            .has_rest = has_rest_};
        rays += gather_direct(world_, tile, config, receivers, pixels);
        const auto sets = vpls_of(tile.pass, rays);
        rays += gather_indirect(world_, tile, config, *sets, receivers, pixels);
        return rays + gather_rest(world_, tile, config, *sets, receivers, pixels);
    }

private:
    struct PassVpls {
        std::once_flag made;
        VplSets sets;
    };

    /// The first who asks for a pass makes its VPLs and counts their rays; others wait for them.
    std::shared_ptr<const VplSets> vpls_of(std::uint32_t pass, std::uint64_t& rays) {
        const std::shared_ptr<PassVpls> entry = entry_of(pass);
        std::call_once(entry->made, [&] {
            entry->sets = make_vpl_sets(world_, vpl_config_, pass, pilots_);
            rays += entry->sets.rays;
        });
        return {entry, &entry->sets};
    }

    std::shared_ptr<PassVpls> entry_of(std::uint32_t pass) {
        const std::lock_guard lock(mutex_);
        std::shared_ptr<PassVpls>& slot = passes_[pass];
        if (!slot) slot = std::make_shared<PassVpls>();
        const std::shared_ptr<PassVpls> entry = slot;
        if (passes_.size() > kept_passes) passes_.erase(passes_.begin());
        return entry;
    }

    FrameSpec spec_;
    std::shared_ptr<const Tracer> tracer_;
    World world_;
    Pinhole camera_;
    VplConfig vpl_config_;
    bool has_rest_;
    std::vector<Receiver> pilots_;
    std::mutex mutex_;
    std::map<std::uint32_t, std::shared_ptr<PassVpls>> passes_;
};

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
        case Channel::depth:
        case Channel::surface:
            break;
    }
    return vec3(0);
}

bool summed(Channel channel) {
    return channel != Channel::normal && channel != Channel::depth && channel != Channel::surface;
}

/// Adds one channel of a pass to `plane`, the channel's part of the result. Returns the number of
/// values that were not finite.
std::uint64_t add_channel(Channel channel, Integrator integrator,
                          std::span<const PixelSample> samples, std::span<float> plane) {
    std::uint64_t sanitised = 0;
    for (std::size_t i = 0; i < samples.size(); ++i) {
        if (channel == Channel::depth) {
            plane[i] = samples[i].depth;
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
          surfaces(scene, blobs, before ? &before->surfaces : nullptr),
          lights(surfaces, surfaces.bounds()),
          has_rest(std::any_of(scene.materials.begin(), scene.materials.end(),
                               [&](const Material& m) { return surfaces.has_rest(m); })),
          plan(make_plan(scene, surfaces, lights)) {
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
        std::make_shared<FrameState>(spec, state_->surfaces, state_->lights,
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
    const Rect rect = tile_rect(spec.size, task.tile);
    TileResult result;
    result.task = task;
    result.data.resize(rect.pixels() * std::size_t(floats_per_pixel(tile_channels(spec))));
    std::vector<PixelSample> samples;
    for (std::uint32_t i = 0; i < task.pass_count; ++i) {
        samples.assign(rect.pixels(), {});
        result.rays += frame->trace(
            {spec.size, rect, task.first_pass + i, hash(spec.settings.seed, 1)}, samples);
        add_pass(spec, samples, i == 0, result);
    }
    result.seconds = float(seconds_since(start));
    return result;
}

}  // namespace tessera
