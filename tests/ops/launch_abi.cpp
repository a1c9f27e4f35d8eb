// Called by test_native.py through launch(): records its parameters.
#include "cpu/entry.h"

struct Nested {
  double a;
  int64_t b;
  SNOW_FIELDS(a, b)
};

struct RecordParams {
  int64_t n;
  double* out;
  const float* nothing;
  Nested first, second;
  int64_t whole;
  const int32_t* last;
  SNOW_FIELDS(n, out, nothing, first, second, whole, last)
};

template <class Params>
int64_t record_all(const Params& p) {
  const double all[] = {p.first.a,          double(p.first.b), p.second.a,
                        double(p.second.b), double(p.whole),   double(*p.last)};
  for (int64_t i = 0; i < p.n; i++) p.out[i] = all[i];
  return p.nothing ? 0 : (int64_t(1) << 40) + p.n;
}

SNOW_ENTRY(record, RecordParams) { return record_all(p); }

// As many fields as SNOW_FIELDS takes.
struct ManyParams {
  int64_t n, f1, f2, f3, f4, f5, f6, f7, f8, f9, f10, f11, f12, f13, f14, f15, f16, f17, f18, f19,
      f20, f21, f22, f23, f24, f25, f26, f27, f28, f29, f30, f31, f32, f33, f34, f35, f36, f37, f38,
      f39;
  SNOW_FIELDS(n, f1, f2, f3, f4, f5, f6, f7, f8, f9, f10, f11, f12, f13, f14, f15, f16, f17, f18,
              f19, f20, f21, f22, f23, f24, f25, f26, f27, f28, f29, f30, f31, f32, f33, f34, f35,
              f36, f37, f38, f39)
};

SNOW_ENTRY(record_many, ManyParams) { return p.f20 + p.f39; }

// The same fields in another order.
struct SwappedParams {
  int64_t n;
  const float* nothing;
  double* out;
  Nested first, second;
  int64_t whole;
  const int32_t* last;
  SNOW_FIELDS(n, nothing, out, first, second, whole, last)
};

SNOW_ENTRY(record_swapped, SwappedParams) { return record_all(p); }

SNOW_EXPORT int64_t set_num_threads(int64_t) { return 0; }
