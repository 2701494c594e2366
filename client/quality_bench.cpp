// tessera bench quality: see quality_bench.h.
#include "client/quality_bench.h"

#include <fmt/format.h>

#include <filesystem>
#include <map>

#include "client/camera_options.h"
#include "client/commands.h"
#include "client/interrupt.h"
#include "client/local_cluster.h"
#include "client/progress_bar.h"
#include "client/render_client.h"
#include "common/check.h"
#include "common/contained_load.h"
#include "common/image_io.h"

namespace tessera {
namespace {

struct QualityOptions {
    std::vector<std::string> scenes;
    std::string reference = "auto";
    double reference_time = 60;
    int runs = 3;
    double longest = 5;
    bool quick = false;
    bool lights = false;
    CameraOptions camera;
    LocalClusterConfig cluster;
    std::string output;
};

/// No setting is tried with more passes than this, however fast the machine.
constexpr std::uint32_t most_passes = 4096;

/// Where pictures come from: the embedded cluster with one scene.
class Studio {
public:
    Studio(const QualityOptions& options, const std::string& file)
        : cluster_(options.cluster),
          client_({.address = cluster_.address(),
                   .credentials = cluster_.credentials(),
                   .tick = [this] {
                       interrupt_.check();
                       cluster_.check_alive();
                   }}) {
        const LoadedScene loaded = load_contained(file);
        camera_ = chosen_camera(options.camera, loaded.bundle,
                                [this](const std::string& note) { bar_.note(note); });
        request_.spec.scene = std::filesystem::path(file).stem().string();
        request_.spec.camera = camera_;
        client_.upload_scene(request_.spec.scene, loaded.bundle);
        // The first frame waits for the tracer to be built.
        render({16, 16}, {.passes = 1}, 0);
    }

    const std::string& scene() const { return request_.spec.scene; }

