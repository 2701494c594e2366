// Threads that run jobs in the order they were posted.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <deque>
#include <functional>
#include <mutex>
#include <thread>
#include <vector>

namespace tessera {

class ThreadPool {
public:
    /// At most `capacity` jobs wait; who posts more decides what that means.
    ThreadPool(unsigned threads, std::size_t capacity);
    /// Drops the jobs not yet begun and waits for the others.
    ~ThreadPool();

    /// Queues a job; returns false, and drops it, when the queue is full. Jobs do not throw.
    /// Thread-safe.
    [[nodiscard]] bool try_post(std::function<void()> job);

private:
    void run_jobs();

    std::mutex mutex_;
    std::condition_variable changed_;
    std::deque<std::function<void()>> jobs_;
    std::size_t capacity_;
    bool stopping_ = false;
    std::vector<std::thread> threads_;
};

}  // namespace tessera
