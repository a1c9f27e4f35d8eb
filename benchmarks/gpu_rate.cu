// Measures the float32 multiply-adds per second of a GPU, with independent chains of them.
// gpu_parts.py compiles and runs it.
#include "cuda/device.h"

constexpr int kChains = 8, kUnrolled = 32;  // also in gpu_parts.py

struct RateParams {
  int64_t n;             // loops
  const float* numbers;  // (2,)
  float* out;            // out, one per thread
  SNOW_FIELDS(n, numbers, out)
};

SNOW_KERNEL(multiply_adds, 256, RateParams) {
  const float x = p.numbers[0], y = p.numbers[1];
  float chain[kChains];
  for (int k = 0; k < kChains; k++) chain[k] = float(k) + float(threadIdx.x);
  for (int i = 0; i < int(p.n); i++) {
#pragma unroll
    for (int j = 0; j < kUnrolled; j++) {
#pragma unroll
      for (int k = 0; k < kChains; k++) chain[k] = snow::fma(chain[k], x, y);
    }
  }
  float sum = 0;
  for (int k = 0; k < kChains; k++) sum += chain[k];
  p.out[snow::thread_index()] = sum;
}
