#include "client/plot.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>

namespace tessera {
namespace {

constexpr double width = 720, height = 480, margin = 60;

/// A range of decades.
class Axis {
public:
    void add(double value) {
        lo_ = std::min(lo_, std::floor(std::log10(value) * 2) / 2);
        hi_ = std::max(hi_, std::ceil(std::log10(value) * 2) / 2);
    }

    /// Where on the axis, 0 to 1.
    double place(double value) const {
        return (std::log10(value) - lo_) / std::max(hi_ - lo_, 0.5);
    }

    /// 1, 2 and 5 of each decade.
    std::vector<double> ticks() const {
        std::vector<double> out;
        for (int decade = int(std::floor(lo_)); decade <= int(hi_); ++decade)
            for (const double digit : {1.0, 2.0, 5.0}) {
                const double value = digit * std::pow(10.0, decade);
                if (place(value) >= -1e-9 && place(value) <= 1 + 1e-9) out.push_back(value);
            }
        return out;
    }

private:
    double lo_ = 1e9, hi_ = -1e9;
};

class Plot {
public:
    Plot(const std::string& title, const std::vector<PlotSeries>& series) {
        for (const PlotSeries& s : series)
            for (const PlotPoint& point : s.points) {
                x_.add(point.x);
                y_.add(point.y);
            }
        svg_ = fmt::format(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" "
            "font-family=\"sans-serif\" font-size=\"13\">\n"
            "<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n"
            "<text x=\"{}\" y=\"20\">{}</text>\n",
            width, height, margin, title);
        draw_grid();
        for (std::size_t i = 0; i < series.size(); ++i) draw(series[i], i);
        svg_ += "</svg>\n";
    }

    const std::string& svg() const { return svg_; }

private:
    double x(double value) const { return margin + (width - 2 * margin) * x_.place(value); }
    double y(double value) const {
        return height - margin - (height - 2 * margin) * y_.place(value);
    }

    void line(double x0, double y0, double x1, double y1) {
        svg_ += fmt::format(
            "<line x1=\"{:.1f}\" y1=\"{:.1f}\" x2=\"{:.1f}\" y2=\"{:.1f}\" stroke=\"#ddd\"/>\n", x0,
            y0, x1, y1);
    }

    void text(double px, double py, const char* anchor, const char* color,
              const std::string& words) {
        svg_ += fmt::format(
            "<text x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"{}\" fill=\"{}\">{}</text>\n", px, py,
            anchor, color, words);
    }

    void draw_grid() {
        for (const double value : x_.ticks()) {
            line(x(value), margin, x(value), height - margin);
            text(x(value), height - margin + 18, "middle", "black", fmt::format("{:g}", value));
        }
        for (const double value : y_.ticks()) {
            line(margin, y(value), width - margin, y(value));
            text(margin - 6, y(value) + 4, "end", "black", fmt::format("{:g}", value));
        }
    }

    void draw(const PlotSeries& series, std::size_t place) {
        constexpr const char* colors[] = {"#888888", "#d04020", "#2060c0", "#208040", "#a06000"};
        const char* const color = colors[place % std::size(colors)];
        std::string points;
        for (const PlotPoint& point : series.points) {
            const double px = x(point.x), py = y(point.y);
            points += fmt::format("{:.1f},{:.1f} ", px, py);
            svg_ += fmt::format(
                "<circle cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"3.5\" fill=\"{}\"><title>{}</title>"
                "</circle>\n",
                px, py, color, point.label);
        }
        if (series.line)
            svg_ += fmt::format("<polyline points=\"{}\" fill=\"none\" stroke=\"{}\"/>\n", points,
                                color);
        text(margin + 200 * double(place), 44, "start", color, series.name);
    }

    Axis x_, y_;
    std::string svg_;
};

}  // namespace

std::string log_log_plot(const std::string& title, std::vector<PlotSeries> series) {
    for (PlotSeries& s : series)
        std::erase_if(s.points, [](const PlotPoint& p) { return !(p.x > 0 && p.y > 0); });
    std::erase_if(series, [](const PlotSeries& s) { return s.points.empty(); });
    return Plot(title, series).svg();
}

}  // namespace tessera
