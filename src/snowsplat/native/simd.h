// Simd<T, W>: W lanes of T with the operations that the kernels need.
//
// The primary template uses the vector extensions of the compiler and works on every target: SSE2
// and NEON with W = 4, and double. simd_avx2.h and simd_avx512.h contain specialisations with the
// same members. They use intrinsics only where the compiler generates slow code. Arithmetic is
// written with operators, so that the compiler can fuse multiplications and additions.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#include "portable.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace snow {

namespace detail {
// The vector types of the compiler. Each is written out, because GCC ignores the attribute in a
// typedef that depends on a template parameter.
template <class T, int W>
struct VectorTypes;
template <>
struct VectorTypes<float, 4> {
  typedef float Vec __attribute__((vector_size(16)));
  typedef float Unaligned __attribute__((vector_size(16), aligned(4), may_alias));
  typedef int32_t IVec __attribute__((vector_size(16)));
  using Int = int32_t;
};
template <>
struct VectorTypes<double, 4> {
  typedef double Vec __attribute__((vector_size(32)));
  typedef double Unaligned __attribute__((vector_size(32), aligned(8), may_alias));
  typedef int64_t IVec __attribute__((vector_size(32)));
  using Int = int64_t;
};
}  // namespace detail

template <class S>
using IfNumber = std::enable_if_t<std::is_arithmetic<S>::value, int>;

template <class T, int W>
struct Simd {
  using Scalar = T;
  using Types = detail::VectorTypes<T, W>;
  using Int = typename Types::Int;
  using Vec = typename Types::Vec;
  using IVec = typename Types::IVec;
  using VecUnaligned = typename Types::Unaligned;
  static constexpr int width = W;

  struct Mask {
    IVec m;
    SNOW_INLINE friend Mask operator&(Mask a, Mask b) { return {a.m & b.m}; }
    SNOW_INLINE friend Mask operator|(Mask a, Mask b) { return {a.m | b.m}; }
  };

  Vec v;

  Simd() = default;
  SNOW_INLINE Simd(Vec x) : v(x) {}
  template <class S, IfNumber<S> = 0>
  SNOW_INLINE Simd(S s) : v(T(s) - Vec{}) {}

  SNOW_INLINE friend Simd operator+(Simd a, Simd b) { return a.v + b.v; }
  SNOW_INLINE friend Simd operator-(Simd a, Simd b) { return a.v - b.v; }
  SNOW_INLINE friend Simd operator*(Simd a, Simd b) { return a.v * b.v; }
  SNOW_INLINE friend Simd operator/(Simd a, Simd b) { return a.v / b.v; }
  SNOW_INLINE friend Simd operator-(Simd a) { return -a.v; }
  SNOW_INLINE Simd& operator+=(Simd b) { return v += b.v, *this; }
  SNOW_INLINE Simd& operator-=(Simd b) { return v -= b.v, *this; }
  SNOW_INLINE Simd& operator*=(Simd b) { return v *= b.v, *this; }
  SNOW_INLINE friend Mask operator>=(Simd a, Simd b) { return {a.v >= b.v}; }
  SNOW_INLINE friend Mask operator>(Simd a, Simd b) { return {a.v > b.v}; }
  SNOW_INLINE friend Mask operator<(Simd a, Simd b) { return {a.v < b.v}; }

  SNOW_INLINE static Simd load(const T* p) { return Simd(Vec(*(const VecUnaligned*)p)); }
  SNOW_INLINE void store(T* p) const { *(VecUnaligned*)p = v; }
  // Loads the first n lanes; the others are 0, and their memory is not accessed.
  SNOW_INLINE static Simd load_first(const T* p, int n) {
    Simd r(T(0));
    for (int l = 0; l < W && l < n; l++) r.v[l] = p[l];
    return r;
  }
  SNOW_INLINE void store_first(T* p, int n) const {
    for (int l = 0; l < W && l < n; l++) p[l] = v[l];
  }
  SNOW_INLINE static Simd load_bytes(const uint8_t* p) {
    Simd r;
    for (int l = 0; l < W; l++) r.v[l] = T(p[l]);
    return r;
  }
  // The sum of the groups of four lanes.
  SNOW_INLINE Simd<T, 4> sum_of_quads() const {
    static_assert(W == 4);
    return v;
  }
  SNOW_INLINE static Simd iota() {
    Simd r;
    for (int l = 0; l < W; l++) r.v[l] = T(l);
    return r;
  }
  SNOW_INLINE static Mask first(int n) { return Simd(T(n)) > iota(); }
  SNOW_INLINE static uint32_t bits(Mask m) {
#if defined(__SSE2__)
    if constexpr (sizeof(Vec) == 16) return uint32_t(_mm_movemask_ps(__m128(m.m)));
#endif
    uint32_t r = 0;
    for (int l = 0; l < W; l++) r |= uint32_t(m.m[l] & 1) << l;
    return r;
  }
  SNOW_INLINE static Mask from_bits(uint32_t b) {
    Mask r;
    for (int l = 0; l < W; l++) r.m[l] = -Int(b >> l & 1);
    return r;
  }

