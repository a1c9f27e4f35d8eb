// Measures the float32 multiply-adds per second of a GPU, with independent chains of them.
// gpu_parts.py compiles and runs it.
#include "cuda/device.h"

constexpr int kChains = 8, kUnrolled = 32;  // also in gpu_parts.py

SNOW_KERNEL(multiply_adds, 256, (int64_t loops, const float* numbers, float* out)) {
  const float x = numbers[0], y = numbers[1];
  float chain[kChains];
  for (int k = 0; k < kChains; k++) chain[k] = float(k) + float(threadIdx.x);
  for (int i = 0; i < int(loops); i++) {
#pragma unroll
    for (int j = 0; j < kUnrolled; j++) {
#pragma unroll
      for (int k = 0; k < kChains; k++) chain[k] = snow::fma(chain[k], x, y);
    }
  }
  float sum = 0;
  for (int k = 0; k < kChains; k++) sum += chain[k];
  out[snow::thread_index()] = sum;
}
