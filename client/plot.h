// Plots with logarithmic axes, as SVG: time against error, speed against workers.
#pragma once

#include <string>
#include <vector>

namespace tessera {

struct PlotPoint {
    double x = 0, y = 0;
    std::string label;  ///< shown by browsers under the pointer
};

struct PlotSeries {
    std::string name;
    bool line = true;  ///< joins the points
    std::vector<PlotPoint> points;
};

/// What is not above zero is left out.
std::string log_log_plot(const std::string& title, std::vector<PlotSeries> series);

}  // namespace tessera
