// The thread pool: see pool.h for its guarantees.
#include "cpu/pool.h"

#if !defined(_WIN32)
#include <pthread.h>
#endif

#include <atomic>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>

#include "cpu/entry.h"
#include "simd.h"

namespace snow {
namespace {

inline void relax() {
#if defined(__x86_64__)
  _mm_pause();
#elif defined(__aarch64__)
  asm volatile("yield");
#endif
}

constexpr int kSpins = 2000;  // some tens of microseconds

class Pool {
 public:
  explicit Pool(int size) {
    for (int i = 1; i < size; i++) workers_.emplace_back([this] { work(); });
  }
  ~Pool() {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      stop_ = true;
      generation_++;
    }
    wake_.notify_all();
    for (auto& w : workers_) w.join();
  }
  int size() const { return int(workers_.size()) + 1; }

  void run(int64_t tasks, void (*body)(void*, int64_t), void* context) {
    std::lock_guard<std::mutex> one_at_a_time(run_mutex_);
    body_ = body, context_ = context, tasks_ = tasks;
    next_.store(0, std::memory_order_relaxed);
    busy_.store(int(workers_.size()), std::memory_order_relaxed);
    {
      std::lock_guard<std::mutex> lock(mutex_);
      generation_++;
    }
    if (sleepers_.load() > 0) wake_.notify_all();
    drain();
    for (int i = 0; busy_.load(std::memory_order_acquire) > 0; i++) {
      if (i < kSpins) {
        relax();
      } else {
        std::unique_lock<std::mutex> lock(mutex_);
        done_.wait(lock, [this] { return busy_.load(std::memory_order_acquire) == 0; });
      }
    }
  }

 private:
  void drain() {
    for (int64_t t; (t = next_.fetch_add(1, std::memory_order_relaxed)) < tasks_;)
      body_(context_, t);
  }
  void work() {
    FlushDenormals flush;
    uint64_t seen = 0;
    for (;;) {
      for (int i = 0; i < kSpins && generation_.load(std::memory_order_acquire) == seen; i++)
        relax();
      if (generation_.load(std::memory_order_acquire) == seen) {
        std::unique_lock<std::mutex> lock(mutex_);
        sleepers_++;
        wake_.wait(lock, [&] { return generation_.load() != seen; });
        sleepers_--;
      }
      seen = generation_.load(std::memory_order_acquire);
      if (stop_) return;
      drain();
      if (busy_.fetch_sub(1, std::memory_order_acq_rel) == 1) {
        std::lock_guard<std::mutex> lock(mutex_);
        done_.notify_one();
      }
    }
  }

  std::vector<std::thread> workers_;
  std::mutex run_mutex_, mutex_;
  std::condition_variable wake_, done_;
  std::atomic<uint64_t> generation_{0};
  std::atomic<int> sleepers_{0}, busy_{0};
  std::atomic<int64_t> next_{0};
  int64_t tasks_ = 0;
  void (*body_)(void*, int64_t) = nullptr;
  void* context_ = nullptr;
  bool stop_ = false;
};

std::mutex pool_mutex;
Pool* pool = nullptr;
int wanted = 1;

#if !defined(_WIN32)
// A forked process does not have the threads of its parent. So the pool is discarded, and a new one
// is created when it is needed.
void after_fork_in_child() {
  new (&pool_mutex) std::mutex;
  pool = nullptr;
}
#endif

}  // namespace

int pool_size() { return wanted; }

void pool_run(int64_t tasks, void (*body)(void*, int64_t), void* context) {
  if (tasks <= 0) return;
  FlushDenormals flush;
  if (wanted == 1 || tasks == 1) {
    for (int64_t t = 0; t < tasks; t++) body(context, t);
    return;
  }
  {
    std::lock_guard<std::mutex> lock(pool_mutex);
#if !defined(_WIN32)  // which has no fork
    static const int registered = pthread_atfork(nullptr, nullptr, after_fork_in_child);
    (void)registered;
#endif
    if (!pool) pool = new Pool(wanted);
  }
  pool->run(tasks, body, context);
}

}  // namespace snow

SNOW_EXPORT int64_t set_num_threads(int64_t n) {
  std::lock_guard<std::mutex> lock(snow::pool_mutex);
  const int size = n < 1 ? 1 : n > 1024 ? 1024 : int(n);
  if (size != snow::wanted) {
    delete snow::pool;
    snow::pool = nullptr;
    snow::wanted = size;
  }
  return snow::wanted;
}

SNOW_EXPORT int64_t get_num_threads() { return snow::wanted; }
