#include "server/frame_trace.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <numeric>

namespace tessera {

void FrameTrace::add(const std::string& who, unsigned threads, const std::string& what,
                     Clock::duration time, Clock::time_point done) {
    if (spans_.size() == max_spans) {
        ++left_out_;
        return;
    }
    const auto actor =
        std::find_if(actors_.begin(), actors_.end(), [&](const Actor& a) { return a.name == who; });
    const auto index = std::size_t(actor - actors_.begin());
    if (actor == actors_.end()) actors_.push_back({who, std::max(threads, 1u)});
    spans_.push_back({index, what, time, done});
}

std::string FrameTrace::json() const {
    const auto microseconds = [](Clock::duration time) {
        return std::chrono::duration<double, std::micro>(time).count();
    };
    std::vector<std::size_t> latest_first(spans_.size());
    std::iota(latest_first.begin(), latest_first.end(), std::size_t(0));
    std::stable_sort(latest_first.begin(), latest_first.end(),
                     [&](std::size_t a, std::size_t b) { return spans_[a].done > spans_[b].done; });

    // Backwards in time, each span ends as late as it can on one of its actor's threads.
    nlohmann::json events = nlohmann::json::array();
    std::vector<std::vector<Clock::time_point>> busy_from;
    for (const Actor& actor : actors_)
        busy_from.emplace_back(actor.threads, Clock::time_point::max());
    for (const std::size_t i : latest_first) {
        const Span& span = spans_[i];
        auto& threads = busy_from[span.who];
        const auto thread = std::max_element(threads.begin(), threads.end());
        *thread = std::min(*thread, span.done) - span.time;
        events.push_back({{"name", span.what},
                          {"ph", "X"},
                          {"pid", span.who + 1},
                          {"tid", thread - threads.begin() + 1},
                          {"ts", microseconds(*thread - start_)},
                          {"dur", microseconds(span.time)}});
    }
    for (std::size_t i = 0; i < actors_.size(); ++i)
        events.push_back({{"name", "process_name"},
                          {"ph", "M"},
                          {"pid", i + 1},
                          {"args", {{"name", actors_[i].name}}}});
    const nlohmann::json trace = {{"traceEvents", events},
                                  {"otherData", {{"spans_left_out", left_out_}}}};
    return trace.dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
}

}  // namespace tessera
