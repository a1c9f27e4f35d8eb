// What a .cu file begins with. Two compilers read it: NVRTC, which has no headers of the C library,
// and, for tests, the C++ compiler, which runs the kernels on a CPU (tests/ops/emulation).
//
//   SNOW_KERNEL(name, threads, (parameters)) { body }    a kernel, of blocks of so many threads
//   SNOW_KERNEL_OF(name, threads, blocks, (parameters))  the same, with registers for so many blocks
//                                                        at least on a multiprocessor
//   SNOW_SHARED(type, name, count);                      an array that a block shares
//
// A kernel has the name, and the parameters in the same order, of the CPU's function; launches.py
// says how many blocks it needs. Blocks and threads count along x alone. Kernels use raw intrinsics
// and these headers only: NVRTC compiles them in moments, and the emulation knows them all.
#pragma once

#if defined(SNOWSPLAT_EMULATION)
#include "cuda_emulation.h"
#else

using int8_t = signed char;
using uint8_t = unsigned char;
using int16_t = short;
using uint16_t = unsigned short;
using int32_t = int;
using uint32_t = unsigned int;
using int64_t = long long;
using uint64_t = unsigned long long;

#define SNOW_KERNEL(NAME, THREADS, PARAMETERS) \
  extern "C" __global__ void __launch_bounds__(THREADS) NAME PARAMETERS
#define SNOW_KERNEL_OF(NAME, THREADS, BLOCKS, PARAMETERS) \
  extern "C" __global__ void __launch_bounds__(THREADS, BLOCKS) NAME PARAMETERS
#define SNOW_SHARED(TYPE, NAME, COUNT) \
  using NAME##_element = TYPE;         \
  __shared__ NAME##_element NAME[COUNT]

#endif

#include "portable.h"

namespace snow {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;

SNOW_INLINE int lane_id() { return int(threadIdx.x % kWarp); }
SNOW_INLINE int warp_id() { return int(threadIdx.x / kWarp); }
// The index of this thread among those of all blocks.
SNOW_INLINE int64_t thread_index() { return int64_t(blockIdx.x) * blockDim.x + threadIdx.x; }

}  // namespace snow
