// A frame becomes a picture: tiles are collected into runs of passes, complete runs are filtered
// and folded into running sums. Tiles come out of order and from different frames (Wald 2004,
// 8.4.2); folding is strictly in the order of passes, so the sums are the same bits always.
//
// Where we differ from the thesis: one copy instead of two, and the heavy part, the fold, is split
// off so that it runs on other threads than the one that owns the frame.
#pragma once

#include <cstdint>
#include <deque>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <unordered_map>
#include <vector>

#include "common/image.h"
#include "common/raw_vector.h"
#include "common/tile.h"
#include "common/tone_map.h"
#include "server/detail_blend.h"

namespace tessera {

/// The channels of one run of passes over the whole picture, each planar by channel.
struct RunBuffer {
    std::uint32_t run = 0;
    std::uint32_t passes = 0;
    std::uint32_t quarters_missing = 0;
    std::vector<std::uint8_t> quarters_here;  ///< by tile: a bit for each
    std::vector<float> owners;                ///< by quarter: number of the worker
    RawVector<float> data;
    /// By quarter, a whole tile's in its first; none: not tracked.
    std::vector<std::vector<LightEstimate>> lights;
};

/// What a frame adds up to so far.
class FrameSums {
public:
    explicit FrameSums(const FrameSpec& spec);

    /// Bytes of a frame's sums when saved.
    static std::uint64_t saved_bytes(const FrameSpec& spec);
    /// What these sums are after at least one run; between a finish_run and the next fold.
    Bytes saved();
    /// Goes on from sums of a frame of the same spec; comes before the first fold. Returns whether
    /// they may be such sums.
    bool resume(std::span<const std::byte> saved);

    /// Filters and adds rows y0 <= y < y1 of a complete run. Bands of rows may be folded at the
    /// same time by different threads; all bands of a run, then finish_run, then the next run.
    /// finish_run may keep the run's data, and leaves such as it needs no more.
    void fold(const RunBuffer& run, int y0, int y1);
    void finish_run(RunBuffer& run);

    std::uint32_t runs() const { return runs_; }
    std::uint32_t passes() const { return passes_; }
    /// Expected difference of picture() from the converged one, both clamped to [0, 1]: RMS over
    /// pixels and colour channels, estimated from how much the runs differ and from what the filter
    /// changes. 0 when there are fewer than two runs.
    double error_estimate() const;
    /// The mean of the passes folded so far, with the detail that the filter should not have taken;
    /// black when there are none.
    Image picture() const;
    /// Its rows y0 <= y < y1.
    void picture_rows(int y0, int y1, std::span<float> out) const;
    /// The same as bytes.
    void srgb8_rows(const ToneTable& table, int y0, int y1, std::uint8_t* out) const;
    /// A channel of spec.extra: the mean over passes (irradiance as filtered), but normal, depth,
    /// surface and path length as they are in the first pass, and owners those of the last run.
    Image channel(Channel c) const;
    /// What lights send into one pass, on average of those since the sums were last resumed: the
    /// `most` that send most, by number.
    std::vector<LightEstimate> lights(std::size_t most) const;

private:
    bool is_sum(const RunBuffer& run) const;
    std::span<const float> sum_rows(int y0, int y1) const;
    std::span<const float> irradiance_rows(const RunBuffer& run, int y0, int y1);
    void fold_row(const RunBuffer& run, std::span<const float> irradiance, int y);
    void fold_lights(const RunBuffer& run);
    void fold_detail(const RunBuffer& run, std::span<const float> irradiance, int y);
    void make_means();
    std::vector<std::span<std::byte>> parts();
    double row_error(int y) const;
    void fold_owners(const RunBuffer& run, int y0, int y1);
    Image error() const;

    FrameSpec spec_;
    std::uint32_t runs_ = 0;
    std::uint32_t passes_ = 0;
    RawVector<float> sum_;  ///< from the first run on
    // From the second run on:
    RawVector<float> mean_;           ///< of the runs' means; runs count the same
    RawVector<float> squares_;        ///< squared deviations from it (Welford 1962)
    std::vector<double> row_errors_;  ///< squared standard errors added up per row
    std::optional<DetailBlend> detail_;
    RawVector<float> filtered_;  ///< irradiance of the run being folded
    std::map<Channel, std::vector<float>> extra_;
    std::unordered_map<std::uint32_t, double> lights_;
    std::uint32_t light_passes_ = 0;
};

/// What add() did with a result.
enum class Arrival : std::uint8_t {
    stored,
    duplicate,   ///< its pixels are there already
    not_wanted,  ///< of a pass beyond the limit, or not yet to be handed out
    broken,      ///< no task of this frame, or no pixels of such a tile: the worker's fault
};

/// Large buffers of frames that are over, for those to come: fresh memory from the kernel costs
/// more than the pixels that fill it.
class BufferPool {
public:
    /// Of unknown contents.
    RawVector<float> take(std::size_t floats);
    /// Keeps a buffer as long as it is among the newest.
    void put(RawVector<float> buffer);

private:
    std::deque<RawVector<float>> buffers_;  ///< newest first
};

class FrameAssembler {
public:
    /// Runs before `first_run` are folded already.
    explicit FrameAssembler(const FrameSpec& spec, std::uint32_t first_run = 0,
                            std::shared_ptr<BufferPool> pool = std::make_shared<BufferPool>());

    /// Whether this is one of the frame's tasks with pixels of such a tile, packed.
    bool fits(const TileTask& task, std::span<const std::byte> pixels) const;
    /// `owner`: number of the worker whose it is.
    Arrival add(const TileTask& task, std::span<const std::byte> pixels, std::uint64_t owner = 0,
                std::vector<LightEstimate> lights = {});

    /// The next run in order once it is complete; to be folded, then handed back to run_folded.
    /// One at a time: nothing while a run is out.
    std::optional<RunBuffer> take_complete();
    void run_folded(RunBuffer run);

    /// Ends the frame after `passes` passes, rounded up to whole runs: at least one, and those that
    /// are folded or being folded already.
    void limit_passes(std::uint32_t passes);

    std::uint32_t runs() const { return runs_; }
    /// Every run has been folded.
    bool finished() const { return !folding_ && folded_ == runs_; }
    /// Runs before this one may be handed out. Bounds the buffers: at most window() runs are in
    /// flight or waiting to be folded, about 256 MiB or two runs of a large picture.
    std::uint32_t run_limit() const;
    std::uint32_t window() const { return window_; }

    std::uint64_t tiles_done() const { return quarters_done_ / quarters; }
    std::uint64_t tiles_total() const { return std::uint64_t(runs_) * tile_count(spec_.size); }

private:
    RunBuffer& buffer_of(std::uint32_t run);

    FrameSpec spec_;
    ChannelSet channels_;
    std::uint32_t runs_;
    std::uint32_t window_;
    std::uint32_t folded_;
    bool folding_ = false;
    std::uint64_t quarters_done_;
    std::map<std::uint32_t, RunBuffer> open_;  ///< runs in flight or complete, not yet taken
    std::shared_ptr<BufferPool> pool_;
};

}  // namespace tessera