  SNOW_INLINE friend Simd select(Mask m, Simd a, Simd b) { return Vec(m.m ? a.v : b.v); }
  SNOW_INLINE friend Simd zero_unless(Mask m, Simd a) { return Vec(IVec(a.v) & m.m); }
  SNOW_INLINE friend Simd min(Simd a, Simd b) { return Vec(a.v < b.v ? a.v : b.v); }
  SNOW_INLINE friend Simd max(Simd a, Simd b) { return Vec(a.v > b.v ? a.v : b.v); }
  // a b + c, rounded once where the processor has an instruction for it.
  SNOW_INLINE friend Simd fma(Simd a, Simd b, Simd c) { return a.v * b.v + c.v; }
  SNOW_INLINE friend Simd sqrt(Simd a) {
    for (int l = 0; l < W; l++) a.v[l] = T(__builtin_sqrt(double(a.v[l])));
    return a;
  }
  SNOW_INLINE friend Simd reciprocal(Simd a) { return Simd(T(1)) / a; }
  SNOW_INLINE friend Simd reciprocal_estimate(Simd a) { return Simd(T(1)) / a; }
  SNOW_INLINE friend Simd rsqrt(Simd a) { return Simd(T(1)) / sqrt(a); }

  // Splits x into floor(x) and f, for exp2(x) = 2^floor(x) · poly(f) (simd_math.h).
  SNOW_INLINE static void split(Simd x, Simd& f, IVec& whole) {
    IVec i = __builtin_convertvector(x.v, IVec);
    i += (__builtin_convertvector(i, Vec) > x.v);  // truncation towards 0 → floor (true is -1)
    whole = i;
    f = Simd(x.v - __builtin_convertvector(i, Vec));
  }
  SNOW_INLINE static Simd scale_by_pow2(Simd a, IVec whole) {
    constexpr int mantissa = sizeof(T) == 4 ? 23 : 52;
    return Vec(IVec(a.v) + (whole << mantissa));
  }
  SNOW_INLINE static void split_log2(Simd x, Simd& mantissa_part, Simd& exponent) {
    constexpr int bits = sizeof(T) == 4 ? 23 : 52;
    const Int half_sqrt = sizeof(T) == 4 ? Int(0x3f3504f3) : Int(0x3fe6a09e667f3bcdll);
    IVec i = IVec(x.v);
    IVec e = (i - half_sqrt) >> bits;
    mantissa_part = Vec(i - (e << bits));
    exponent = Simd(__builtin_convertvector(e, Vec));
  }
};

// ---- rows ⇄ lanes -------------------------------------------------------------------------------
// Parameters are stored with one Gaussian per row, (N, K); the kernels need one Gaussian per SIMD
// lane. These functions convert W rows of K columns, four columns at a time, by 4×4 transpositions
// in 128-bit parts of the vectors.

#if defined(__SSE2__)
SNOW_INLINE __m128 load_quad(const float* p, int n) {
  switch (n) {
    case 1: return _mm_load_ss(p);
    case 2: return _mm_castpd_ps(_mm_load_sd((const double*)p));
    case 3: return _mm_movelh_ps(_mm_castpd_ps(_mm_load_sd((const double*)p)), _mm_load_ss(p + 2));
    default: return _mm_loadu_ps(p);
  }
}
SNOW_INLINE void store_quad(float* p, __m128 q, int n) {
  switch (n) {
    case 1: _mm_store_ss(p, q); break;
    case 2: _mm_store_sd((double*)p, _mm_castps_pd(q)); break;
    case 3:
      _mm_store_sd((double*)p, _mm_castps_pd(q));
      _mm_store_ss(p + 2, _mm_movehl_ps(q, q));
      break;
    default: _mm_storeu_ps(p, q);
  }
}
#endif

