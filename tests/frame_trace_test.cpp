// The timeline of a frame: nothing lost, nothing drawn over something else.
#include "server/frame_trace.h"

#include <gtest/gtest.h>

#include <map>
#include <nlohmann/json.hpp>
#include <random>

namespace tessera {
namespace {

using Clock = FrameTrace::Clock;

TEST(FrameTrace, a_thread_does_one_thing_at_a_time) {
    const Clock::time_point start{};
    FrameTrace trace(start);
    std::mt19937 random(1);
    std::map<std::string, double> known;  // microseconds by which it was done
    double total = 0;
    for (int i = 0; i < 1000; ++i) {
        const auto done = std::chrono::milliseconds(random() % 100);  // many at once
        const auto time = std::chrono::microseconds(1 + random() % 2000);
        const std::string what = std::to_string(i);
        trace.add(i % 2 ? "worker \"a\"" : "worker \xff", i % 2 ? 3 : 1, what, time, start + done);
        total += double(time.count());
        known[what] = 1e3 * double(done.count());
    }
    std::map<std::pair<int, int>, std::map<double, double>> threads;
    int names = 0;
    double drawn = 0;
    const auto json = nlohmann::json::parse(trace.json());
    for (const auto& event : json.at("traceEvents")) {
        names += event.at("ph") == "M";
        if (event.at("ph") == "M") continue;
        const double from = event.at("ts"), time = event.at("dur");
        EXPECT_LE(from + time, known.at(event.at("name")) + 1e-3);
        threads[{event.at("pid"), event.at("tid")}][from] = from + time;
        drawn += time;
    }
    EXPECT_EQ(names, 2);
    EXPECT_EQ(threads.size(), 4u);
    EXPECT_NEAR(drawn, total, 1e-3);
    for (const auto& [thread, spans] : threads) {
        double idle_from = -1e9;
        for (const auto& [from, to] : spans) {
            EXPECT_GE(from, idle_from - 1e-3);
            idle_from = to;
        }
    }
}

TEST(FrameTrace, says_what_it_left_out) {
    FrameTrace trace(Clock::time_point{});
    for (std::size_t i = 0; i < FrameTrace::max_spans + 3; ++i) trace.add("a", 1, "b", {}, {});
    const auto json = nlohmann::json::parse(trace.json());
    EXPECT_EQ(json.at("otherData").at("spans_left_out"), 3);
    EXPECT_EQ(json.at("traceEvents").size(), FrameTrace::max_spans + 1);
}

}  // namespace
}  // namespace tessera
