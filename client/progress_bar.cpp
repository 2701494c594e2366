#include "client/progress_bar.h"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>

namespace tessera {

ProgressBar::ProgressBar() : terminal_(isatty(STDERR_FILENO) != 0) {}

ProgressBar::~ProgressBar() { clear(); }

void ProgressBar::show(std::uint64_t done, std::uint64_t total, const std::string& remark) {
    if (!terminal_ || total == 0) return;
    constexpr int cells = 30;
    const double share = std::min(1.0, double(done) / double(total));
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start_;
    const std::string left =
        done == 0 ? "" : fmt::format(", {:.0f} s left", elapsed.count() * (1 / share - 1));
    std::string bar(std::size_t(share * cells), '#');
    bar.resize(cells, '.');
    fmt::print(stderr, "\r\x1b[K[{}] {:3.0f} %{}  {}", bar, 100 * share, left, remark);
    std::fflush(stderr);
    drawn_ = true;
}

void ProgressBar::note(const std::string& text) {
    if (text == last_note_) return;
    last_note_ = text;
    clear();
    fmt::print(stderr, "{}\n", text);
}

void ProgressBar::clear() {
    if (!drawn_) return;
    fmt::print(stderr, "\r\x1b[K");
    drawn_ = false;
}

}  // namespace tessera
