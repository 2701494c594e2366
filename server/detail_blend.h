// What the discontinuity filter takes away, given back where it is worth more than its noise. The
// filter removes noise and some of the picture with it: the detail, unfiltered minus filtered. Its
// mean over passes tells how much was lost, its spread how much of that is noise; the blend between
// them follows the rule of James and Stein ("Estimation with Quadratic Loss", 1961), with shares
// estimated for blocks of pixels (compare Rousselle, Manzi and Zwicker, "Robust Denoising using
// Feature and Color Information", 2013). As passes add up the noise vanishes and the picture
// converges to the unfiltered one.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "common/image.h"
#include "common/raw_vector.h"

namespace tessera {

class DetailBlend {
public:
    explicit DetailBlend(ImageSize size);

    /// Takes in the detail of row `y`, three floats per pixel, as the run number `runs`, counted
    /// from 1. Different rows may be added at the same time by different threads.
    void add_row(int y, std::span<const float> detail, std::uint32_t runs);

    /// All that makes it up beside the number of runs, to be saved, or to be overwritten with what
    /// was saved after so many runs and taken up with `resume`.
    std::vector<std::span<std::byte>> parts();
    static std::uint64_t saved_bytes(ImageSize size);
    void resume(std::uint32_t runs) { runs_ = runs; }

    /// Adds to rows y0 <= y < y1 of the mean of filtered runs as much of the detail as is worth it.
    void add_to(std::span<float> rows, int y0, int y1) const;

    /// Estimated squared error that detail makes, taken or left: sum over pixels and channels.
    double squared_error() const;

private:
    static constexpr int block_size = 4;  // pixels; larger ones dilute fine detail

    /// Sums over pixels and channels.
    struct Block {
        double squares = 0;   ///< of the mean detail
        double variance = 0;  ///< of that mean
    };

    Block block(int x, int y) const;
    /// Of the detail, how much to take: 0 where it is all noise.
    float share(const Block& block) const;

    ImageSize size_;
    ImageSize blocks_;
    std::uint32_t runs_ = 0;
    RawVector<float> mean_;      ///< from the first run on
    RawVector<float> squares_;   ///< squared deviations from it (Welford 1962)
    std::vector<Block> of_row_;  ///< blocks_.width for each row of pixels
};

}  // namespace tessera
