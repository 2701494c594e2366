// False colours: numbers of a channel as colours whose lightness rises evenly, so that no edge is
// seen where there is none, and that people with colour-blindness can order. The map is viridis
// (Smith and van der Walt, "A Better Default Colormap for Matplotlib", 2015) at nine points.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

#include "common/image.h"
#include "common/tile.h"
#include "common/tone_map.h"

namespace tessera {

using Rgb8 = std::array<std::uint8_t, 3>;

/// Dark blue at 0, yellow at 1; grey for what is no number.
Rgb8 viridis(float t);

/// Colours for numbers without order, such as workers'; those of neighbours differ well.
Rgb8 colour_of_number(std::uint64_t number);

/// Where a value of the channel lies on the map, 0 to 1; NaN where there is none.
float map_position(Channel channel, float value);

struct LegendMark {
    float position = 0;  ///< on the map
    std::string text;
};
/// Empty for channels that are shown as they are.
std::vector<LegendMark> legend_of(Channel channel);

/// How command lines call the channels.
const std::map<std::string, Channel>& channel_names();

/// A channel for the eye, three bytes per pixel: numbers in false colours, normals as n / 2 + 1/2,
/// what is light by `tone_map`.
std::vector<std::uint8_t> to_rgb8(const Image& image, Channel channel, const ToneMap& tone_map);

}  // namespace tessera
