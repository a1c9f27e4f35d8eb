// The first header of every .cu file. Two compilers read these files. NVRTC compiles them for GPUs;
// it has no headers of the C library. In tests, the C++ compiler compiles them for an emulation on
// the CPU (tests/ops/emulation).
//
//   SNOW_KERNEL(name, threads, Params) { … }             a kernel with `threads` per block
//   SNOW_KERNEL_OF(name, threads, blocks, Params) { … }  the same; the registers are limited, so
//                                                        that `blocks` fit on a multiprocessor
//   SNOW_SHARED(type, name, count);                      an array in shared memory
//
// A kernel has one parameter, `p`: a struct from params.h, or from the same file if only the GPU
// needs it. For each kernel `name` there is a variable `name_fields`: the layout of its struct
// (layout.h), which the loader reads. Blocks and threads are one-dimensional; ops/cuda determines the
// number of blocks. Kernels use only intrinsics and these
// headers, so that NVRTC compiles them quickly and the emulation can implement all intrinsics.
#pragma once

#if defined(SNOWSPLAT_EMULATION)
#include "cuda_emulation.h"
#else

#define SNOW_KERNEL_WITH(NAME, BOUNDS, ...)                                  \
  extern "C" __device__ auto NAME##_fields = snow::layout_of<__VA_ARGS__>(); \
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
// The index of this thread among the threads of all blocks.
SNOW_INLINE int64_t thread_index() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }
template <class T>
SNOW_INLINE T infinity() {
  return T(__int_as_float(0x7f800000));
}

}  // namespace snow
