// Implements CUDA's intrinsics for the C++ compiler, so that .cu files run on a CPU, one block at a
// time, with a fibre for each thread (see block.cpp). For checking kernels; it is slow:
//
// - Threads of a block run one at a time, each until a barrier, a shuffle or a vote; SNOWSPLAT_ORDER
//   (forward, backward or a seed of shuffles) sets the order, so that missing barriers have effects.
// - A barrier that only some threads reach, a lane of a mask that never arrives, and threads that wait
//   at different places are errors with their names and lines.
// - A shared array is a separate allocation, filled with NaN when a block begins and not accessible
//   after it, so that AddressSanitizer detects accesses out of bounds, and tests detect reads of
//   unwritten memory.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#include <utility>

#define __device__
#define __host__
#define __forceinline__ inline __attribute__((always_inline))
#define __restrict__ __restrict

struct EmulatedIndex {
  unsigned x, y, z;
};

namespace emulation {

constexpr int kWarpSize = 32;

extern EmulatedIndex thread_index, block_index, block_size, grid_size;
extern int64_t running_block;  // its number among those of all kernels, from 1 on

// A line of a kernel at which threads wait for each other.
struct Place {
  const char* file;
  int line;
  bool operator==(const Place& o) const {
    return line == o.line && (file == o.file || !std::strcmp(file, o.file));
  }
};
inline Place here(const char* file = __builtin_FILE(), int line = __builtin_LINE()) {
  return {file, line};
}

// An array that the threads of a block share.
struct SharedArray {
  void* memory;
  int64_t bytes, block;  // `block`: the last that has used it
};
// Called by the first thread that uses the array in a block.
void* begin_shared(SharedArray&, int64_t bytes);
// Waits until all running threads of the block have arrived.
void block_barrier(Place);
// The same; returns the sum of the values.
int block_sum(int value, Place);
struct Exchange {
  uint64_t values[kWarpSize];  // of each lane, ≤ 8 bytes
  unsigned votes;              // the lanes with a value other than 0
};
// Waits until all lanes of `mask` have arrived.
const Exchange& warp_exchange(unsigned mask, uint64_t value, Place);
// The lanes of `mask` with this value.
unsigned lanes_with(const Exchange&, unsigned mask, uint64_t value);

template <class T, int64_t kCount, class Site>
T* shared_array(Site) {
  static_assert(std::is_trivially_destructible<T>::value, "it is never destroyed");
  static SharedArray array;
  const bool begun = array.block == running_block;
  return static_cast<T*>(begun ? array.memory : begin_shared(array, int64_t(sizeof(T)) * kCount));
}

template <class T>
uint64_t to_bits(T value) {
  static_assert(sizeof(T) <= 8 && std::is_trivially_copyable<T>::value, "a lane's value");
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  return bits;
}
template <class T>
T from_bits(uint64_t bits) {
  T value;
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

inline int lane() { return int(thread_index.x % kWarpSize); }

// Whether this library has a kernel: one has those of float64, another has the others. The compiler
// skips functions that nothing calls, which takes most of its time.
template <size_t kLength>
constexpr bool is_built(const char (&name)[kLength]) {
  const char suffix[] = "_f64";
  bool is_float64 = kLength > sizeof(suffix);
  for (size_t i = 0; is_float64 && i < sizeof(suffix); i++)
    is_float64 = name[kLength - sizeof(suffix) + i] == suffix[i];
  return is_float64 == bool(SNOWSPLAT_EMULATE_FLOAT64);
}

}  // namespace emulation

#define threadIdx (emulation::thread_index)
#define blockIdx (emulation::block_index)
#define blockDim (emulation::block_size)
#define gridDim (emulation::grid_size)

#define SNOW_EMULATION_EXPORT extern "C" __attribute__((visibility("default")))
// A kernel is called with pointers to its parameters, as by the driver of a GPU; there is one.
#define SNOW_KERNEL(NAME, THREADS, ...)                            \
  static void NAME(const __VA_ARGS__& p);                          \
  SNOW_EMULATION_EXPORT void NAME##_call(void** parameters) {      \
    if constexpr (emulation::is_built(#NAME))                      \
      NAME(*static_cast<const __VA_ARGS__*>(parameters[0]));       \
    else                                                           \
      __builtin_trap();                                            \
  }                                                                \
  SNOW_EMULATION_EXPORT int NAME##_threads() { return THREADS; }   \
  SNOW_EMULATION_EXPORT const char* NAME##_fields() {              \
    static constexpr auto layout = snow::layout_of<__VA_ARGS__>(); \
    return layout.characters;                                      \
  }                                                                \
  static void NAME([[maybe_unused]] const __VA_ARGS__& p)
#define SNOW_KERNEL_OF(NAME, THREADS, BLOCKS, ...) SNOW_KERNEL(NAME, THREADS, __VA_ARGS__)
#define SNOW_SHARED(TYPE, NAME, COUNT) \
  using NAME##_element = TYPE;         \
  NAME##_element* const NAME = emulation::shared_array<NAME##_element, (COUNT)>([] {})

inline void __syncthreads(emulation::Place at = emulation::here()) { emulation::block_barrier(at); }
inline void __syncwarp(unsigned mask = 0xffffffffu, emulation::Place at = emulation::here()) {
  emulation::warp_exchange(mask, 0, at);
}
inline int __syncthreads_count(int predicate, emulation::Place at = emulation::here()) {
  return emulation::block_sum(predicate != 0, at);
}
inline int __syncthreads_or(int predicate, emulation::Place at = emulation::here()) {
  return emulation::block_sum(predicate != 0, at) != 0;
}
inline int __syncthreads_and(int predicate, emulation::Place at = emulation::here()) {
  return emulation::block_sum(predicate == 0, at) == 0;
}

template <class T>
T __shfl_sync(unsigned mask, T value, int source, int width = 32,
              emulation::Place at = emulation::here()) {
  const int lane = emulation::lane(), first = lane & ~(width - 1);
  const emulation::Exchange& all = emulation::warp_exchange(mask, emulation::to_bits(value), at);
  return emulation::from_bits<T>(all.values[first + (source & (width - 1))]);
}
template <class T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta, int width = 32,
                 emulation::Place at = emulation::here()) {
  const int lane = emulation::lane(), first = lane & ~(width - 1), from = lane - int(delta);
  const emulation::Exchange& all = emulation::warp_exchange(mask, emulation::to_bits(value), at);
  return from < first ? value : emulation::from_bits<T>(all.values[from]);
}
template <class T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = 32,
                   emulation::Place at = emulation::here()) {
  const int lane = emulation::lane(), last = lane | (width - 1), from = lane + int(delta);
  const emulation::Exchange& all = emulation::warp_exchange(mask, emulation::to_bits(value), at);
  return from > last ? value : emulation::from_bits<T>(all.values[from]);
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int bits, int width = 32,
                  emulation::Place at = emulation::here()) {
  const int lane = emulation::lane(), last = lane | (width - 1), from = lane ^ bits;
  const emulation::Exchange& all = emulation::warp_exchange(mask, emulation::to_bits(value), at);
  return from > last ? value : emulation::from_bits<T>(all.values[from]);
}
inline unsigned __ballot_sync(unsigned mask, int predicate,
                              emulation::Place at = emulation::here()) {
  return emulation::warp_exchange(mask, predicate != 0, at).votes;
}
inline int __any_sync(unsigned mask, int predicate, emulation::Place at = emulation::here()) {
  return emulation::warp_exchange(mask, predicate != 0, at).votes != 0;
}
inline int __all_sync(unsigned mask, int predicate, emulation::Place at = emulation::here()) {
  return emulation::warp_exchange(mask, predicate == 0, at).votes == 0;
}
template <class T>
unsigned __match_any_sync(unsigned mask, T value, emulation::Place at = emulation::here()) {
  const uint64_t own = emulation::to_bits(value);
  return emulation::lanes_with(emulation::warp_exchange(mask, own, at), mask, own);
}

