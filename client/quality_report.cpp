// The files of `tessera bench quality`.
#include <fmt/format.h>

#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>

#include "client/plot.h"
#include "client/quality_bench.h"
#include "common/check.h"
#include "common/image_io.h"

namespace tessera {
namespace {

using Figures = std::vector<std::pair<std::string, nlohmann::json>>;

/// A row's figures by name, in the order of the table's columns.
Figures figures(const QualityRow& row) {
    const RenderSettings& s = row.settings;
    return {{"integrator", row.integrator},
            {"passes", s.passes},
            {"vpls", s.vpls},
            {"interleave", s.interleave},
            {"filter", s.filter == FilterPlace::off ? "off" : "on"},
            {"bounces", s.bounces},
            {"seconds", row.seconds},
            {"mrays", row.mrays},
            {"rmse", row.error.rmse},
            {"rmse_clamped", row.error.rmse_clamped},
            {"relmse", row.error.relmse},
            {"delta_e", row.error.delta_e},
            {"mean_ratio", row.error.mean_a / row.error.mean_b},
            {"bias", row.bias},
            {"deviation", row.deviation},
            {"error_estimate", row.estimate}};
}

void write_text(const std::filesystem::path& file, const std::string& text) {
    std::ofstream out(file);
    out << text;
    if (!out.flush()) throw UserError(fmt::format("cannot write {}", file.string()));
}

std::string csv(const std::vector<QualityResult>& results) {
    std::string out = "scene";
    for (const auto& [name, value] : figures({})) out += fmt::format(",{}", name);
    for (const QualityResult& result : results) {
        for (const QualityRow& row : result.rows) {
            out += fmt::format("\n{}", result.scene);
            for (const auto& [name, value] : figures(row))
                out +=
                    fmt::format(",{}", value.is_string() ? value.get<std::string>() : value.dump());
        }
    }
    return out + "\n";
}

nlohmann::json json(const std::vector<QualityResult>& results) {
    nlohmann::json out = {{"version", TESSERA_VERSION}, {"scenes", nlohmann::json::array()}};
    for (const QualityResult& result : results) {
        nlohmann::json rows = nlohmann::json::array();
        for (const QualityRow& row : result.rows) rows.push_back(figures(row));
        out["scenes"].push_back({{"scene", result.scene},
                                 {"reference", result.reference},
                                 {"reference_error", result.reference_error},
                                 {"rows", rows}});
    }
    return out;
}

std::string plot(const QualityResult& result) {
    std::map<std::string, PlotSeries> series;
    for (const QualityRow& row : result.rows) {
        PlotSeries& s = series[row.integrator];
        s.name = row.integrator;
        s.line = row.integrator != "igi";  // refinements are lines, single settings are dots
        s.points.push_back({row.seconds, row.error.rmse_clamped,
                            fmt::format("{} passes, {} VPLs, n {}", row.settings.passes,
                                        row.settings.vpls, row.settings.interleave)});
    }
    std::vector<PlotSeries> all;
    for (auto& [name, s] : series) all.push_back(std::move(s));
    return log_log_plot(
        fmt::format("{}: RMSE (clamped to [0,1]) against seconds of rendering", result.scene),
        std::move(all));
}

Image magnified_difference(const Image& a, const Image& b) {
    constexpr float magnification = 10;
    Image out(a.size, 3);
    for (std::size_t i = 0; i < out.data.size(); ++i)
        out.data[i] = 0.2140f + magnification * (a.data[i] - b.data[i]);  // 0.5 in sRGB
    return out;
}

}  // namespace

void write_report(const std::string& folder, const std::vector<QualityResult>& results) {
    const std::filesystem::path path = folder;
    std::error_code error;
    std::filesystem::create_directories(path, error);
    if (error) throw UserError(fmt::format("cannot make {}: {}", folder, error.message()));
    write_text(path / "quality.csv", csv(results));
    write_text(path / "quality.json", json(results).dump(2) + "\n");
    for (const QualityResult& result : results) {
        write_text(path / (result.scene + ".svg"), plot(result));
        std::map<std::string, const QualityRow*> best;
        for (const QualityRow& row : result.rows) {
            const QualityRow*& slot = best[row.integrator];
            if (!slot || row.error.rmse_clamped < slot->error.rmse_clamped) slot = &row;
        }
        for (const auto& [integrator, row] : best) {
            const Image difference = magnified_difference(row->picture, result.reference_picture);
            write_srgb8(to_srgb8(difference, {}), difference.size,
                        path / (result.scene + "." + integrator + ".png"));
        }
    }
}

}  // namespace tessera
