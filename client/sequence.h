// Picture sequences: which moments of a motion become pictures, and how their files are called.
#pragma once

#include <filesystem>
#include <functional>
#include <string>

#include "common/image.h"

namespace tessera {

/// Moments from `from` on, before `to`, `per_second` of them a second.
struct Sequence {
    double from = 0, to = 0;  ///< seconds
    double per_second = 25;

    /// At least one.
    std::uint32_t count() const;
    double seconds(std::uint32_t index) const { return from + index / per_second; }
};

/// FROM:TO:FPS; throws UserError.
Sequence parse_sequence(const std::string& text);

/// `pattern` with its one %d, or %04d for leading zeros, replaced; throws UserError when there is
/// not one.
std::string numbered_file(const std::string& pattern, std::uint32_t number);

/// Lets `write` write a file beside `file`, which then takes its place: whoever looks sees the old
/// one, none, or the whole new one.
void write_atomically(const std::string& file,
                      const std::function<void(const std::string& file)>& write);

/// Whether the file is a picture of that size and can be read to its end.
bool is_whole_picture(const std::string& file, ImageSize size);

}  // namespace tessera
