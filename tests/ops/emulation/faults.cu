// Kernels for testing the emulation: faults that it must detect, and known results.
#include "cuda/device.h"

using namespace snow;

template <class T>
struct FaultParams {
  int64_t n;
  const T* given;
  T* out;
  float* total;
  SNOW_FIELDS(n, given, out, total)
};

// Threads below n wait at another place than the others.
SNOW_KERNEL(two_barriers, 64, FaultParams<int32_t>) {
  if (threadIdx.x < p.n) {
    __syncthreads();
  } else {
    __syncthreads();
  }
  p.out[threadIdx.x] = 1;
}

// Threads below n wait for the block, the others for their warps.
SNOW_KERNEL(barrier_or_vote, 64, FaultParams<int32_t>) {
  if (threadIdx.x < p.n) {
    __syncthreads();
  } else {
    __syncwarp();
    __syncthreads();
  }
  p.out[threadIdx.x] = 1;
}

// Lane n of each warp has returned while the others wait for it.
SNOW_KERNEL(absent_lane, 64, FaultParams<int32_t>) {
  if (lane_id() == p.n) return;
  p.out[threadIdx.x] = __shfl_sync(kAllLanes, int(threadIdx.x), 0);
}

// As many lanes as a warp has, in a block that ends in the middle of one.
SNOW_KERNEL(short_warp, 48, FaultParams<int32_t>) {
  if (threadIdx.x < p.n) p.out[threadIdx.x] = __any_sync(kAllLanes, 1);
}

// The lanes of a warp wait with different masks.
SNOW_KERNEL(two_masks, 32, FaultParams<int32_t>) {
  p.out[threadIdx.x] = __shfl_sync(lane_id() < p.n ? 0xffffu : kAllLanes, 1, 0);
}

// Lane n waits with a mask that it is not in.
SNOW_KERNEL(not_in_its_mask, 32, FaultParams<int32_t>) {
  p.out[threadIdx.x] = __ballot_sync(~(1u << p.n), 1) != 0;
}

// Correct only if each thread runs after the previous one.
SNOW_KERNEL(missing_barrier, 64, FaultParams<int32_t>) {
  SNOW_SHARED(int32_t, row, 64);
  const int t = int(threadIdx.x);
  row[t] = p.given[t];
  p.out[t] = row[t < p.n ? t : t - int(p.n)];
}

// The same within a warp, without __syncwarp.
SNOW_KERNEL(missing_warp_barrier, 32, FaultParams<int32_t>) {
  SNOW_SHARED(int32_t, row, 32);
  row[lane_id()] = p.given[lane_id()];
  if (p.n) __syncwarp();
  p.out[lane_id()] = row[31 - lane_id()];
}

SNOW_KERNEL(never_written, 32, FaultParams<float>) {
  SNOW_SHARED(float, row, 32);
  if (threadIdx.x < p.n) row[threadIdx.x] = 1.f;
  __syncthreads();
  p.out[threadIdx.x] = row[threadIdx.x];
  __syncthreads();
  row[threadIdx.x] = 2.f;  // must not be visible in the next block
}

SNOW_KERNEL(beyond_shared, 32, FaultParams<int32_t>) {
  SNOW_SHARED(int32_t, row, 32);
  row[threadIdx.x] = 1;
  __syncthreads();
  p.out[threadIdx.x] = row[threadIdx.x + p.n];
}

SNOW_KERNEL(beyond_the_tensor, 32, FaultParams<int32_t>) { p.out[threadIdx.x + p.n] = 1; }

SNOW_KERNEL(shifted_too_far, 32, FaultParams<int32_t>) {
  p.out[threadIdx.x] = int32_t(threadIdx.x) << p.n;
}

SNOW_KERNEL(double_all, 64, FaultParams<int32_t>) {
  if (thread_index() < p.n) p.out[thread_index()] *= 2;
}
