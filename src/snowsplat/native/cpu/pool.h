// A small pool of threads shared by all kernels of this library.
//
// parallel_for(tasks, body) calls body(task) once for each task in [0, tasks), on any thread and in
// any order. The result of a kernel must not depend on the thread or the order. Idle workers sleep
// after a short spin, so that waiting does not slow down other processes. Within `body`, denormal
// numbers are flushed to zero; the caller's mode is restored afterwards.
#pragma once

#include <cstdint>

namespace snow {

int pool_size();
void pool_run(int64_t tasks, void (*body)(void* context, int64_t task), void* context);

template <class F>
inline void parallel_for(int64_t tasks, F&& body) {
  pool_run(tasks, [](void* context, int64_t task) { (*static_cast<F*>(context))(task); }, &body);
}

// Splits [0, n) into `parts` contiguous ranges, at multiples of `unit`, and returns number `part`.
struct Range {
  int64_t begin, end;
};
inline Range split_range(int64_t n, int64_t parts, int64_t part, int64_t unit = 1) {
  const int64_t units = (n + unit - 1) / unit;
  const int64_t begin = units * part / parts * unit, end = units * (part + 1) / parts * unit;
  return {begin < n ? begin : n, end < n ? end : n};
}

}  // namespace snow
