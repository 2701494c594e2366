// The words of a text file, line by line, for the readers of OBJ and PLY. Knows at which line it
// is, so that every complaint names it.
#pragma once

#include <cstdint>
#include <filesystem>
#include <string>
#include <string_view>

namespace tessera {

/// The bytes of a file. Throws UserError when it cannot be read.
std::string read_file(const std::filesystem::path& file);

/// Whether `file` lies in `folder` or below it, links followed: a scene from elsewhere must not
/// make its reader open other files of this machine.
bool lies_within(const std::filesystem::path& folder, const std::filesystem::path& file);

class TextReader {
public:
    /// Reads `text`, which must outlive the reader; `file` is for messages.
    TextReader(std::string file, std::string_view text) : file_(std::move(file)), text_(text) {}

    /// Moves to the next line; false at the end of the text.
    bool next_line();
    /// The next word of the line, empty at its end.
    std::string_view word();
    /// What is left of the line, without blanks around it.
    std::string_view rest();
    /// The next word as a number; fails when it is none. NaN and infinity are numbers.
    double number();

    /// Where the next line starts, in bytes.
    std::size_t offset() const { return next_; }

    /// Throws UserError "file:line: what".
    [[noreturn]] void fail(const std::string& what) const;

private:
    std::string file_;
    std::string_view text_;
    std::string_view line_;
    std::size_t next_ = 0;
    std::size_t line_number_ = 0;
};

/// The whole word as an integer or floating-point number, or false.
bool parse_number(std::string_view word, std::int64_t& value);
bool parse_number(std::string_view word, double& value);

}  // namespace tessera
