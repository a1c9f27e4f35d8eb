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

// Allowed: threads that have ended do not count. Sums the n first elements.
SNOW_KERNEL(early_return, 64, FaultParams<int32_t>) {
  SNOW_SHARED(int32_t, row, 64);
  const int t = int(threadIdx.x);
  if (t >= p.n) return;
  row[t] = p.given[t];
  __syncthreads();
  if (t > 0) return;
  int sum = 0;
  for (int i = 0; i < p.n; i++) sum += row[i];
  p.out[0] = sum;
}

// Each row of 32 of `out` is another exchange of `in`, with all lanes.
SNOW_KERNEL(exchanges, 32, FaultParams<int32_t>) {
  const int l = lane_id(), value = p.given[l];
  p.out[l] = __shfl_sync(kAllLanes, value, int(p.n));
  p.out[32 + l] = __shfl_up_sync(kAllLanes, value, unsigned(p.n));
  p.out[64 + l] = __shfl_down_sync(kAllLanes, value, unsigned(p.n));
  p.out[96 + l] = __shfl_xor_sync(kAllLanes, value, int(p.n));
  p.out[128 + l] = __shfl_sync(kAllLanes, value, l + 1, 8);
  p.out[160 + l] = __shfl_down_sync(kAllLanes, value, unsigned(p.n), 8);
  p.out[192 + l] = int32_t(__ballot_sync(kAllLanes, value & 1));
  p.out[224 + l] = __any_sync(kAllLanes, value == 7);
  p.out[256 + l] = __all_sync(kAllLanes, value < 1000);
  p.out[288 + l] = int32_t(__match_any_sync(kAllLanes, value % 3));
}

SNOW_KERNEL(wide_values, 32, FaultParams<double>) {
  p.out[lane_id()] = __shfl_xor_sync(kAllLanes, p.given[lane_id()], int(p.n));
}

// Only the odd lanes exchange.
SNOW_KERNEL(partial_masks, 32, FaultParams<int32_t>) {
  const int l = lane_id();
  const unsigned odd = 0xaaaaaaaau;
  if (l % 2 == 0) return;
  p.out[l] = __shfl_sync(odd, p.given[l], int(p.n));
  p.out[32 + l] = int32_t(__ballot_sync(odd, p.given[l] > 10));
  p.out[64 + l] = int32_t(__match_any_sync(odd, p.given[l] % 2));
  p.out[96 + l] = __all_sync(odd, p.given[l] % 2);
}

// Warps exchange at their own pace, in loops of different length.
SNOW_KERNEL(warps_apart, 96, FaultParams<int32_t>) {
  int sum = 0;
  for (int i = 0; i <= warp_id() * p.n; i++) sum += __shfl_sync(kAllLanes, lane_id() + i, i);
  __syncthreads();
  p.out[threadIdx.x] = sum;
}

SNOW_KERNEL(block_votes, 64, FaultParams<int32_t>) {
  const int t = int(threadIdx.x);
  p.out[t] = __syncthreads_count(t < p.n);
  p.out[64 + t] = __syncthreads_or(t == p.n);
  p.out[128 + t] = __syncthreads_and(t < p.n);
}

SNOW_KERNEL(atomics, 64, FaultParams<int32_t>) {
  const int i = int(thread_index());
  if (i >= p.n) return;
  atomicAdd(&p.out[0], 1);
  atomicMax(&p.out[1], i);
  atomicMin(&p.out[2], i);
  atomicOr(&p.out[3], 1 << (i % 8));
  if (atomicCAS(&p.out[4], 0, 1) == 0) p.out[5] = atomicExch(&p.out[6], 9);
  atomicAdd(p.total, 0.5f);
}

SNOW_KERNEL(double_all, 64, FaultParams<int32_t>) {
  if (thread_index() < p.n) p.out[thread_index()] *= 2;
}
