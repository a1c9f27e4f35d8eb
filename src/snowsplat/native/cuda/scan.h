// Prefix sums over the threads of a warp and of a block.
#pragma once

#include "cuda/device.h"

namespace snow {

// The sum of the values of this lane and those below it. All lanes must take part.
template <class T>
SNOW_INLINE T warp_inclusive_scan(T value) {
#pragma unroll
  for (int step = 1; step < kWarp; step *= 2) {
    const T below = __shfl_up_sync(kAllLanes, value, unsigned(step));
    if (lane_id() >= step) value += below;
  }
  return value;
}

template <class T>
struct BlockScan {
  T before, total;  // the sum over the threads before this one; the sum over all threads
};

// All threads of the block must take part.
template <int kThreads, class T>
SNOW_INLINE BlockScan<T> block_scan(T value) {
  constexpr int kWarps = kThreads / kWarp;
  SNOW_SHARED(T, warp_sums, kWarps);
  const T through = warp_inclusive_scan(value);
  if (lane_id() == kWarp - 1) warp_sums[warp_id()] = through;
  __syncthreads();
  BlockScan<T> scan = {T(through - value), T(0)};
#pragma unroll
  for (int w = 0; w < kWarps; w++) {
    if (w < warp_id()) scan.before += warp_sums[w];
    scan.total += warp_sums[w];
  }
  __syncthreads();  // the next scan writes the same array
  return scan;
}

}  // namespace snow
