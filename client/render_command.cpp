// tessera render: one picture of a scene to a file, on the embedded cluster or on a server.

#include <fmt/format.h>

#include <chrono>
#include <fstream>
#include <nlohmann/json.hpp>
#include <sstream>

#include "client/camera_options.h"
#include "client/checkpoint.h"
#include "client/commands.h"
#include "client/interrupt.h"
#include "client/local_cluster.h"
#include "client/progress_bar.h"
#include "client/render_client.h"
#include "client/sequence.h"
#include "common/animate.h"
#include "common/check.h"
#include "common/contained_load.h"
#include "common/false_colour.h"
#include "common/image_io.h"
#include "common/message_codec.h"
#include "common/scene_bounds.h"

namespace tessera {
namespace {

using Clock = std::chrono::steady_clock;

struct RenderOptions {
    std::string scene;
    std::string environment;
    std::string output;
    CameraOptions camera;
    Integrator integrator = Integrator::igi;
    TracerKind tracer = TracerKind::kdtree;
    FilterPlace filter = FilterPlace::server;
    std::optional<std::uint32_t> passes, antialiasing;
    std::uint32_t vpls = 8;
    RenderSettings settings;
    double time_limit = 0;
    double error_limit = 0;
    ToneMap tone_map;
    std::vector<Channel> aov;
    Channel shown = Channel::radiance;
    std::string server;
    std::string keys;
    LocalClusterConfig cluster;
    std::string checkpoint;
    int checkpoint_seconds = 60;
    std::string stats;
    std::string animate;
};

/// Refinement goes on this long when only a limit of time or error is given.
constexpr std::uint32_t passes_without_end = 1u << 20;

/// N eye rays share a pixel's M VPLs (Wald 2004, 13.3.4) as N passes of M/N VPLs each.
RenderSettings settings_of(const RenderOptions& options) {
    const bool igi = options.integrator == Integrator::igi;
    const std::uint32_t antialiasing = options.antialiasing.value_or(igi ? 4 : 1);
    const bool limited = options.time_limit > 0 || options.error_limit > 0;
    const std::uint32_t passes = options.passes.value_or(limited ? passes_without_end
                                                         : igi   ? 1
                                                                 : 64);
    RenderSettings settings = options.settings;
    settings.integrator = options.integrator;
    settings.tracer = options.tracer;
    settings.filter = options.filter;
    settings.passes = std::uint32_t(
        std::min<std::uint64_t>(std::uint64_t(passes) * antialiasing, passes_without_end));
    settings.vpls = std::max(1u, options.vpls / antialiasing);
    return settings;
}

FrameRequest request_of(const RenderOptions& options, const std::string& scene,
                        const Camera& camera) {
    FrameRequest request;
    request.spec.scene = scene;
    request.spec.size = options.camera.size;
    request.spec.camera = camera;
    request.spec.settings = settings_of(options);
    for (const Channel channel : options.aov) request.spec.extra = request.spec.extra.with(channel);
    if (options.shown != Channel::radiance)
        request.spec.extra = request.spec.extra.with(options.shown);
    request.format =
        keeps_linear(options.output) ? PictureFormat::linear_float : PictureFormat::srgb8;
    request.tone_map = options.tone_map;
    request.time_limit = options.time_limit;
    request.error_limit = options.error_limit;
    return request;
}

std::string aov_file(const std::string& output, const std::string& name) {
    return std::filesystem::path(output).replace_extension("." + name + ".exr").string();
}

/// The picture last: where it is, the others are.
void write_pictures(const RenderOptions& options, const FrameRequest& request,
                    const RenderedFrame& frame, const std::string& output) {
    for (const auto& [name, channel] : channel_names())
        if (std::find(options.aov.begin(), options.aov.end(), channel) != options.aov.end())
            write_image(frame.channels.at(channel), aov_file(output, name));
    const Channel shown = options.shown;
    write_atomically(output, [&](const std::string& file) {
        if (request.format == PictureFormat::srgb8)
            write_srgb8(shown == Channel::radiance
                            ? frame.srgb8
                            : to_rgb8(frame.channels.at(shown), shown, options.tone_map),
                        options.camera.size, file);
        else
            write_image(frame.channels.at(shown), file);
    });
}

void write_statistics(const std::string& file, double load_seconds, const FrameStatistics& s) {
    nlohmann::json json = {{"load_seconds", load_seconds},
                           {"build_seconds", s.build_seconds},
                           {"render_seconds", s.render_seconds},
                           {"passes", s.passes},
                           {"rays", s.rays},
                           {"sanitised_values", s.sanitised},
                           {"tiles_reissued", s.tiles_reissued},
                           {"error_estimate", s.error_estimate},
                           {"plan", {{"modelled", s.modelled}, {"left_out", s.left_out}}},
                           {"active_lights", s.active_lights},
                           {"lights", nlohmann::json::array()},
                           {"workers", nlohmann::json::array()}};
    for (const LightEstimate& e : s.lights)
        json["lights"].push_back({{"light", e.light}, {"radiance", e.radiance}});
    for (const WorkerShare& w : s.workers)
        json["workers"].push_back(
            {{"name", w.name}, {"threads", w.threads}, {"tiles", w.tiles}, {"rays", w.rays}});
    std::ofstream out(file);
    out << json.dump(2) << '\n';
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", file));
}

/// Shows a frame's progress, and says so when it stands still for want of workers.
class ProgressView {
public:
    explicit ProgressView(ProgressBar& bar) : bar_(bar) {}

