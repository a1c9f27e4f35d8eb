// The instruction set for which this library was built, and the best one that this machine
// supports.
//
// The loader (util/native_library.py) calls best_isa() of the baseline library, which runs on every machine.
// It must do so before it loads another library, because loading a library runs its static
// constructors.
#include <cstdint>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "cpu/entry.h"

namespace {

// In the order of ISAS in util/native_library.py.
enum Isa : int64_t { kBaseline = 0, kAvx2 = 1, kAvx512 = 2 };

#if defined(__x86_64__)
// A processor without lzcnt executes this instruction as bsr: the results are wrong, and there is
// no fault. __builtin_cpu_supports of older compilers does not accept the name "lzcnt".
bool has_lzcnt() {
  unsigned a = 0, b = 0, c = 0, d = 0;
  return __get_cpuid(0x80000001u, &a, &b, &c, &d) && (c & (1u << 5));
}
#endif

}  // namespace

// The instruction set for which this library was built.
SNOW_EXPORT int64_t built_isa() {
#if defined(SNOWSPLAT_ISA_AVX512)
  return kAvx512;
#elif defined(SNOWSPLAT_ISA_AVX2)
  return kAvx2;
#else
  return kBaseline;
#endif
}

// The best instruction set that the processor and the operating system support. The system must
// save the wide registers at a context switch; __builtin_cpu_supports checks this in XCR0.
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
