// The instruction set for which this library was built, and the best one that this machine
// supports.
//
// The loader (util/native_library.py) calls best_isa() of the baseline library, which runs on every
// machine. It must do so before it loads another library, because loading a library runs its static
// constructors.
#include "cpu/isa.h"

#if defined(__x86_64__)
#include <cpuid.h>
#endif

#include "cpu/entry.h"

namespace {

// In the order of ISAS in util/native_library.py.
enum Isa : int64_t { kBaseline = 0, kAvx2 = 1, kAvx512 = 2 };

#if defined(__x86_64__)
// The registers that the instruction cpuid sets for a leaf and its subleaf 0; all 0 if the
// processor does not have the leaf. __builtin_cpu_supports is not used: it needs a part of the
// runtime of the compiler that is not available everywhere (Clang on Windows), and older compilers
// do not know all names.
struct Leaf {
  unsigned a = 0, b = 0, c = 0, d = 0;
  explicit Leaf(unsigned number) { __get_cpuid_count(number, 0, &a, &b, &c, &d); }
};
constexpr bool has(unsigned bits, unsigned needed) { return (bits & needed) == needed; }
constexpr unsigned bit(int number) { return 1u << number; }

// Whether the system saves these registers at a context switch (the bits of XCR0).
bool system_saves(unsigned registers) {
  if (!has(Leaf(1).c, bit(27))) return false;  // OSXSAVE: the instruction xgetbv exists
  unsigned low, high;
  asm volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  return has(low, registers);
}

constexpr unsigned kYmm = 0x06, kZmm = 0xe6;  // XMM and YMM; also the masks and ZMM
#endif

}  // namespace

namespace snow {

bool has_avx512_vnni() {
#if defined(__x86_64__)
  return system_saves(kZmm) && has(Leaf(7).c, bit(11));
#else
  return false;
#endif
}

}  // namespace snow

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

// The best instruction set that the processor and the operating system support.
SNOW_EXPORT int64_t best_isa() {
#if defined(__x86_64__)
  const unsigned features = Leaf(1).c, extended = Leaf(7).b, more = Leaf(0x80000001u).c;
  // A processor without LZCNT executes this instruction as bsr: the results are wrong, and there is
  // no fault.
  const bool avx2 = system_saves(kYmm) &&
                    has(features, bit(12) | bit(23) | bit(28)) &&  // FMA, POPCNT, AVX
                    has(extended, bit(3) | bit(5) | bit(8)) &&     // BMI1, AVX2, BMI2
                    has(more, bit(5));                             // LZCNT
  const bool avx512 =
      avx2 && system_saves(kZmm) &&
      has(extended, bit(16) | bit(17) | bit(28) | bit(30) | bit(31));  // F, DQ, CD, BW, VL
  if (avx512) return kAvx512;
  if (avx2) return kAvx2;
#endif
  return kBaseline;
}
