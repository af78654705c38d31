// A small pool that runs the numbered tasks of one loop at a time.
#pragma once

#include <atomic>
#include <cstdint>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

namespace splatpilot {

// Workers spin for some microseconds after a loop, since the next stage of a frame follows at once,
// then sleep until called: an idle pool costs nothing. A loop does not wait for workers that have
// yet to wake. A pool of one thread runs everything in the caller.
class ThreadPool {
 public:
  explicit ThreadPool(int threads);
  ~ThreadPool();
  ThreadPool(const ThreadPool&) = delete;
  ThreadPool& operator=(const ThreadPool&) = delete;

  int threads() const { return static_cast<int>(workers_.size()) + 1; }

  // Calls body(task) once for each task in [0, tasks), in any order on any thread. After an
  // exception, tasks that have not begun are left out; it is rethrown when no thread is in the
  // loop.
  template <typename Body>
  void for_each(size_t tasks, const Body& body) {
    if (workers_.empty() || tasks < 2) {
      for (size_t task = 0; task < tasks; ++task) body(task);
      return;
    }
    run(
        tasks, [](const void* b, size_t task) { (*static_cast<const Body*>(b))(task); }, &body);
  }

 private:
  using Call = void (*)(const void* body, size_t task);
  void run(size_t tasks, Call call, const void* body);
  void work();
  void take_tasks();
  void stop();

  std::vector<std::thread> workers_;
  Call call_ = nullptr;
  const void* body_ = nullptr;
  size_t tasks_ = 0;
  std::atomic<size_t> next_task_{0};
  std::atomic<bool> open_{false};    // whether the current loop still takes workers
  std::atomic<uint32_t> active_{0};  // workers inside the current loop
  std::atomic<uint32_t> loop_{0};    // counts loops; workers wait for it to change
  std::atomic<bool> stop_{false};
  std::mutex failure_mutex_;
  std::exception_ptr failure_;  // the first of the current loop
};

}  // namespace splatpilot
