#include "worker/texture.h"

#include <array>

#include "common/tone_map.h"

namespace tessera {
namespace {

std::array<float, 256> make_srgb_table() {
    std::array<float, 256> table;
    for (int i = 0; i < 256; ++i) table[i] = linear_from_srgb(float(i) / 255);
    return table;
}

float decode(const Texture& texture, std::uint8_t value) {
    static const std::array<float, 256> linear = make_srgb_table();
    return texture.srgb ? linear[value] : float(value) / 255;
}

std::int64_t wrapped(std::int64_t i, std::int64_t size, Wrap wrap) {
    if (wrap == Wrap::clamp) return std::clamp<std::int64_t>(i, 0, size - 1);
    const std::int64_t period = wrap == Wrap::mirror ? 2 * size : size;
    const std::int64_t inside = ((i % period) + period) % period;
    return inside < size ? inside : period - 1 - inside;
}

vec4 texel(const Texture& texture, std::int64_t x, std::int64_t y) {
    const std::int64_t column = wrapped(x, texture.width, texture.wrap_u);
    const std::int64_t row = wrapped(y, texture.height, texture.wrap_v);
    const auto index = std::size_t(row * texture.width + column);
    if (!texture.radiance.empty()) return {texture.radiance[index], 1};
    const std::uint8_t* p = &texture.rgba[4 * index];
    return {decode(texture, p[0]), decode(texture, p[1]), decode(texture, p[2]), float(p[3]) / 255};
}

}  // namespace

vec2 apply(const TextureMap& map, const vec2& uv) {
    const vec2 scaled = map.scale * uv;
    if (map.rotation == 0) return scaled + map.offset;
    const float c = std::cos(map.rotation);
    const float s = std::sin(map.rotation);
    return vec2(c * scaled.x + s * scaled.y, c * scaled.y - s * scaled.x) + map.offset;
}

vec4 lookup(const Texture& texture, const vec2& uv) {
    const float x = uv.x * float(texture.width) - 0.5f;
    const float y = uv.y * float(texture.height) - 0.5f;
    constexpr float limit = 1e9f;  // texels; beyond it floats have no fraction left anyway
    if (!(std::abs(x) < limit && std::abs(y) < limit)) return vec4(0);
    const float x0 = std::floor(x);
    const float y0 = std::floor(y);
    const auto ix = std::int64_t(x0);
    const auto iy = std::int64_t(y0);
    const vec4 top = mix(texel(texture, ix, iy), texel(texture, ix + 1, iy), x - x0);
    const vec4 bottom = mix(texel(texture, ix, iy + 1), texel(texture, ix + 1, iy + 1), x - x0);
    return mix(top, bottom, y - y0);
}

vec3 mean_color(const Texture& texture) {
    double sum[3] = {0, 0, 0};
    for (const vec3& texel : texture.radiance)
        for (int c = 0; c < 3; ++c) sum[c] += double(texel[c]);
    for (std::size_t i = 0; i < texture.rgba.size(); i += 4)
        for (int c = 0; c < 3; ++c) sum[c] += decode(texture, texture.rgba[i + c]);
    const double texels = double(texture.width) * texture.height;
    return vec3(sum[0] / texels, sum[1] / texels, sum[2] / texels);
}

}  // namespace tessera
