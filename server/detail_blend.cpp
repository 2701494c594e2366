#include "server/detail_blend.h"

#include <algorithm>
#include <cmath>

namespace tessera {

DetailBlend::DetailBlend(ImageSize size)
    : size_(size),
      blocks_{(size.width + block_size - 1) / block_size,
              (size.height + block_size - 1) / block_size},
      mean_(3 * size.pixels()),
      squares_(3 * size.pixels()),
      of_row_(std::size_t(blocks_.width) * std::size_t(size.height)) {}

std::vector<std::span<std::byte>> DetailBlend::parts() {
    return {std::as_writable_bytes(std::span(mean_)), std::as_writable_bytes(std::span(squares_)),
            std::as_writable_bytes(std::span(of_row_))};
}

std::uint64_t DetailBlend::saved_bytes(ImageSize size) {
    const auto blocks_across = std::uint64_t(size.width + block_size - 1) / block_size;
    return 2 * 3 * sizeof(float) * std::uint64_t(size.pixels()) +
           sizeof(Block) * blocks_across * std::uint64_t(size.height);
}

void DetailBlend::add_row(int y, std::span<const float> detail, std::uint32_t runs) {
    const std::size_t row = 3 * std::size_t(size_.width);
    float* mean = &mean_[std::size_t(y) * row];
    float* squares = &squares_[std::size_t(y) * row];
    const float per_run = 1 / float(runs);
    if (runs == 1) std::fill_n(mean, row, 0.0f);
    if (runs == 1) std::fill_n(squares, row, 0.0f);
    for (std::size_t i = 0; i < row; ++i) {
        const float deviation = detail[i] - mean[i];
        mean[i] += deviation * per_run;
        squares[i] += deviation * (detail[i] - mean[i]);
    }
    if (y == 0) runs_ = runs;
    if (runs < 2) return;
    const double per_variance = 1 / (double(runs) * (runs - 1));
    for (int b = 0; b < blocks_.width; ++b) {
        const std::size_t begin = 3 * std::size_t(b) * block_size;
        const std::size_t end = std::min(begin + 3 * block_size, row);
        float detail_squares = 0, deviations = 0;
        for (std::size_t i = begin; i < end; ++i) {
            detail_squares += mean[i] * mean[i];
            deviations += squares[i];
        }
        of_row_[std::size_t(y) * std::size_t(blocks_.width) + std::size_t(b)] = {
            detail_squares, deviations * per_variance};
    }
}

DetailBlend::Block DetailBlend::block(int x, int y) const {
    Block sum;
    const int end = std::min((y + 1) * block_size, size_.height);
    for (int row = y * block_size; row < end; ++row) {
        const Block& part = of_row_[std::size_t(row) * std::size_t(blocks_.width) + std::size_t(x)];
        sum.squares += part.squares;
        sum.variance += part.variance;
    }
    return sum;
}

float DetailBlend::share(const Block& block) const {
    // Neighbours share much of their noise, so the squares of pure noise scatter around their
    // variance; and the variance is itself uncertain as long as there are few runs.
    const double doubt = 1.5 + 6.0 / double(std::max(runs_, 2u) - 1);
    return block.squares > doubt * block.variance
               ? float(1 - doubt * block.variance / block.squares)
               : 0;
}

void DetailBlend::add_to(std::span<float> rows, int y0, int y1) const {
    if (runs_ < 2) return;
    // A row of blocks on each side of those that the rows lie in.
    const int first = y0 / block_size - 1;
    const int last = (y1 - 1) / block_size + 1;
    std::vector<Block> blocks;
    for (int y = first; y <= last; ++y)
        for (int x = 0; x < blocks_.width; ++x)
            blocks.push_back(block(x, std::clamp(y, 0, blocks_.height - 1)));
    const auto at = [&](int x, int y) -> const Block& {
        const int bx = std::clamp(x, 0, blocks_.width - 1);
        return blocks[std::size_t(y - first) * std::size_t(blocks_.width) + std::size_t(bx)];
    };
    const auto mix = [](const Block& a, const Block& b, double t) {
        return Block{a.squares + t * (b.squares - a.squares),
                     a.variance + t * (b.variance - a.variance)};
    };
    // Blocks are interpolated between their centres, so that no seams show. What decides is mixed
    // and not the decision, or else detail beside an even block would never come back whole.
    const std::size_t row = 3 * std::size_t(size_.width);
    for (int y = y0; y < y1; ++y) {
        const float v = (float(y) + 0.5f) / block_size - 0.5f;
        const int above = int(std::floor(v));
        float* pixel = &rows[std::size_t(y - y0) * row];
        const float* detail = &mean_[std::size_t(y) * row];
        for (int x = 0; x < size_.width; ++x) {
            const float u = (float(x) + 0.5f) / block_size - 0.5f;
            const int x0 = int(std::floor(u));
            const Block upper = mix(at(x0, above), at(x0 + 1, above), u - float(x0));
            const Block lower = mix(at(x0, above + 1), at(x0 + 1, above + 1), u - float(x0));
            const float taken = share(mix(upper, lower, v - float(above)));
            for (int c = 0; c < 3; ++c) *pixel++ += taken * *detail++;
        }
    }
}

double DetailBlend::squared_error() const {
    double sum = 0;
    for (int y = 0; y < blocks_.height; ++y) {
        for (int x = 0; x < blocks_.width; ++x) {
            const Block b = block(x, y);
            const double taken = share(b);
            // Where nothing is taken all of it is held for noise.
            const double lost = taken > 0 ? b.squares - b.variance : 0;
            sum += taken * taken * b.variance + (1 - taken) * (1 - taken) * lost;
        }
    }
    return sum;
}

}  // namespace tessera
