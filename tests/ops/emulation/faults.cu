// Kernels for testing the emulation itself: faults that it must find, and values that are known.
#include "cuda/device.h"

using namespace snow;

// Threads below n wait at another place than the rest.
SNOW_KERNEL(two_barriers, 64, (int64_t n, int32_t* out)) {
  if (threadIdx.x < n) {
    __syncthreads();
  } else {
    __syncthreads();
  }
  out[threadIdx.x] = 1;
}

// Threads below n wait for the block, the rest for their warps.
SNOW_KERNEL(barrier_or_vote, 64, (int64_t n, int32_t* out)) {
  if (threadIdx.x < n) {
    __syncthreads();
  } else {
    __syncwarp();
    __syncthreads();
  }
  out[threadIdx.x] = 1;
}

// Lane n of each warp has left when the others wait for it.
SNOW_KERNEL(absent_lane, 64, (int64_t n, int32_t* out)) {
  if (lane_id() == n) return;
  out[threadIdx.x] = __shfl_sync(kAllLanes, int(threadIdx.x), 0);
}

// As many lanes as a warp has, in a block that ends in the middle of one.
SNOW_KERNEL(short_warp, 48, (int64_t n, int32_t* out)) {
  if (threadIdx.x < n) out[threadIdx.x] = __any_sync(kAllLanes, 1);
}

// The lanes of a warp wait with different masks.
SNOW_KERNEL(two_masks, 32, (int64_t n, int32_t* out)) {
  out[threadIdx.x] = __shfl_sync(lane_id() < n ? 0xffffu : kAllLanes, 1, 0);
}

// Lane n waits with a mask that it is not in.
SNOW_KERNEL(not_in_its_mask, 32, (int64_t n, int32_t* out)) {
  out[threadIdx.x] = __ballot_sync(~(1u << n), 1) != 0;
}

// Right only if a thread runs after the one before it.
SNOW_KERNEL(missing_barrier, 64, (int64_t n, const int32_t* in, int32_t* out)) {
  SNOW_SHARED(int32_t, row, 64);
  const int t = int(threadIdx.x);
  row[t] = in[t];
  out[t] = row[t < n ? t : t - int(n)];
}

// The same within a warp, without __syncwarp.
SNOW_KERNEL(missing_warp_barrier, 32, (int64_t n, const int32_t* in, int32_t* out)) {
  SNOW_SHARED(int32_t, row, 32);
  row[lane_id()] = in[lane_id()];
  if (n) __syncwarp();
  out[lane_id()] = row[31 - lane_id()];
}

SNOW_KERNEL(never_written, 32, (int64_t n, float* out)) {
  SNOW_SHARED(float, row, 32);
  if (threadIdx.x < n) row[threadIdx.x] = 1.f;
  __syncthreads();
  out[threadIdx.x] = row[threadIdx.x];
  __syncthreads();
  row[threadIdx.x] = 2.f;  // must not be there in the next block
}

SNOW_KERNEL(beyond_shared, 32, (int64_t n, int32_t* out)) {
  SNOW_SHARED(int32_t, row, 32);
  row[threadIdx.x] = 1;
  __syncthreads();
  out[threadIdx.x] = row[threadIdx.x + n];
}

SNOW_KERNEL(beyond_the_tensor, 32, (int64_t n, int32_t* out)) { out[threadIdx.x + n] = 1; }

SNOW_KERNEL(shifted_too_far, 32, (int64_t n, int32_t* out)) {
  out[threadIdx.x] = int32_t(threadIdx.x) << n;
}

// Allowed: threads that have ended do not count. Sums the n first elements.
SNOW_KERNEL(early_return, 64, (int64_t n, const int32_t* in, int32_t* out)) {
  SNOW_SHARED(int32_t, row, 64);
  const int t = int(threadIdx.x);
  if (t >= n) return;
  row[t] = in[t];
  __syncthreads();
  if (t > 0) return;
  int sum = 0;
  for (int i = 0; i < n; i++) sum += row[i];
  out[0] = sum;
}

// Each row of 32 of `out` is another exchange of `in`, whose lanes are all here.
SNOW_KERNEL(exchanges, 32, (int64_t n, const int32_t* in, int32_t* out)) {
  const int l = lane_id(), value = in[l];
  out[l] = __shfl_sync(kAllLanes, value, int(n));
  out[32 + l] = __shfl_up_sync(kAllLanes, value, unsigned(n));
  out[64 + l] = __shfl_down_sync(kAllLanes, value, unsigned(n));
  out[96 + l] = __shfl_xor_sync(kAllLanes, value, int(n));
  out[128 + l] = __shfl_sync(kAllLanes, value, l + 1, 8);
  out[160 + l] = __shfl_down_sync(kAllLanes, value, unsigned(n), 8);
  out[192 + l] = int32_t(__ballot_sync(kAllLanes, value & 1));
  out[224 + l] = __any_sync(kAllLanes, value == 7);
  out[256 + l] = __all_sync(kAllLanes, value < 1000);
  out[288 + l] = int32_t(__match_any_sync(kAllLanes, value % 3));
}

SNOW_KERNEL(wide_values, 32, (int64_t n, const double* in, double* out)) {
  out[lane_id()] = __shfl_xor_sync(kAllLanes, in[lane_id()], int(n));
}

// Only the odd lanes exchange.
SNOW_KERNEL(partial_masks, 32, (int64_t n, const int32_t* in, int32_t* out)) {
  const int l = lane_id();
  const unsigned odd = 0xaaaaaaaau;
  if (l % 2 == 0) return;
  out[l] = __shfl_sync(odd, in[l], int(n));
  out[32 + l] = int32_t(__ballot_sync(odd, in[l] > 10));
  out[64 + l] = int32_t(__match_any_sync(odd, in[l] % 2));
  out[96 + l] = __all_sync(odd, in[l] % 2);
}

// Warps exchange at their own pace, in loops of different length.
SNOW_KERNEL(warps_apart, 96, (int64_t n, int32_t* out)) {
  int sum = 0;
  for (int i = 0; i <= warp_id() * n; i++) sum += __shfl_sync(kAllLanes, lane_id() + i, i);
  __syncthreads();
  out[threadIdx.x] = sum;
}

SNOW_KERNEL(block_votes, 64, (int64_t n, int32_t* out)) {
  const int t = int(threadIdx.x);
  out[t] = __syncthreads_count(t < n);
  out[64 + t] = __syncthreads_or(t == n);
  out[128 + t] = __syncthreads_and(t < n);
}

SNOW_KERNEL(atomics, 64, (int64_t n, int32_t* out, float* sum)) {
  const int i = int(thread_index());
  if (i >= n) return;
  atomicAdd(&out[0], 1);
  atomicMax(&out[1], i);
  atomicMin(&out[2], i);
  atomicOr(&out[3], 1 << (i % 8));
  if (atomicCAS(&out[4], 0, 1) == 0) out[5] = atomicExch(&out[6], 9);
  atomicAdd(sum, 0.5f);
}

SNOW_KERNEL(double_all, 64, (int64_t n, int32_t* values)) {
  if (thread_index() < n) values[thread_index()] *= 2;
}
