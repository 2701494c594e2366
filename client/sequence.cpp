#include "client/sequence.h"

#include <fmt/format.h>

#include <cmath>

#include "common/check.h"
#include "common/image_io.h"
#include "common/text_reader.h"

namespace tessera {
namespace {

/// Pictures of one sequence: more are a slip of the hand.
constexpr double most_pictures = 1e6;

[[noreturn]] void no_sequence(const std::string& text) {
    throw UserError(fmt::format(
        "--animate {}: FROM:TO:FPS is wanted, in seconds, as in 0:2.5:25, with TO after FROM and "
        "at most a million pictures",
        text));
}

/// Where the number goes: its first and last character, and how wide it is at least.
struct Place {
    std::size_t begin = 0, end = 0;
    int width = 0;
};

Place number_in(const std::string& pattern) {
    const std::size_t begin = pattern.find('%');
    const std::size_t end =
        begin == std::string::npos ? begin : pattern.find_first_not_of("0123456789", begin + 1);
    const bool one = end != std::string::npos && pattern[end] == 'd' && end - begin <= 3 &&
                     pattern.find('%', end) == std::string::npos;
    if (!one)
        throw UserError(fmt::format(
            "-o {}: the name of numbered pictures needs one %d, as in picture_%04d.png", pattern));
    const std::string width = pattern.substr(begin + 1, end - begin - 1);
    return {begin, end + 1, width.empty() ? 0 : std::stoi(width)};
}

}  // namespace

std::uint32_t Sequence::count() const {
    return std::uint32_t(std::max(1.0, std::round((to - from) * per_second)));
}

Sequence parse_sequence(const std::string& text) {
    const std::size_t first = text.find(':'), last = text.rfind(':');
    if (first == last) no_sequence(text);
    Sequence out;
    if (!parse_number(text.substr(0, first), out.from) ||
        !parse_number(text.substr(first + 1, last - first - 1), out.to) ||
        !parse_number(text.substr(last + 1), out.per_second) || !(out.to >= out.from) ||
        !(out.per_second > 0) || !((out.to - out.from) * out.per_second <= most_pictures))
        no_sequence(text);
    return out;
}

std::string numbered_file(const std::string& pattern, std::uint32_t number) {
    const Place place = number_in(pattern);
    return pattern.substr(0, place.begin) + fmt::format("{:0{}}", number, place.width) +
           pattern.substr(place.end);
}

void write_atomically(const std::string& file,
                      const std::function<void(const std::string& file)>& write) {
    const std::filesystem::path path(file);
    // The extension stays: it names the format.
    const std::filesystem::path part =
        path.parent_path() / (path.stem().string() + ".part" + path.extension().string());
    write(part.string());
    std::filesystem::rename(part, path);
}

bool is_whole_picture(const std::string& file, ImageSize size) {
    if (!std::filesystem::exists(file)) return false;
    try {
        return read_image(file).size == size;
    } catch (const UserError&) {
        return false;
    }
}

}  // namespace tessera
