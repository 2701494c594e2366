// The files of `tessera bench quality`.
#include <fmt/format.h>

#include <filesystem>
#include <fstream>
#include <map>
#include <nlohmann/json.hpp>

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

/// A plot with logarithmic axes: seconds to the right, clamped RMSE upwards.
class Plot {
public:
    explicit Plot(const QualityResult& result) {
        for (const QualityRow& row : result.rows) {
            if (!drawable(row)) continue;
            x_.add(row.seconds);
            y_.add(row.error.rmse_clamped);
        }
        out_ = fmt::format(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" "
            "font-family=\"sans-serif\" font-size=\"13\">\n"
            "<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
            "<text x=\"{}\" y=\"20\">{}: RMSE (clamped to [0,1]) against seconds of "
            "rendering</text>\n",
            width, height, margin, result.scene);
        draw_grid();
        std::map<std::string, std::vector<const QualityRow*>> by_integrator;
        for (const QualityRow& row : result.rows)
            if (drawable(row)) by_integrator[row.integrator].push_back(&row);
        const char* const colors[] = {"#888888", "#d04020", "#2060c0"};
        std::size_t i = 0;
        for (const auto& [integrator, rows] : by_integrator) {
            draw(integrator, rows, colors[i % 3], int(i));
            ++i;
        }
        out_ += "</svg>\n";
    }

    const std::string& svg() const { return out_; }

private:
    static constexpr double width = 720, height = 480, margin = 60;

    /// A range of decades.
    struct Axis {
        double lo = 1e9, hi = -1e9;

        void add(double value) {
            lo = std::min(lo, std::floor(std::log10(value) * 2) / 2);
            hi = std::max(hi, std::ceil(std::log10(value) * 2) / 2);
        }
        double place(double value) const {
            return (std::log10(value) - lo) / std::max(hi - lo, 0.5);
        }
    };

    static bool drawable(const QualityRow& row) {
        return row.seconds > 0 && row.error.rmse_clamped > 0;
    }
    double x(double seconds) const { return margin + (width - 2 * margin) * x_.place(seconds); }
    double y(double error) const {
        return height - margin - (height - 2 * margin) * y_.place(error);
    }

    /// Lines at 1, 2 and 5 of each decade.
    template <class Draw>
    static void for_ticks(const Axis& axis, Draw draw) {
        for (int decade = int(std::floor(axis.lo)); decade <= int(axis.hi); ++decade)
            for (const double digit : {1.0, 2.0, 5.0}) {
                const double value = digit * std::pow(10.0, decade);
                if (axis.place(value) >= -1e-9 && axis.place(value) <= 1 + 1e-9) draw(value);
            }
    }
    void line(double x0, double y0, double x1, double y1) {
        out_ += fmt::format(
            "<line x1=\"{:.1f}\" y1=\"{:.1f}\" x2=\"{:.1f}\" y2=\"{:.1f}\" stroke=\"#ddd\"/>\n", x0,
            y0, x1, y1);
    }
    void label(double px, double py, const char* anchor, const std::string& text) {
        out_ += fmt::format("<text x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"{}\">{}</text>\n", px,
                            py, anchor, text);
    }
    void draw_grid() {
        for_ticks(x_, [&](double value) {
            line(x(value), margin, x(value), height - margin);
            label(x(value), height - margin + 18, "middle", fmt::format("{:g}", value));
        });
        for_ticks(y_, [&](double value) {
            line(margin, y(value), width - margin, y(value));
            label(margin - 6, y(value) + 4, "end", fmt::format("{:g}", value));
        });
    }
    /// Refinements are lines, single settings are dots.
    void draw(const std::string& name, const std::vector<const QualityRow*>& rows,
              const char* color, int place) {
        std::string points;
        for (const QualityRow* row : rows) {
            const double px = x(row->seconds), py = y(row->error.rmse_clamped);
            points += fmt::format("{:.1f},{:.1f} ", px, py);
            out_ += fmt::format(
                "<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"3.5\" fill=\"{}\"><title>{} passes, {} "
                "VPLs, n {}</title></circle>\n",
                px, py, color, row->settings.passes, row->settings.vpls, row->settings.interleave);
        }
        if (name != "igi")
            out_ += fmt::format("<polyline points=\"{}\" fill=\"none\" stroke=\"{}\"/>\n", points,
                                color);
        out_ += fmt::format("<text x=\"{}\" y=\"{}\" fill=\"{}\">{}</text>\n", width - margin - 90,
                            margin + 16 * (place + 1), color, name);
    }

    Axis x_, y_;
    std::string out_;
};

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
        write_text(path / (result.scene + ".svg"), Plot(result).svg());
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