    void report(const FrameProgress& p) {
        if (p.workers > 0)
            idle_since_.reset();
        else if (!idle_since_)
            idle_since_ = Clock::now();
        const std::string error =
            p.error_estimate > 0 ? fmt::format(", error about {:.4f}", p.error_estimate) : "";
        bar_.show(p.tiles_done, p.tiles_total, fmt::format("{} workers{}", p.workers, error));
    }

    void tick() {
        constexpr std::chrono::seconds patience{1};
        if (idle_since_ && Clock::now() - *idle_since_ > patience)
            bar_.note("no worker is ready: waiting for one");
    }

private:
    ProgressBar& bar_;
    std::optional<Clock::time_point> idle_since_;
};

/// With its motion, which a contained reader does not tell, where that is needed.
LoadedScene read_scene(const RenderOptions& options) {
    if (options.animate.empty()) return load_contained(options.scene, options.environment);
    LoadedScene loaded = load_scene(options.scene);
    if (!options.environment.empty()) set_environment(loaded.bundle, options.environment);
    return loaded;
}

LoadedScene load(const RenderOptions& options, ProgressBar& bar) {
    const LoadedScene loaded = read_scene(options);
    for (const std::string& note : loaded.notes) bar.note(note);
    if (!has_light(loaded.bundle.scene))
        bar.note("no light in the scene: the picture will be black");
    return loaded;
}

/// One picture, in spite of lost servers, and with what a checkpoint holds.
RenderedFrame render(const RenderOptions& options, RenderClient& client, const SceneBundle& bundle,
                     FrameRequest request, Checkpoint* checkpoint, ProgressBar& bar,
                     const std::function<void(const FrameProgress&)>& progress) {
    for (;;) {
        const SavedSums begun = checkpoint ? checkpoint->load() : SavedSums{};
        if (!begun.sums.empty())
            bar.note(fmt::format("goes on from {}, after {:.1f} s of rendering", options.checkpoint,
                                 begun.render_seconds));
        if (options.time_limit > 0)
            request.time_limit = std::max(options.time_limit - begun.render_seconds, 1e-3);
        try {
            client.upload_scene(request.spec.scene, bundle);
            RenderedFrame frame = client.render(request, progress, begun);
            frame.statistics.render_seconds += begun.render_seconds;
            frame.statistics.rays += begun.rays;
            return frame;
        } catch (const ServerLost& lost) {
            bar.note(checkpoint ? lost.what()
                                : fmt::format("{}: begins anew; with --checkpoint FILE it would go "
                                              "on from what was saved last",
                                              lost.what()));
        }
    }
}

/// The same, saved to the checkpoint now and then, and when the user interrupts.
RenderedFrame render_and_save(const RenderOptions& options, RenderClient& client,
                              const SceneBundle& bundle, const FrameRequest& request,
                              ProgressView& view, ProgressBar& bar) {
    Checkpoint checkpoint(options.checkpoint, checkpoint_key(bundle.scene, request),
                          std::chrono::seconds(options.checkpoint_seconds));
    bool rendering = false;
    try {
        return render(options, client, bundle, request, &checkpoint, bar,
                      [&](const FrameProgress& p) {
                          rendering = true;
                          view.report(p);
                          checkpoint.tick(client);
                      });
    } catch (const Interrupted&) {
        if (rendering) {
            checkpoint.save_now(client);
            bar.note(fmt::format("saved to {}: the same command goes on from there",
                                 options.checkpoint));
        }
        throw;
    }
}

/// Renders the picture to `output`.
FrameStatistics render_picture(const RenderOptions& options, const SceneBundle& bundle,
                               const std::string& output, RenderClient& client, ProgressView& view,
                               ProgressBar& bar) {
    const Camera camera =
        chosen_camera(options.camera, bundle, [&](const std::string& note) { bar.note(note); });
    const FrameRequest request =
        request_of(options, std::filesystem::path(options.scene).filename().string(), camera);
    const RenderedFrame frame = options.checkpoint.empty()
                                    ? render(options, client, bundle, request, nullptr, bar,
                                             [&](const FrameProgress& p) { view.report(p); })
                                    : render_and_save(options, client, bundle, request, view, bar);
    write_pictures(options, request, frame, output);
    if (!options.checkpoint.empty()) std::filesystem::remove(options.checkpoint);
    return frame.statistics;
}

/// One picture after another; those that are there already are left alone.
void render_sequence(const RenderOptions& options, const SceneBundle& bundle, RenderClient& client,
                     ProgressView& view, ProgressBar& bar) {
    const Sequence sequence = parse_sequence(options.animate);
    if (bundle.motion.empty())
        throw UserError(
            fmt::format("{}: nothing in it moves by itself; leave --animate away", options.scene));
    std::uint32_t skipped = 0;
    double seconds = 0;
    for (std::uint32_t i = 0; i < sequence.count(); ++i) {
        const std::string output = numbered_file(options.output, i);
        if (is_whole_picture(output, options.camera.size)) {
            ++skipped;
            continue;
        }
        seconds += render_picture(options, bundle_at(bundle, sequence.seconds(i)), output, client,
                                  view, bar)
                       .render_seconds;
    }
    bar.note(fmt::format("{}: {} pictures in {:.2f} s of rendering, {} were there already",
                         options.output, sequence.count() - skipped, seconds, skipped));
}

void run(const RenderOptions& options) {
    Interrupt interrupt;
    ProgressBar bar;
    check_writable_format(options.output);
    if (!options.animate.empty()) {
        parse_sequence(options.animate);
        numbered_file(options.output, 0);
    }
    const auto load_start = Clock::now();
    const LoadedScene loaded = load(options, bar);
    const std::chrono::duration<double> load_time = Clock::now() - load_start;

    ProgressView view(bar);
    std::optional<LocalCluster> cluster;
    if (options.server.empty()) cluster.emplace(options.cluster);
    RenderClient client(
        {.address = cluster ? cluster->address() : options.server,
         .credentials = cluster ? cluster->credentials() : load_credentials(options.keys),
         .tick =
             [&] {
                 interrupt.check();
                 view.tick();
                 if (cluster) cluster->check_alive();
             },
         .reconnects = !cluster});
    if (!options.animate.empty()) return render_sequence(options, loaded.bundle, client, view, bar);
    const FrameStatistics s =
        render_picture(options, loaded.bundle, options.output, client, view, bar);
    if (!options.stats.empty()) write_statistics(options.stats, load_time.count(), s);
    if (s.sanitised > 0)
        bar.note(fmt::format("{} values were not finite and were set to zero", s.sanitised));
    bar.note(fmt::format(
        "{}: {} passes in {:.2f} s ({:.1f} Mrays/s), built in {:.2f} s, loaded in {:.2f} s",
        options.output, s.passes, s.render_seconds,
        1e-6 * double(s.rays) / std::max(1e-9, s.render_seconds), s.build_seconds,
        load_time.count()));
}

void add_quality_options(CLI::App* command, RenderOptions& o) {
    const std::map<std::string, Integrator> integrators = {{"igi", Integrator::igi},
                                                           {"path", Integrator::path}};
    const std::map<std::string, TracerKind> tracers = {{"kdtree", TracerKind::kdtree},
                                                       {"embree", TracerKind::embree}};
    const std::map<std::string, bool> switches = {{"on", true}, {"off", false}};
    const std::map<std::string, FilterPlace> filters = {
        {"auto", FilterPlace::server}, {"server", FilterPlace::server}, {"off", FilterPlace::off}};
    command->add_option("--integrator", o.integrator, "igi (interactive) or path (the reference)")
        ->transform(CLI::CheckedTransformer(integrators));
    command
        ->add_option("--vpls", o.vpls,
                     "igi: virtual point lights per pixel, shared by its eye rays")
        ->check(CLI::Range(1, 4096))
        ->capture_default_str();
    command->add_option("--interleave", o.settings.interleave, "igi: n, for n x n interleaved sets")
        ->check(CLI::IsMember({1, 3, 5, 7, 9}))
        ->capture_default_str();
    command->add_option("--bounces", o.settings.bounces, "indirect bounces at most")
        ->check(CLI::Range(0, 1000))
        ->capture_default_str();
    command->add_option("--aa", o.antialiasing, "eye rays per pixel and pass (igi 4, path 1)")
        ->check(CLI::Range(1, 64));
    command->add_option("--passes", o.passes, "passes whose mean is the picture (igi 1, path 64)")
        ->check(CLI::Range(1u, passes_without_end));
    command->add_option("--time", o.time_limit, "stop after that many seconds of rendering")
        ->check(CLI::PositiveNumber);
    command->add_option("--error", o.error_limit, "stop at that estimate of the error")
        ->check(CLI::PositiveNumber);
    command->add_option("--seed", o.settings.seed, "another seed, another noise");
    command->add_option("--tracer", o.tracer, "kdtree or embree")
        ->transform(CLI::CheckedTransformer(tracers));
    command
        ->add_option("--light-tracking", o.settings.track_lights,
                     "igi: of many lights, find those that matter to the view: on or off")
        ->transform(CLI::CheckedTransformer(switches))
        ->default_str("on");
    command
        ->add_option("--filter", o.filter,
                     "igi: where the discontinuity filter runs: auto, server, off")
        ->transform(CLI::CheckedTransformer(filters));
}

void add_output_options(CLI::App* command, RenderOptions& o) {
    const std::map<std::string, ToneCurve> curves = {{"srgb", ToneCurve::srgb},
                                                     {"filmic", ToneCurve::filmic}};
    command
        ->add_option("-o,--output", o.output,
                     "picture to write: linear .exr or .hdr, tone-mapped .png, .jpg ...")
        ->required();
    command->add_option("--exposure", o.tone_map.exposure, "stops, for 8-bit pictures")
        ->check(CLI::Range(-32.0, 32.0));
    command->add_option("--tone", o.tone_map.curve, "tone curve of 8-bit pictures: srgb or filmic")
        ->transform(CLI::CheckedTransformer(curves));
    command
        ->add_option("--aov", o.aov,
                     "more channels, each to OUTPUT.CHANNEL.exr: albedo, normal, depth, "
                     "irradiance, direct, indirect, path-length, error, owner")
        ->delimiter(',')
        ->transform(CLI::CheckedTransformer(channel_names()));
    command
        ->add_option("--channel", o.shown,
                     "one of them instead of the picture, in false colours where it is numbers")
        ->transform(CLI::CheckedTransformer(channel_names()));
    auto* animate =
        command->add_option("--animate", o.animate,
                            "FROM:TO:FPS in seconds: pictures of what moves in the scene, numbered "
                            "by the %d in -o (picture_%04d.png); those that are there are kept");
    command->add_option("--stats", o.stats, "statistics to write as JSON")->excludes(animate);
    auto* checkpoint = command->add_option("--checkpoint", o.checkpoint,
                                           "file to save to what is rendered so far, now and then "
                                           "and on Ctrl-C: the same command goes "
                                           "on from it, to the same picture");
    checkpoint->excludes(animate);
    command
        ->add_option("--checkpoint-every", o.checkpoint_seconds,
                     "seconds from one save to the next")
        ->check(CLI::Range(1, 86400))
        ->capture_default_str()
        ->needs(checkpoint);
}

void add_cluster_options(CLI::App* command, RenderOptions& o) {
    auto* server = command->add_option("--server", o.server,
                                       "render on HOST:PORT instead of this machine alone");
    add_keys_option(command, o.keys)->needs(server);
    command->add_option("--workers", o.cluster.workers, "worker processes of the embedded cluster")
        ->check(CLI::Range(1, 64))
        ->capture_default_str()
        ->excludes(server);
    command
        ->add_option("--threads", o.cluster.threads,
                     "render threads per embedded worker (default: all cores, shared out)")
        ->check(CLI::Range(1, 1024))
        ->excludes(server);
    command
        ->add_option("--plugins", o.cluster.plugins,
                     "folder of shader plug-ins for the embedded workers")
        ->type_name("FOLDER")
        ->excludes(server);
    command
        ->add_option(
            "--trace", o.cluster.trace,
            "who rendered which tile when, as a JSON file for chrome://tracing or Perfetto")
        ->excludes(server);
}

}  // namespace

void add_render_command(CLI::App& app) {
    auto options = std::make_shared<RenderOptions>();
    CLI::App* command = app.add_subcommand("render", "Render a picture of a scene to a file");
    command
        ->add_option("SCENE", options->scene,
                     "a .gltf, .glb, .obj or .ply file, or the name of a generated scene")
        ->required();
    command->add_option("--environment", options->environment,
                        "light from all sides: a radiance, or a picture by latitude and longitude "
                        "(.hdr, .exr)");
    add_output_options(command, *options);
    add_camera_options(command, options->camera);
    add_quality_options(command, *options);
    add_cluster_options(command, *options);
    command->callback([options] { run(*options); });
}

}  // namespace tessera
