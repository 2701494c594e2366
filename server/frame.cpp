#include "server/frame.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstring>

#include "common/check.h"
#include "common/discontinuity.h"
#include "common/tile_codec.h"
#include "server/runs.h"

namespace tessera {
namespace {

/// Memory for runs in flight of one frame.
constexpr std::size_t window_bytes = std::size_t(256) << 20;
/// More runs in flight than this only help pictures of a few tiles.
constexpr std::size_t most_runs_in_flight = 32;
/// Memory of runs that are over.
constexpr std::size_t most_spare_bytes = window_bytes;

/// Where channel `c` begins in planar data of `pixels` pixels.
std::size_t channel_offset(ChannelSet set, Channel c, std::size_t pixels) {
    const ChannelSet before{set.bits & ((1u << unsigned(c)) - 1)};
    return std::size_t(floats_per_pixel(before)) * pixels;
}

std::span<const float> channel_of(const FrameSpec& spec, const RunBuffer& run, Channel c) {
    const std::size_t pixels = spec.size.pixels();
    return std::span(run.data).subspan(channel_offset(tile_channels(spec), c, pixels),
                                       std::size_t(floats_per_pixel(c)) * pixels);
}

bool of_first_pass(Channel c) {
    return c == Channel::normal || c == Channel::depth || c == Channel::surface ||
           c == Channel::path_length;
}

/// Zero in place of what is not finite. By bits and a mask, or else gcc would not vectorise.
float finite_or_zero(float v) {
    constexpr std::uint32_t exponent = 0x7f800000;
    const auto bits = std::bit_cast<std::uint32_t>(v);
    return std::bit_cast<float>(bits & -std::uint32_t((bits & exponent) != exponent));
}

std::vector<Channel> channels_in(ChannelSet set) {
    std::vector<Channel> out;
    for (int c = 0; c < channel_count; ++c)
        if (set.has(Channel(c))) out.push_back(Channel(c));
    return out;
}

Image scaled_image(ImageSize size, int channels, std::span<const float> values, float scale) {
    Image image(size, channels);
    for (std::size_t i = 0; i < values.size(); ++i) image.data[i] = values[i] * scale;
    return image;
}

}  // namespace

FrameSums::FrameSums(const FrameSpec& spec)
    : spec_(spec), sum_(3 * spec.size.pixels()), row_errors_(std::size_t(spec.size.height)) {
    for (Channel c : channels_in(spec.extra))
        extra_[c].resize(std::size_t(floats_per_pixel(c)) * spec.size.pixels());
    if (spec.settings.integrator != Integrator::igi) return;
    filtered_.resize(sum_.size());
    if (spec.settings.filter != FilterPlace::off) detail_.emplace(spec.size);
}

/// The irradiance to use in these rows, of the whole picture.
std::span<const float> FrameSums::irradiance_rows(const RunBuffer& run, int y0, int y1) {
    const std::span<const float> irradiance = channel_of(spec_, run, Channel::irradiance);
    if (spec_.settings.filter == FilterPlace::off) return irradiance;
    filter_irradiance(
        {.picture = spec_.size, .camera = spec_.camera, .window = int(spec_.settings.interleave)},
        {.area = {0, 0, spec_.size.width, spec_.size.height},
         .irradiance = irradiance,
         .normal = channel_of(spec_, run, Channel::normal),
         .depth = channel_of(spec_, run, Channel::depth),
         .surface = channel_of(spec_, run, Channel::surface)},
        {0, y0, spec_.size.width, y1}, filtered_);
    return filtered_;
}

/// Whether the run's data are the sums after it: the first of a frame of radiance alone, which the
/// assembler unpacks as sums.
bool FrameSums::is_sum(const RunBuffer& run) const {
    return runs_ == 0 && spec_.settings.integrator != Integrator::igi &&
           run.data.size() == sum_.size();
}

/// Adds the radiance of a row, and updates mean and squared deviations of the runs' means. The
/// first run is added to what has no value yet.
void FrameSums::fold_row(const RunBuffer& run, std::span<const float> irradiance, int y) {
    const std::size_t row_floats = 3 * std::size_t(spec_.size.width);
    const std::size_t begin = std::size_t(y) * row_floats;
    const float* lit = &channel_of(spec_, run, Channel::radiance)[begin];
    std::vector<float> shaded;
    if (spec_.settings.integrator == Integrator::igi) {
        const float* albedo = &channel_of(spec_, run, Channel::albedo)[begin];
        const float* arriving = &irradiance[begin];
        shaded.resize(row_floats);
        for (std::size_t i = 0; i < row_floats; ++i)
            shaded[i] = lit[i] + albedo[i] * (1 / pi) * arriving[i];
        lit = shaded.data();
    }
    float* __restrict sum = &sum_[begin];
    if (runs_ == 0) {
        for (std::size_t i = 0; i < row_floats; ++i) sum[i] = 0 + finite_or_zero(lit[i]);
        return;
    }
    const float per_pass = 1 / float(run.passes);
    const float per_run = 1 / float(runs_ + 1);
    float* __restrict mean = &mean_[begin];
    float* __restrict squares = &squares_[begin];
    for (std::size_t i = 0; i < row_floats; ++i) {
        const float value = finite_or_zero(lit[i]);
        sum[i] += value;
        const float deviation = value * per_pass - mean[i];
        mean[i] += deviation * per_run;
        squares[i] += deviation * (value * per_pass - mean[i]);
    }
    row_errors_[std::size_t(y)] = row_error(y);
}

/// Squared standard errors of a row's means, as far as they are visible within [0, 1].
double FrameSums::row_error(int y) const {
    const std::size_t row_floats = 3 * std::size_t(spec_.size.width);
    const std::size_t begin = std::size_t(y) * row_floats;
    const float scale = 1 / (float(runs_) * float(runs_ + 1));
    double sum = 0;
    for (std::size_t i = begin; i < begin + row_floats; ++i) {
        const float room = mean_[i] < 1 ? std::max(mean_[i], 1 - mean_[i]) : 0;
        sum += std::min(squares_[i] * scale, room * room);
    }
    return sum;
}

/// Hands over what the filter changed in a row.
void FrameSums::fold_detail(const RunBuffer& run, std::span<const float> irradiance, int y) {
    const std::span<const float> unfiltered = channel_of(spec_, run, Channel::irradiance);
    const std::span<const float> albedo = channel_of(spec_, run, Channel::albedo);
    const std::size_t row_floats = 3 * std::size_t(spec_.size.width);
    const std::size_t begin = std::size_t(y) * row_floats;
    std::vector<float> detail(row_floats);
    for (std::size_t i = 0; i < row_floats; ++i)
        detail[i] = finite_or_zero(albedo[begin + i] * (1 / pi) *
                                   (unfiltered[begin + i] - irradiance[begin + i]));
    detail_->add_row(y, detail, runs_ + 1);
}

/// Each light's estimates are added up tile by tile, and so to the same bits always.
void FrameSums::fold_lights(const RunBuffer& run) {
    std::vector<LightEstimate> tile;
    for (std::size_t i = 0; i < run.lights.size(); ++i) {
        add_estimates(run.lights[i], tile);
        if ((i + 1) % quarters != 0) continue;
        for (const LightEstimate& e : tile) lights_[e.light] += double(e.radiance);
        tile.clear();
    }
    light_passes_ += run.passes;
}

std::vector<LightEstimate> FrameSums::lights(std::size_t most) const {
    std::vector<LightEstimate> all;
    for (const auto& [light, radiance] : lights_)
        all.push_back({light, float(radiance / double(light_passes_))});
    const auto more = [](const LightEstimate& a, const LightEstimate& b) {
        return a.radiance > b.radiance || (a.radiance == b.radiance && a.light < b.light);
    };
    std::ranges::sort(all, more);
    all.resize(std::min(all.size(), most));
    std::ranges::sort(all, {}, &LightEstimate::light);
    return all;
}

void FrameSums::fold(const RunBuffer& run, int y0, int y1) {
    if (y0 == 0) fold_lights(run);
    const bool igi = spec_.settings.integrator == Integrator::igi;
    const std::span<const float> irradiance =
        igi ? irradiance_rows(run, y0, y1) : std::span<const float>();
    for (int y = y0; y < y1; ++y) {
        if (!is_sum(run)) fold_row(run, irradiance, y);
        if (detail_) fold_detail(run, irradiance, y);
    }

    // Add the channels asked for beside the picture.
    for (auto& [channel, sums] : extra_) {
        if (channel == Channel::owner) fold_owners(run, y0, y1);
        if (server_channels.has(channel) || (of_first_pass(channel) && runs_ > 0)) continue;
        const std::span<const float> values =
            channel == Channel::irradiance && igi ? irradiance : channel_of(spec_, run, channel);
        const std::size_t row =
            std::size_t(floats_per_pixel(channel)) * std::size_t(spec_.size.width);
        if (of_first_pass(channel))
            std::copy_n(&values[std::size_t(y0) * row], std::size_t(y1 - y0) * row,
                        &sums[std::size_t(y0) * row]);
        else
            for (std::size_t i = std::size_t(y0) * row; i < std::size_t(y1) * row; ++i)
                sums[i] += finite_or_zero(values[i]);
    }
}

void FrameSums::fold_owners(const RunBuffer& run, int y0, int y1) {
    std::vector<float>& owners = extra_.at(Channel::owner);
    for (int y = y0; y < y1; ++y)
        for (int x = 0; x < spec_.size.width; ++x) {
            const std::uint32_t tile =
                std::uint32_t(y / tile_size) * tiles_across(spec_.size) + x / tile_size;
            owners[std::size_t(y) * std::size_t(spec_.size.width) + std::size_t(x)] =
                run.owners[quarters * tile + quarter_of(x, y)];
        }
}

void FrameSums::finish_run(RunBuffer& run) {
    if (is_sum(run)) sum_.swap(run.data);
    ++runs_;
    passes_ += run.passes;
    if (runs_ != 1 || run_count(spec_.settings) == 1) return;
    // The mean of the first run is its sum, and nothing has deviated yet.
    make_means();
    const float per_pass = 1 / float(passes_);
    for (std::size_t i = 0; i < sum_.size(); ++i) mean_[i] = sum_[i] * per_pass;
    std::ranges::fill(squares_, 0.0f);
}

void FrameSums::make_means() {
    mean_.resize(sum_.size());
    squares_.resize(sum_.size());
}

/// All that the sums are made of, but for the number of runs, in the order in which it is saved.
std::vector<std::span<std::byte>> FrameSums::parts() {
    std::vector<std::span<std::byte>> out;
    for (RawVector<float>* part : {&sum_, &mean_, &squares_})
        out.push_back(std::as_writable_bytes(std::span(*part)));
    out.push_back(std::as_writable_bytes(std::span(row_errors_)));
    for (auto& [channel, sums] : extra_) out.push_back(std::as_writable_bytes(std::span(sums)));
    if (!detail_) return out;
    const auto detail = detail_->parts();
    out.insert(out.end(), detail.begin(), detail.end());
    return out;
}

std::uint64_t FrameSums::saved_bytes(const FrameSpec& spec) {
    const auto pixels = std::uint64_t(spec.size.pixels());
    const std::uint64_t means = run_count(spec.settings) > 1 ? 2 : 0;
    const bool filtered =
        spec.settings.integrator == Integrator::igi && spec.settings.filter != FilterPlace::off;
    return sizeof runs_ + sizeof(float) * pixels * (3 * (1 + means)) +
           sizeof(double) * std::uint64_t(spec.size.height) +
           sizeof(float) * pixels * std::uint64_t(floats_per_pixel(spec.extra)) +
           (filtered ? DetailBlend::saved_bytes(spec.size) : 0);
}

Bytes FrameSums::saved() {
    CHECK(runs_ > 0);
    Bytes out;
    out.reserve(saved_bytes(spec_));
    const auto runs = std::as_bytes(std::span(&runs_, 1));
    out.insert(out.end(), runs.begin(), runs.end());
    for (const std::span<std::byte> part : parts()) out.insert(out.end(), part.begin(), part.end());
    CHECK_EQ(out.size(), saved_bytes(spec_));
    return out;
}

bool FrameSums::resume(std::span<const std::byte> saved) {
    const std::uint32_t all_runs = run_count(spec_.settings);
    if (saved.size() != saved_bytes(spec_)) return false;
    std::memcpy(&runs_, saved.data(), sizeof runs_);
    if (runs_ < 1 || runs_ > all_runs) return false;
    passes_ = std::min(runs_ * passes_per_task(spec_.settings), spec_.settings.passes);
    if (all_runs > 1) make_means();
    if (detail_) detail_->resume(runs_);
    saved = saved.subspan(sizeof runs_);
    for (const std::span<std::byte> part : parts()) {
        std::copy_n(saved.begin(), part.size(), part.begin());
        saved = saved.subspan(part.size());
    }
    return true;
}

double FrameSums::error_estimate() const {
    if (runs_ < 2) return 0;
    double squares = detail_ ? detail_->squared_error() : 0;
    for (double row : row_errors_) squares += row;
    return std::sqrt(squares / double(sum_.size()));
}

Image FrameSums::picture() const {
    Image image(spec_.size, 3);
    picture_rows(0, spec_.size.height, image.data);
    return image;
}

void FrameSums::picture_rows(int y0, int y1, std::span<float> out) const {
    const std::span<const float> sums = sum_rows(y0, y1);
    if (runs_ == 0) std::fill_n(out.begin(), sums.size(), 0.0f);
    if (runs_ == 0) return;
    const float scale = 1 / float(passes_);
    for (std::size_t i = 0; i < sums.size(); ++i) out[i] = sums[i] * scale;
    if (detail_) detail_->add_to(out, y0, y1);
}

std::span<const float> FrameSums::sum_rows(int y0, int y1) const {
    const std::size_t row = 3 * std::size_t(spec_.size.width);
    return std::span(sum_).subspan(std::size_t(y0) * row, std::size_t(y1 - y0) * row);
}

void FrameSums::srgb8_rows(const ToneTable& table, int y0, int y1, std::uint8_t* out) const {
    // Without detail the bytes come from the sums at once.
    if (runs_ > 0 && (!detail_ || runs_ < 2))
        return table.put(sum_rows(y0, y1), 1 / float(passes_), out);
    std::vector<float> rows(sum_rows(y0, y1).size());
    picture_rows(y0, y1, rows);
    table.put(rows, 1, out);
}

/// As row_error() counts it.
Image FrameSums::error() const {
    Image image(spec_.size, 1);
    const float scale = 1 / (float(runs_) * std::max(float(runs_) - 1, 1.0f));
    for (std::size_t p = 0; p < image.data.size(); ++p) {
        float squared = runs_ < 2 ? infinity : 0;
        for (std::size_t i = 3 * p; i < 3 * p + 3 && runs_ >= 2; ++i) {
            const float room = mean_[i] < 1 ? std::max(mean_[i], 1 - mean_[i]) : 0;
            squared += std::min(squares_[i] * scale, room * room) / 3;
        }
        image.data[p] = std::sqrt(squared);
    }
    return image;
}

Image FrameSums::channel(Channel c) const {
    CHECK(extra_.contains(c));
    if (c == Channel::error) return error();
    const float scale = 1 / float(std::max(passes_, 1u));
    Image image = scaled_image(spec_.size, floats_per_pixel(c), extra_.at(c), scale);
    // Surface is bits, not a number.
    if (of_first_pass(c) || c == Channel::owner) image.data = extra_.at(c);
    return image;
}

RawVector<float> BufferPool::take(std::size_t floats) {
    const auto found = std::find_if(buffers_.begin(), buffers_.end(),
                                    [&](const auto& buffer) { return buffer.size() == floats; });
    if (found == buffers_.end()) return RawVector<float>(floats);
    RawVector<float> out = std::move(*found);
    buffers_.erase(found);
    return out;
}

void BufferPool::put(RawVector<float> buffer) {
    buffers_.push_front(std::move(buffer));
    std::size_t bytes = 0;
    for (const auto& kept : buffers_) bytes += kept.size() * sizeof(float);
    for (; bytes > most_spare_bytes; buffers_.pop_back())
        bytes -= buffers_.back().size() * sizeof(float);
}

FrameAssembler::FrameAssembler(const FrameSpec& spec, std::uint32_t first_run,
                               std::shared_ptr<BufferPool> pool)
    : spec_(spec),
      channels_(tile_channels(spec)),
      runs_(run_count(spec.settings)),
      folded_(first_run),
      quarters_done_(std::uint64_t(first_run) * quarters * tile_count(spec.size)),
      pool_(std::move(pool)) {
    const std::size_t run_bytes =
        spec.size.pixels() * std::size_t(floats_per_pixel(channels_)) * sizeof(float);
    window_ = std::uint32_t(std::clamp(window_bytes / std::max<std::size_t>(run_bytes, 1),
                                       std::size_t(2), most_runs_in_flight));
}

std::uint32_t FrameAssembler::run_limit() const { return std::min(folded_ + window_, runs_); }

bool FrameAssembler::fits(const TileTask& task, std::span<const std::byte> pixels) const {
    return run_of(spec_, task) &&
           is_packed_tile(channels_, rect_of(spec_.size, task).pixels(), pixels);
}

Arrival FrameAssembler::add(const TileTask& task, std::span<const std::byte> pixels,
                            std::uint64_t owner, std::vector<LightEstimate> lights) {
    if (!fits(task, pixels)) return Arrival::broken;
    const std::uint32_t run = *run_of(spec_, task);
    if (run < folded_ + (folding_ ? 1 : 0)) return Arrival::duplicate;
    if (run >= run_limit()) return Arrival::not_wanted;

    RunBuffer& buffer = buffer_of(run);
    std::uint8_t& here = buffer.quarters_here[task.tile];
    const std::uint8_t all = (1u << quarters) - 1;
    const std::uint8_t these = task.part == 0 ? all : std::uint8_t(1u << (task.part - 1));
    if ((here & these) == these) return Arrival::duplicate;
    unpack_tile(channels_, pixels, rect_of(spec_.size, task), spec_.size, buffer.data,
                spec_.settings.integrator == Integrator::igi ? Unpacked::same_bits
                                                             : Unpacked::radiance_is_a_sum);
    for (std::uint32_t q = 0; q < quarters; ++q)
        if (these >> q & 1) buffer.owners[quarters * task.tile + q] = float(owner);
    if (!lights.empty()) {
        buffer.lights.resize(std::size_t(quarters) * tile_count(spec_.size));
        const auto of_tile = std::span(buffer.lights).subspan(quarters * task.tile, quarters);
        if (task.part == 0) std::ranges::fill(of_tile, std::vector<LightEstimate>());
        of_tile[std::max(task.part, 1u) - 1] = std::move(lights);
    }
    const auto count = std::uint32_t(std::popcount(unsigned(these & ~here)));
    here |= these;
    buffer.quarters_missing -= count;
    quarters_done_ += count;
    return Arrival::stored;
}

RunBuffer& FrameAssembler::buffer_of(std::uint32_t run) {
    if (const auto found = open_.find(run); found != open_.end()) return found->second;
    RunBuffer buffer;
    buffer.run = run;
    buffer.passes = passes_of_run(spec_.settings, run);
    buffer.quarters_missing = quarters * tile_count(spec_.size);
    buffer.quarters_here.assign(tile_count(spec_.size), 0);
    buffer.owners.resize(buffer.quarters_missing);
    buffer.data = pool_->take(spec_.size.pixels() * std::size_t(floats_per_pixel(channels_)));
    return open_.emplace(run, std::move(buffer)).first->second;
}

std::optional<RunBuffer> FrameAssembler::take_complete() {
    const auto next = open_.find(folded_);
    if (folding_ || next == open_.end() || next->second.quarters_missing > 0) return std::nullopt;
    folding_ = true;
    finish_unpacking();
    RunBuffer run = std::move(next->second);
    open_.erase(next);
    return run;
}

void FrameAssembler::run_folded(RunBuffer run) {
    CHECK(folding_ && run.run == folded_);
    folding_ = false;
    ++folded_;
    pool_->put(std::move(run.data));
}

void FrameAssembler::limit_passes(std::uint32_t passes) {
    const std::uint32_t per_run = passes_per_task(spec_.settings);
    const std::uint32_t wanted = passes / per_run + (passes % per_run != 0);
    const std::uint32_t begun = std::max(folded_ + (folding_ ? 1 : 0), 1u);
    runs_ = std::min(std::max(wanted, begun), runs_);
    for (auto run = open_.lower_bound(runs_); run != open_.end(); run = open_.erase(run))
        quarters_done_ -= quarters * tile_count(spec_.size) - run->second.quarters_missing;
}

}  // namespace tessera
