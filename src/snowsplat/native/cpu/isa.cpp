// The instruction set that this library was built for, and the best one that this machine supports.
//
// The loader (ops/native.py) calls the baseline library, which runs everywhere, before it loads
// another one, because loading a library already runs its static constructors.
#include <cstdint>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "cpu/entry.h"

namespace {

// The order is that of ISAS in ops/native.py.
enum Isa : int64_t { kBaseline = 0, kAvx2 = 1, kAvx512 = 2 };

#if defined(__x86_64__)
// On processors without lzcnt, the instruction is executed as bsr: wrong results instead of a fault.
// __builtin_cpu_supports of older compilers does not support its name.
bool has_lzcnt() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  return __get_cpuid(0x80000001u, &a, &b, &c, &d) && (c & (1u << 5));
}
#endif

}  // namespace

// The instruction set that this library was built for.
SNOW_EXPORT int64_t built_isa() {
#if defined(SNOWSPLAT_ISA_AVX512)
  return kAvx512;
#elif defined(SNOWSPLAT_ISA_AVX2)
  return kAvx2;
#else
  return kBaseline;
#endif
}

// The best instruction set of the processor whose registers the operating system saves on a task
// switch (__builtin_cpu_supports checks XCR0 for the wide registers).
SNOW_EXPORT int64_t best_isa() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                    __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") &&
                    __builtin_cpu_supports("popcnt") && has_lzcnt();
  const bool avx512 = avx2 && __builtin_cpu_supports("avx512f") &&
                      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
                      __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512cd");
  if (avx512) return kAvx512;
  if (avx2) return kAvx2;
#endif
  return kBaseline;
}
