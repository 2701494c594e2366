// How far one picture is from another.
#pragma once

#include "common/image.h"

namespace tessera {

/// Over all pixels and channels, in double precision and in picture order, so that the figures are
/// the same everywhere. `a` is the estimate, `b` the reference.
///
/// A value that is not finite in one picture only (or NaN on either side, or opposite infinities)
/// is a difference: it makes max_abs and rmse infinite and `identical` false. The same infinity, or
/// NaN in both, differs by nothing.
struct Comparison {
    double rmse = 0;          ///< root of the mean squared difference
    double rmse_clamped = 0;  ///< the same with both pictures clamped to [0, 1]; NaN counts as 0
    double relmse = 0;        ///< mean of (a - b)^2 / (b^2 + 0.01)
    double delta_e = 0;       ///< mean distance in CIELAB (CIE 1976, white D65), clamped like
                              ///< rmse_clamped; about 2.3 is just noticeable; 0 unless RGB
    double max_abs = 0;
    double mean_a = 0;  ///< mean of all values as they are
    double mean_b = 0;
    bool identical = true;  ///< same bits everywhere
};

/// Throws UserError when size or channels disagree.
Comparison compare(const Image& a, const Image& b);

}  // namespace tessera
