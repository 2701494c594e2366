// A thread pool runs every job it accepts, refuses what does not fit, and drops the rest at its
// end.

#include "worker/thread_pool.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <atomic>
#include <latch>

namespace tessera {
namespace {

TEST(ThreadPool, runs_every_job) {
    constexpr int jobs = 1000;
    std::atomic<int> sum = 0;
    std::latch done(jobs);
    ThreadPool pool(4, jobs);
    for (int i = 1; i <= jobs; ++i)
        ASSERT_TRUE(pool.try_post([&, i] {
            sum += i;
            done.count_down();
        }));
    done.wait();
    EXPECT_EQ(sum, jobs * (jobs + 1) / 2);
}

TEST(ThreadPool, one_thread_keeps_the_order) {
    std::vector<int> order;
    std::latch done(1);
    ThreadPool pool(1, 101);
    for (int i = 0; i < 100; ++i) ASSERT_TRUE(pool.try_post([&, i] { order.push_back(i); }));
    ASSERT_TRUE(pool.try_post([&] { done.count_down(); }));
    done.wait();
    EXPECT_TRUE(std::ranges::is_sorted(order));
    EXPECT_EQ(order.size(), 100u);
}

TEST(ThreadPool, refuses_more_than_fits_and_drops_what_waits_at_its_end) {
    std::latch begun(1);
    std::latch release(1);
    std::atomic<int> ran = 0;
    {
        ThreadPool pool(1, 2);
        ASSERT_TRUE(pool.try_post([&] {
            begun.count_down();
            release.wait();
            ++ran;
        }));
        begun.wait();
        EXPECT_TRUE(pool.try_post([&] { ++ran; }));
        EXPECT_TRUE(pool.try_post([&] { ++ran; }));
        EXPECT_FALSE(pool.try_post([&] { ++ran; }));
        release.count_down();
    }
    EXPECT_GE(ran, 1);
    EXPECT_LE(ran, 3);
}

}  // namespace
}  // namespace tessera