template <class V>
struct RowMover {
  using T = typename V::Scalar;
  // Loads n ≤ 4 columns of each row l, from rows[l] + column on, into lane l of out[0..n).
  SNOW_INLINE static void gather4(const T* const* rows, int column, int n, V* out) {
    for (int k = 0; k < n; k++)
      for (int l = 0; l < V::width; l++) out[k].v[l] = rows[l][column + k];
  }
  SNOW_INLINE static void scatter4(T* const* rows, int column, int n, const V* in, int count) {
    for (int l = 0; l < count; l++)
      for (int k = 0; k < n; k++) rows[l][column + k] = in[k].v[l];
  }
};

// ---- sums over lanes ----------------------------------------------------------------------------
// out[k] = sum of the lanes of in[k], k < K <= 16; out has 16 elements.
template <int K, class V>
SNOW_INLINE void sum_lanes(const V* in, typename V::Scalar* out) {
  for (int k = 0; k < K; k++) {
    typename V::Scalar s = 0;
    for (int l = 0; l < V::width; l++) s += in[k].v[l];
    out[k] = s;
  }
}

}  // namespace snow

#if defined(__AVX2__) && defined(__FMA__)
#include "simd_avx2.h"
#endif
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#include "simd_avx512.h"
#endif

namespace snow {

// The native vector of this build, and the vector of the checks in double precision.
#if defined(__AVX512F__) && defined(__AVX512DQ__)
using VecF = Simd<float, 16>;
#elif defined(__AVX2__) && defined(__FMA__)
using VecF = Simd<float, 8>;
#else
using VecF = Simd<float, 4>;
#endif
using VecD = Simd<double, 4>;

// W rows of `columns` columns ⇄ `columns` vectors. The functions are not inlined: a kernel converts
// about twelve tensors, and the unrolled code would not fit into the instruction cache.
template <class V>
__attribute__((noinline)) void gather_rows(const typename V::Scalar* base, int64_t stride,
                                           const int64_t* row, int columns, V* out) {
  const typename V::Scalar* rows[V::width];
  for (int l = 0; l < V::width; l++) rows[l] = base + row[l] * stride;
  int c = 0;
  for (; c + 4 <= columns; c += 4) RowMover<V>::gather4(rows, c, 4, out + c);
  if (columns - c == 3) RowMover<V>::gather4(rows, c, 3, out + c);
  if (columns - c == 2) RowMover<V>::gather4(rows, c, 2, out + c);
  if (columns - c == 1) RowMover<V>::gather4(rows, c, 1, out + c);
}
template <class V>
__attribute__((noinline)) void scatter_rows(typename V::Scalar* base, int64_t stride,
                                            const int64_t* row, int count, int columns,
                                            const V* in) {
  typename V::Scalar* rows[V::width];
  for (int l = 0; l < V::width; l++) rows[l] = base + row[l] * stride;
  int c = 0;
  for (; c + 4 <= columns; c += 4) RowMover<V>::scatter4(rows, c, 4, in + c, count);
  if (columns - c == 3) RowMover<V>::scatter4(rows, c, 3, in + c, count);
  if (columns - c == 2) RowMover<V>::scatter4(rows, c, 2, in + c, count);
  if (columns - c == 1) RowMover<V>::scatter4(rows, c, 1, in + c, count);
}

SNOW_INLINE void prefetch(const void* p) { __builtin_prefetch(p, 0, 3); }
SNOW_INLINE void prefetch_to_write(void* p) { __builtin_prefetch(p, 1, 3); }

// Denormal numbers make blending 1.7× slower. Every kernel sets the mode that flushes them to zero
// in each of its threads, and restores the caller's mode at its end.
struct FlushDenormals {
#if defined(__x86_64__)
  unsigned saved = _mm_getcsr();
  FlushDenormals() { _mm_setcsr(saved | 0x8040); }
  ~FlushDenormals() { _mm_setcsr(saved); }
#elif defined(__aarch64__)
  uint64_t saved;
  FlushDenormals() {
    asm volatile("mrs %0, fpcr" : "=r"(saved));
    asm volatile("msr fpcr, %0" ::"r"(saved | (1u << 24)));
  }
  ~FlushDenormals() { asm volatile("msr fpcr, %0" ::"r"(saved)); }
#endif
};

}  // namespace snow

#include "simd_math.h"
