// The timeline of a frame, as Chrome's tracer and Perfetto show it: who rendered which tile when,
// and what the server did meanwhile. The file is Google's "Trace Event Format".
#pragma once

#include <chrono>
#include <cstdint>
#include <string>
#include <vector>

namespace tessera {

class FrameTrace {
public:
    using Clock = std::chrono::steady_clock;

    /// Times are shown from `start` on.
    explicit FrameTrace(Clock::time_point start) : start_(start) {}

    /// Something that `who` did, named `what`: it took `time`, and was known to be done at `done`.
    /// One does as many things at a time as it has `threads`: of what became known at once, some
    /// had been done earlier. After max_spans nothing more is taken down.
    void add(const std::string& who, unsigned threads, const std::string& what,
             Clock::duration time, Clock::time_point done);

    std::string json() const;

    static constexpr std::size_t max_spans = 100'000;

private:
    struct Actor {
        std::string name;
        unsigned threads = 1;
    };
    struct Span {
        std::size_t who = 0;  ///< index into actors_
        std::string what;
        Clock::duration time{};
        Clock::time_point done;
    };

    Clock::time_point start_;
    std::vector<Actor> actors_;
    std::vector<Span> spans_;
    std::uint64_t left_out_ = 0;
};

}  // namespace tessera
