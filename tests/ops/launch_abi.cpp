// Called by test_native.py through launch(): writes down what arrived. More arguments than there
// are registers, so that the ones on the stack are seen too.
#include <cstdint>

#define EXPORT extern "C" __attribute__((visibility("default")))

EXPORT int64_t record(int64_t n, double* out, const float* nothing, int64_t i0, double d0,
                      int64_t i1, double d1, int64_t i2, double d2, int64_t i3, double d3,
                      int64_t i4, double d4, int64_t i5, double d5, int64_t i6, double d6,
                      int64_t i7, double d7, int64_t i8, double d8, int64_t i9, double d9,
                      const int32_t* last) {
  const double all[] = {double(i0), d0, double(i1), d1, double(i2),   d2, double(i3), d3,
                        double(i4), d4, double(i5), d5, double(i6),   d6, double(i7), d7,
                        double(i8), d8, double(i9), d9, double(*last)};
  for (int64_t i = 0; i < n; i++) out[i] = all[i];
  return nothing ? 0 : (int64_t(1) << 40) + n;
}

EXPORT int64_t set_num_threads(int64_t) { return 0; }
