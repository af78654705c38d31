#include "core/thread_pool.hpp"

#include <stdexcept>
#include <string>
#include <system_error>
#include <utility>

namespace splatpilot {
namespace {

constexpr int kSpins = 2000;  // of the order of 20 us

void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

// Waits until `value` differs from `old`; returns it.
uint32_t wait_for_change(const std::atomic<uint32_t>& value, uint32_t old) {
  for (int spin = 0; spin < kSpins; ++spin) {
    const uint32_t now = value.load(std::memory_order_acquire);
    if (now != old) return now;
    pause();
  }
  value.wait(old, std::memory_order_acquire);
  return value.load(std::memory_order_acquire);
}

}  // namespace

ThreadPool::ThreadPool(int threads) {
  try {
    for (int i = 1; i < threads; ++i) workers_.emplace_back([this] { work(); });
  } catch (const std::system_error& error) {
    const int started = this->threads();
    stop();
    throw std::runtime_error("only " + std::to_string(started) + " of " + std::to_string(threads) +
                             " threads could be started: " + error.what());
  }
}

ThreadPool::~ThreadPool() { stop(); }

void ThreadPool::stop() {
  stop_.store(true);
  loop_.fetch_add(1);
  loop_.notify_all();
  for (std::thread& worker : workers_) worker.join();
}

// A worker increments active_ and then reads open_; the caller clears open_ and then reads active_.
// In the single order of these operations one of the two sees the other, so the caller waits for
// exactly the workers inside the loop.
void ThreadPool::run(size_t tasks, Call call, const void* body) {
  call_ = call;
  body_ = body;
  tasks_ = tasks;
  next_task_.store(0);
  open_.store(true);
  loop_.fetch_add(1);
  loop_.notify_all();
  take_tasks();
  open_.store(false);
  for (uint32_t active = active_.load(); active != 0;) active = wait_for_change(active_, active);
  if (failure_) std::rethrow_exception(std::exchange(failure_, nullptr));
}

void ThreadPool::take_tasks() {
  try {
    for (size_t task; (task = next_task_.fetch_add(1, std::memory_order_relaxed)) < tasks_;) {
      call_(body_, task);
    }
  } catch (...) {
    next_task_.store(tasks_);
    const std::scoped_lock lock(failure_mutex_);
    if (!failure_) failure_ = std::current_exception();
  }
}

void ThreadPool::work() {
  for (uint32_t seen = 0;;) {
    seen = wait_for_change(loop_, seen);
    if (stop_.load()) return;
    active_.fetch_add(1);
    if (open_.load()) take_tasks();
    if (active_.fetch_sub(1) == 1) active_.notify_one();
  }
}

}  // namespace splatpilot
