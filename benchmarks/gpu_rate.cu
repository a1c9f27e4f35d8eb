// How many float32 multiply-adds a GPU does in a second: chains of them that do not wait for each
// other, and nothing else. gpu_parts.py compiles and runs it.
#include "cuda/device.h"

constexpr int kChains = 8, kUnrolled = 32;  // gpu_parts.py knows them, too

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
