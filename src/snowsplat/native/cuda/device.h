// The first header of every .cu file. Two compilers read these files: NVRTC, which has no headers of
// the C library, and, for tests, the C++ compiler, which runs the kernels on a CPU
// (tests/ops/emulation).
//
//   SNOW_KERNEL(name, threads, Params) { … }             a kernel, and the threads of its blocks
//   SNOW_KERNEL_OF(name, threads, blocks, Params) { … }  the same, with registers limited so that at
//                                                        least `blocks` fit on a multiprocessor
//   SNOW_SHARED(type, name, count);                      an array in shared memory
//
// A kernel has one parameter, `p`: a struct (params.h, or in the same file where only the GPU has it).
// Beside the kernel `name` there is a variable `name_layout`, the layout of its struct (layout.h),
// which the loader compares with that of Python. Blocks and threads are one-dimensional; ops/cuda
// determines the number of blocks. Kernels use raw intrinsics and these headers only: NVRTC
// then compiles them quickly, and the emulation implements every intrinsic that they use.
#pragma once

#if defined(SNOWSPLAT_EMULATION)
#include "cuda_emulation.h"
#else

#define SNOW_KERNEL_WITH(NAME, BOUNDS, ...)                                      \
  extern "C" __device__ uint64_t NAME##_layout = snow::layout_of<__VA_ARGS__>(); \
  extern "C" __global__ void __launch_bounds__ BOUNDS NAME(const __VA_ARGS__ p)
#define SNOW_KERNEL(NAME, THREADS, ...) SNOW_KERNEL_WITH(NAME, (THREADS), __VA_ARGS__)
#define SNOW_KERNEL_OF(NAME, THREADS, BLOCKS, ...) \
  SNOW_KERNEL_WITH(NAME, (THREADS, BLOCKS), __VA_ARGS__)
#define SNOW_SHARED(TYPE, NAME, COUNT) \
  using NAME##_element = TYPE;         \
  __shared__ NAME##_element NAME[COUNT]

#endif

#include "params.h"

namespace snow {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

SNOW_INLINE int lane_id() { return int(threadIdx.x % kWarp); }
SNOW_INLINE int warp_id() { return int(threadIdx.x / kWarp); }
SNOW_INLINE uint32_t lanes_below() { return (1u << lane_id()) - 1; }
// The index of this thread among those of all blocks.
SNOW_INLINE int64_t thread_index() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }

}  // namespace snow
