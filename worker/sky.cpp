#include "worker/sky.h"

#include "worker/texture.h"

namespace tessera {
namespace {

/// One colour is a picture, too; many rows, because those near the poles cover little.
Texture plain_picture() {
    constexpr std::uint32_t rows = 64;
    return {.width = 1, .height = rows, .rgba = {}, .radiance = std::vector<vec3>(rows, vec3(1))};
}

/// Mean over a texel of what bilinear interpolation makes of it and its neighbours.
vec3 mean_over(const Texture& picture, std::uint32_t column, std::uint32_t row) {
    const vec2 size(picture.width, picture.height);
    const vec2 centre = (vec2(column, row) + 0.5f) / size;
    constexpr float weights[3] = {0.125f, 0.75f, 0.125f};
    vec3 sum(0);
    for (int y = 0; y < 3; ++y)
        for (int x = 0; x < 3; ++x)
            sum +=
                weights[x] * weights[y] * vec3(lookup(picture, centre + vec2(x - 1, y - 1) / size));
    return sum;
}

}  // namespace

Sky::Sky(const Environment& environment, const Texture* picture)
    : scale_(glm::max(environment.radiance, vec3(0))), rotation_(environment.rotation) {
    if (scale_ == vec3(0)) return;
    picture_ = picture ? *picture : plain_picture();
    picture_.wrap_u = Wrap::repeat;
    picture_.wrap_v = Wrap::clamp;
    std::vector<float> row_weights, weights(picture_.width);
    for (std::uint32_t row = 0; row < picture_.height; ++row) {
        const float sine = std::sin(pi * (float(row) + 0.5f) / float(picture_.height));
        double sum = 0;
        for (std::uint32_t column = 0; column < picture_.width; ++column)
            sum += weights[column] =
                mean_component(scale_ * mean_over(picture_, column, row)) * sine;
        columns_.emplace_back(weights);
        row_weights.push_back(float(sum));
        mean_irradiance_ +=
            float(sum * 2 * double(pi) * double(pi) / (double(picture_.width) * picture_.height));
    }
    rows_ = Distribution(row_weights);
}

vec2 Sky::texcoord(const vec3& dir) const {
    const float longitude = std::atan2(dir.x, -dir.z) + rotation_;
    return {0.5f + longitude / (2 * pi), std::acos(std::clamp(dir.y, -1.0f, 1.0f)) / pi};
}

vec3 Sky::radiance(const vec3& dir) const {
    return empty() ? vec3(0) : scale_ * vec3(lookup(picture_, texcoord(dir)));
}

float Sky::density(std::uint32_t row, std::uint32_t column, float sine) const {
    const float share = rows_.probability(row) * columns_[row].probability(column);
    const float texels = float(picture_.width) * float(picture_.height);
    return share * texels / (2 * pi * pi * std::max(sine, 1e-6f));
}

Sky::Direction Sky::sample(const vec2& u) const {
    const auto row = rows_.sample(u.y);
    const auto column = columns_[row.index].sample(u.x);
    const float theta = pi * (float(row.index) + row.u) / float(picture_.height);
    const float longitude =
        2 * pi * ((float(column.index) + column.u) / float(picture_.width) - 0.5f) - rotation_;
    const float sine = std::sin(theta);
    return {{sine * std::sin(longitude), std::cos(theta), -sine * std::cos(longitude)},
            density(row.index, column.index, sine)};
}

float Sky::pdf(const vec3& dir) const {
    if (empty()) return 0;
    const vec2 uv = texcoord(dir);
    const auto texel = [](float x, std::uint32_t size) {
        return std::min(std::uint32_t((x - std::floor(x)) * float(size)), size - 1);
    };
    const std::uint32_t row =
        std::min(std::uint32_t(uv.y * float(picture_.height)), picture_.height - 1);
    if (rows_.probability(row) == 0) return 0;
    return density(row, texel(uv.x, picture_.width), std::sqrt(std::max(0.0f, 1 - dir.y * dir.y)));
}

}  // namespace tessera