inline void __threadfence() {}
inline void __threadfence_block() {}
inline void __nanosleep(unsigned) {}

// Nothing runs concurrently, so a plain update is atomic.
template <class T>
T atomicAdd(T* at, std::common_type_t<T> value) {
  const T before = *at;
  *at = before + value;
  return before;
}
template <class T>
T atomicMax(T* at, std::common_type_t<T> value) {
  const T before = *at;
  if (value > before) *at = value;
  return before;
}
template <class T>
T atomicMin(T* at, std::common_type_t<T> value) {
  const T before = *at;
  if (value < before) *at = value;
  return before;
}
template <class T>
T atomicOr(T* at, std::common_type_t<T> value) {
  const T before = *at;
  *at = before | value;
  return before;
}
template <class T>
T atomicExch(T* at, std::common_type_t<T> value) {
  const T before = *at;
  *at = value;
  return before;
}
template <class T>
T atomicCAS(T* at, std::common_type_t<T> expected, std::common_type_t<T> value) {
  const T before = *at;
  if (before == expected) *at = value;
  return before;
}

template <class T>
T __ldg(const T* at) {
  return *at;
}
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __popcll(unsigned long long x) { return __builtin_popcountll(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __ffsll(long long x) { return __builtin_ffsll(x); }
inline int __clz(int x) { return x ? __builtin_clz(unsigned(x)) : 32; }
inline unsigned __float_as_uint(float x) {
  return emulation::from_bits<unsigned>(emulation::to_bits(x));
}
inline float __uint_as_float(unsigned x) { return emulation::from_bits<float>(x); }
inline int __float_as_int(float x) { return int(__float_as_uint(x)); }
inline float __int_as_float(int x) { return __uint_as_float(unsigned(x)); }
inline long long __double_as_longlong(double x) {
  return emulation::from_bits<long long>(emulation::to_bits(x));
}
inline double __longlong_as_double(long long x) {
  return emulation::from_bits<double>(uint64_t(x));
}
inline float __fdividef(float a, float b) { return a / b; }
inline float __frcp_rn(float a) { return 1.f / a; }
inline float rsqrtf(float a) { return 1.f / sqrtf(a); }

struct alignas(8) float2 {
  float x, y;
};
struct alignas(16) float4 {
  float x, y, z, w;
};
struct alignas(8) uint2 {
  unsigned x, y;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
struct alignas(16) double2 {
  double x, y;
};
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline double2 make_double2(double x, double y) { return {x, y}; }
