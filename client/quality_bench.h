// Speed against error: every setting is rendered several times with other seeds and held against a
// converged reference.
#pragma once

#include <string>
#include <vector>

#include "common/metrics.h"
#include "common/tile.h"

namespace tessera {

struct QualityRow {
    std::string integrator;  ///< igi (settings vary), refined igi (passes vary) or path
    RenderSettings settings;
    double seconds = 0;  ///< of rendering, median of the runs
    double mrays = 0;    ///< millions of rays
    /// Against the reference, root mean square over the runs; means of the others.
    Comparison error;
    double bias = 0;  ///< clamped RMSE that more runs would leave, the reference's noise included
    double deviation = 0;   ///< clamped RMSE of a run around the mean of all runs
    double rmse_error = 0;  ///< standard error of rmse_clamped
    std::vector<std::vector<LightEstimate>> lights{};  ///< of each run, where lights are tracked
    std::uint32_t active_lights = 0;
    double estimate = 0;  ///< what the frames say of their own error; RMS over the runs
    Image picture;        ///< of the first run
};

struct QualityResult {
    std::string scene;
    std::string reference;       ///< what it is, for people
    double reference_error = 0;  ///< its own estimate; 0 when unknown
    Image reference_picture;
    std::vector<QualityRow> rows;
};

/// Writes quality.csv and quality.json, and for each scene SCENE.svg, time against error, and for
/// each integrator SCENE.INTEGRATOR.png: the best picture's difference from the reference, ten
/// times magnified around grey. Throws UserError when `folder` cannot be written.
void write_report(const std::string& folder, const std::vector<QualityResult>& results);

}  // namespace tessera
