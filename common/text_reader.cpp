#include "common/text_reader.h"

#include <fmt/format.h>

#include <charconv>
#include <fstream>

#include "common/check.h"

namespace tessera {
namespace {

constexpr std::string_view blanks = " \t\r";

template <class T>
bool parse(std::string_view word, T& value) {
    if (word.starts_with('+')) word.remove_prefix(1);
    const char* end = word.data() + word.size();
    const auto [stop, error] = std::from_chars(word.data(), end, value);
    return error == std::errc() && stop == end;
}

}  // namespace

std::string read_file(const std::filesystem::path& file) {
    std::ifstream in(file, std::ios::binary | std::ios::ate);
    if (!in || std::filesystem::is_directory(file))
        throw UserError(fmt::format("{}: cannot open this file; check its name and permissions",
                                    file.string()));
    std::string bytes(std::size_t(in.tellg()), '\0');
    in.seekg(0);
    if (!in.read(bytes.data(), std::streamsize(bytes.size())))
        throw UserError(fmt::format("{}: cannot read this file", file.string()));
    return bytes;
}

bool lies_within(const std::filesystem::path& folder, const std::filesystem::path& file) {
    std::error_code error;
    const auto whole = [&](const std::filesystem::path& path) {
        return std::filesystem::weakly_canonical(std::filesystem::absolute(path), error);
    };
    const std::filesystem::path within = whole(file).lexically_relative(whole(folder));
    return !error && !within.empty() && *within.begin() != "..";
}

bool TextReader::next_line() {
    if (next_ >= text_.size()) return false;
    const std::size_t end = std::min(text_.find('\n', next_), text_.size());
    line_ = text_.substr(next_, end - next_);
    next_ = end + 1;
    ++line_number_;
    return true;
}

std::string_view TextReader::word() {
    std::string_view word;
    do {
        line_.remove_prefix(std::min(line_.find_first_not_of(blanks), line_.size()));
        word = line_.substr(0, line_.find_first_of(blanks));
        line_.remove_prefix(word.size());
        // A backslash at the end continues the line (OBJ).
    } while (word == "\\" && rest().empty() && next_line());
    return word;
}

std::string_view TextReader::rest() {
    const std::size_t begin = std::min(line_.find_first_not_of(blanks), line_.size());
    line_.remove_prefix(begin);
    return line_.substr(0, line_.find_last_not_of(blanks) + 1);
}

double TextReader::number() {
    const std::string_view text = word();
    double value;
    if (text.empty()) fail("a number is missing at the end of the line; add it");
    if (!parse_number(text, value))
        fail(fmt::format("'{}' is no number; correct it", text.substr(0, 40)));
    return value;
}

void TextReader::fail(const std::string& what) const {
    throw UserError(fmt::format("{}:{}: {}", file_, line_number_, what));
}

bool parse_number(std::string_view word, std::int64_t& value) { return parse(word, value); }
bool parse_number(std::string_view word, double& value) { return parse(word, value); }

}  // namespace tessera