    RenderedFrame render(ImageSize size, const RenderSettings& settings, double time_limit) {
        FrameRequest request = request_;
        request.spec.size = size;
        request.spec.settings = settings;
        request.time_limit = time_limit;
        return client_.render(request, [this](const FrameProgress& p) {
            bar_.show(p.tiles_done, p.tiles_total, fmt::format("{} workers", p.workers));
        });
    }

private:
    Interrupt interrupt_;
    ProgressBar bar_;
    LocalCluster cluster_;
    RenderClient client_;
    Camera camera_;
    FrameRequest request_;
};

/// Mean over runs and the two parts of the error; a mean of n runs keeps 1/n of their variance,
/// which counts as theirs and not as bias.
void split_error(const std::vector<Image>& pictures, const Image& reference, QualityRow& row) {
    const auto clamped = [](float v) { return v > 0 ? std::min(double(v), 1.0) : 0.0; };
    const double n = double(pictures.size());
    double variance = 0, bias = 0;
    for (std::size_t i = 0; i < reference.data.size(); ++i) {
        double sum = 0, squares = 0;
        for (const Image& picture : pictures) sum += clamped(picture.data[i]);
        for (const Image& picture : pictures)
            squares += std::pow(clamped(picture.data[i]) - sum / n, 2);
        variance += n > 1 ? squares / (n - 1) : 0;
        bias += std::pow(sum / n - clamped(reference.data[i]), 2);
    }
    const double values = double(reference.data.size());
    row.deviation = std::sqrt(variance / values);
    row.bias = std::sqrt(std::max(bias - variance / n, 0.0) / values);
}

/// Of the mean of `values`.
double standard_error(const std::vector<double>& values) {
    const double n = double(values.size());
    double mean = 0, squares = 0;
    for (const double v : values) mean += v / n;
    for (const double v : values) squares += (v - mean) * (v - mean);
    return n > 1 ? std::sqrt(squares / (n - 1) / n) : 0;
}

QualityRow measure(Studio& studio, const std::string& integrator, RenderSettings settings,
                   const Image& reference, int runs) {
    QualityRow row;
    row.integrator = integrator;
    row.settings = settings;
    std::vector<Image> pictures;
    std::vector<double> seconds, errors;
    Comparison sum;
    sum.identical = false;
    for (int run = 0; run < runs; ++run) {
        settings.seed = std::uint32_t(run + 1);
        RenderedFrame frame = studio.render(reference.size, settings, 0);
        const Image& picture =
            pictures.emplace_back(std::move(frame.channels.at(Channel::radiance)));
        const Comparison c = compare(picture, reference);
        sum.rmse += c.rmse * c.rmse / runs;
        sum.rmse_clamped += c.rmse_clamped * c.rmse_clamped / runs;
        errors.push_back(c.rmse_clamped);
        row.lights.push_back(frame.statistics.lights);
        row.active_lights = frame.statistics.active_lights;
        sum.relmse += c.relmse / runs;
        sum.delta_e += c.delta_e / runs;
        sum.max_abs = std::max(sum.max_abs, c.max_abs);
        sum.mean_a += c.mean_a / runs;
        sum.mean_b = c.mean_b;
        seconds.push_back(frame.statistics.render_seconds);
        row.mrays += 1e-6 * double(frame.statistics.rays) / runs;
        row.estimate += std::pow(frame.statistics.error_estimate, 2) / runs;
    }
    sum.rmse = std::sqrt(sum.rmse);
    sum.rmse_clamped = std::sqrt(sum.rmse_clamped);
    row.error = sum;
    row.estimate = std::sqrt(row.estimate);
    row.rmse_error = standard_error(errors);
    std::nth_element(seconds.begin(), seconds.begin() + runs / 2, seconds.end());
    row.seconds = seconds[std::size_t(runs / 2)];
    split_error(pictures, reference, row);
    row.picture = std::move(pictures.front());
    return row;
}

void print_header(const QualityResult& result) {
    fmt::print("{}: reference {}", result.scene, result.reference);
    if (result.reference_error > 0) fmt::print(", error about {:.5f}", result.reference_error);
    fmt::print(
        "\n{:<12} {:>6} {:>4} {:>2} {:>6} {:>7} {:>8} {:>8} {:>8} {:>8} {:>8} {:>8} {:>7} {:>7}\n",
        "integrator", "passes", "vpls", "n", "filter", "bounces", "seconds", "rmse", "estimate",
        "bias", "deviat.", "relmse", "deltaE", "mean");
}

void print_row(const QualityRow& row) {
    const RenderSettings& s = row.settings;
    const bool igi = s.integrator == Integrator::igi;
    fmt::print(
        "{:<12} {:>6} {:>4} {:>2} {:>6} {:>7} {:>8.3f} {:>8.5f} {:>8.5f} {:>8.5f} {:>8.5f} "
        "{:>8.5f} {:>7.3f} {:>7.4f}\n",
        row.integrator, s.passes, igi ? fmt::format("{}", s.vpls) : "-",
        igi ? fmt::format("{}", s.interleave) : "-",
        !igi                           ? "-"
        : s.filter == FilterPlace::off ? "off"
                                       : "on",
        s.bounces, row.seconds, row.error.rmse_clamped, row.estimate, row.bias, row.deviation,
        row.error.relmse, row.error.delta_e, row.error.mean_a / row.error.mean_b);
    std::fflush(stdout);
}

/// The defaults, and one setting of each kind changed at a time.
std::vector<RenderSettings> igi_settings() {
    const RenderSettings usual;
    std::vector<RenderSettings> out{usual};
    const auto with = [&](auto change) {
        RenderSettings settings = usual;
        change(settings);
        if (settings != usual) out.push_back(settings);
    };
    for (const std::uint32_t vpls : {1, 2, 4, 8}) with([&](RenderSettings& s) { s.vpls = vpls; });
    for (const std::uint32_t interleave : {1, 3, 5, 7, 9})
        with([&](RenderSettings& s) { s.interleave = interleave; });
    for (const std::uint32_t bounces : {1, 3})
        with([&](RenderSettings& s) { s.bounces = bounces; });
    with([](RenderSettings& s) { s.filter = FilterPlace::off; });
    return out;
}

QualityResult make_reference(Studio& studio, const QualityOptions& options) {
    QualityResult result;
    result.scene = studio.scene();
    if (options.reference != "auto") {
        result.reference = std::filesystem::path(options.reference).filename().string();
        result.reference_picture = read_image(options.reference);
        return result;
    }
    // Another seed than those measured.
    RenderedFrame frame = studio.render(
        options.camera.size, {.integrator = Integrator::path, .passes = 1u << 20, .seed = 0x5eed},
        options.reference_time);
    result.reference = fmt::format("path, {} passes", frame.statistics.passes);
    result.reference_error = frame.statistics.error_estimate;
    result.reference_picture = std::move(frame.channels.at(Channel::radiance));
    return result;
}

// ---- Light tracking -----------------------------------------------------------------------------

using LightShares = std::map<std::uint32_t, double>;

LightShares shares_of(const std::vector<LightEstimate>& lights) {
    double sum = 0;
    for (const LightEstimate& e : lights) sum += double(e.radiance);
    LightShares shares;
    for (const LightEstimate& e : lights) shares[e.light] = double(e.radiance) / sum;
    return shares;
}

/// How far estimates are from the converged ones, for lights of at least a share of all light.
void print_estimates(const std::vector<LightEstimate>& converged, const QualityRow& row) {
    constexpr double great = 0.02;
    const LightShares wanted = shares_of(converged);
    double worst = 0, squares = 0;
    int count = 0;
    for (const auto& lights : row.lights) {
        LightShares got = shares_of(lights);
        for (const auto& [light, share] : wanted) {
            if (share < great) continue;
            const double off = std::abs(got[light] / share - 1);
            worst = std::max(worst, off);
            squares += off * off;
            ++count;
        }
    }
    const int of_each = count / int(row.lights.size());
    fmt::print("{} active lights; estimates of {} lights that send more than {:.0f} % each",
               row.active_lights, of_each, 100 * great);
    if (count > 0)
        fmt::print(" are off by {:.1f} % (RMS), {:.1f} % at most", 100 * std::sqrt(squares / count),
                   100 * worst);
    fmt::print("\n");
}

/// With light tracking against without, at equal time. The reference is igi's, which sees more in
/// the same time than our path tracer.
QualityResult compare_lights(const QualityOptions& options, const std::string& file) {
    Studio studio(options, file);
    QualityResult result;
    result.scene = studio.scene();
    const RenderedFrame converged = studio.render(
        options.camera.size, {.passes = 1u << 20, .seed = 0x5eed}, options.reference_time);
    result.reference = fmt::format("refined igi, {} passes", converged.statistics.passes);
    result.reference_error = converged.statistics.error_estimate;
    result.reference_picture = options.reference == "auto"
                                   ? converged.channels.at(Channel::radiance)
                                   : read_image(options.reference);
    print_header(result);
    RenderSettings settings;
    const auto add = [&](const std::string& name, int runs) {
        return measure(studio, name, settings, result.reference_picture, runs);
    };
    const QualityRow with = add("tracked", options.runs);
    print_row(with);
    settings.track_lights = false;
    const double seconds = add("", 1).seconds;
    settings.passes =
        std::uint32_t(std::max(std::lround(double(settings.passes) * with.seconds / seconds), 1L));
    const QualityRow without = add("not tracked", options.runs);
    print_row(without);
    const double ratio = without.error.rmse_clamped / with.error.rmse_clamped;
    fmt::print("at equal time {:.2f} +- {:.2f} times the error without light tracking\n", ratio,
               ratio * std::hypot(with.rmse_error / with.error.rmse_clamped,
                                  without.rmse_error / without.error.rmse_clamped));
    print_estimates(converged.statistics.lights, with);
    std::fflush(stdout);
    result.rows = {with, without};
    return result;
}

QualityResult bench_scene(const QualityOptions& options, const std::string& file) {
    Studio studio(options, file);
    QualityResult result = make_reference(studio, options);
    print_header(result);
    const int runs = options.quick ? 1 : options.runs;
    const auto add = [&](const std::string& integrator, const RenderSettings& settings) {
        result.rows.push_back(
            measure(studio, integrator, settings, result.reference_picture, runs));
        print_row(result.rows.back());
        return result.rows.back().seconds;
    };
    const double longest = options.quick ? 0 : options.longest;
    const auto refine = [&](const std::string& integrator, RenderSettings settings) {
        double seconds = 0;
        for (settings.passes = 1; settings.passes <= most_passes; settings.passes *= 2) {
            seconds = add(integrator, settings);
            if (2 * seconds > longest) break;
        }
    };
    refine("refined igi", {});
    refine("path", {.integrator = Integrator::path});
    if (!options.quick)
        for (const RenderSettings& settings : igi_settings()) add("igi", settings);
    return result;
}

void run(const QualityOptions& options) {
    if (options.reference != "auto" && options.scenes.size() > 1)
        throw UserError("--reference names one picture: bench one scene with it, or take auto");
    std::vector<QualityResult> results;
    for (const std::string& scene : options.scenes)
        results.push_back(options.lights ? compare_lights(options, scene)
                                         : bench_scene(options, scene));
    if (!options.output.empty()) write_report(options.output, results);
}

}  // namespace

void add_quality_command(CLI::App* bench) {
    auto options = std::make_shared<QualityOptions>();
    options->camera.size = {320, 240};
    CLI::App* command = bench->add_subcommand(
        "quality", "Speed against error, on the embedded cluster: igi, refined igi and path");
    command->set_help_flag("-h,--help", "print this help message and exit");
    command->add_option("SCENE", options->scenes, "files or generated scenes")->required();
    command
        ->add_option("--reference", options->reference,
                     "the converged picture, or auto: our path tracer's")
        ->capture_default_str();
    command
        ->add_option("--reference-time", options->reference_time,
                     "seconds that an automatic reference takes")
        ->check(CLI::PositiveNumber)
        ->capture_default_str();
    command->add_option("--runs", options->runs, "runs of each setting, with other seeds")
        ->check(CLI::Range(1, 100))
        ->capture_default_str();
    command->add_option("--longest", options->longest, "seconds: refinement is not taken farther")
        ->check(CLI::PositiveNumber)
        ->capture_default_str();
    command->add_flag("--quick", options->quick, "few and short: to see that it works");
    command->add_flag("--lights", options->lights,
                      "only compare light tracking with none, at equal time");
    command->add_option("-o,--output", options->output,
                        "folder for CSV, JSON, plots and difference pictures");
    command
        ->add_option("--threads", options->cluster.threads,
                     "render threads of the embedded worker (default: all cores)")
        ->check(CLI::Range(1, 1024));
    add_camera_options(command, options->camera);
    command->callback([options] { run(*options); });
}

}  // namespace tessera
