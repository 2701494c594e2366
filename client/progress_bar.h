// A progress bar on standard error: one line redrawn on a terminal, nothing but the notes
// elsewhere.
#pragma once

#include <chrono>
#include <string>

namespace tessera {

class ProgressBar {
public:
    ProgressBar();
    ~ProgressBar();

    /// Redraws with `done` of `total` and a remark; estimates the time left from the rate so far.
    void show(std::uint64_t done, std::uint64_t total, const std::string& remark);
    /// Prints a line of its own above the bar; the same note twice in a row is printed once.
    void note(const std::string& text);

private:
    void clear();

    bool terminal_;
    bool drawn_ = false;
    std::string last_note_;
    std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace tessera
