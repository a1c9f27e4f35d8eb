// Simd<T, W>: W lanes of T with the few operations the kernels need.
//
// The primary template rests on compiler vectors and serves every target (SSE2 and NEON at W = 4,
// and double); AVX2 and AVX-512 have specialisations below it with the same members, written in
// intrinsics only where the compiler's choice is poor. Arithmetic is left to the operators, so that
// the compiler contracts multiply-adds.
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
// The compiler's vector types, spelled out: GCC drops the attribute from a dependent typedef.
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
  // The first n lanes; the others read as 0 and are not touched in memory.
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
  SNOW_INLINE static Simd iota() {
    Simd r;
    for (int l = 0; l < W; l++) r.v[l] = T(l);
    return r;
  }
  SNOW_INLINE static Mask first(int n) { return Simd(T(n)) > iota(); }
  SNOW_INLINE static uint32_t bits(Mask m) {
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
  SNOW_INLINE friend Simd sqrt(Simd a) {
    for (int l = 0; l < W; l++) a.v[l] = T(__builtin_sqrt(double(a.v[l])));
    return a;
  }
  SNOW_INLINE friend Simd reciprocal(Simd a) { return Simd(T(1)) / a; }
  SNOW_INLINE friend Simd reciprocal_estimate(Simd a) { return Simd(T(1)) / a; }
  SNOW_INLINE friend Simd rsqrt(Simd a) { return Simd(T(1)) / sqrt(a); }

  // Splits x = floor(x) + f; exp2 = 2^floor(x) · poly(f) is assembled by the callers below.
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

#if defined(__AVX2__) && defined(__FMA__)
template <>
struct Simd<float, 8> {
  using Scalar = float;
  using Int = int32_t;
  static constexpr int width = 8;
  typedef __m256 Vec;
  typedef __m256i IVec;

  struct Mask {
    __m256 m;
    SNOW_INLINE friend Mask operator&(Mask a, Mask b) { return {_mm256_and_ps(a.m, b.m)}; }
    SNOW_INLINE friend Mask operator|(Mask a, Mask b) { return {_mm256_or_ps(a.m, b.m)}; }
  };

  Vec v;

  Simd() = default;
  SNOW_INLINE Simd(Vec x) : v(x) {}
  template <class S, IfNumber<S> = 0>
  SNOW_INLINE Simd(S s) : v(_mm256_set1_ps(float(s))) {}

  SNOW_INLINE friend Simd operator+(Simd a, Simd b) { return a.v + b.v; }
  SNOW_INLINE friend Simd operator-(Simd a, Simd b) { return a.v - b.v; }
  SNOW_INLINE friend Simd operator*(Simd a, Simd b) { return a.v * b.v; }
  SNOW_INLINE friend Simd operator/(Simd a, Simd b) { return a.v / b.v; }
  SNOW_INLINE friend Simd operator-(Simd a) { return -a.v; }
  SNOW_INLINE Simd& operator+=(Simd b) { return v += b.v, *this; }
  SNOW_INLINE Simd& operator-=(Simd b) { return v -= b.v, *this; }
  SNOW_INLINE Simd& operator*=(Simd b) { return v *= b.v, *this; }
  SNOW_INLINE friend Mask operator>=(Simd a, Simd b) {
    return {_mm256_cmp_ps(a.v, b.v, _CMP_GE_OQ)};
  }
  SNOW_INLINE friend Mask operator>(Simd a, Simd b) {
    return {_mm256_cmp_ps(a.v, b.v, _CMP_GT_OQ)};
  }
  SNOW_INLINE friend Mask operator<(Simd a, Simd b) {
    return {_mm256_cmp_ps(a.v, b.v, _CMP_LT_OQ)};
  }

  SNOW_INLINE static Simd load(const float* p) { return _mm256_loadu_ps(p); }
  SNOW_INLINE void store(float* p) const { _mm256_storeu_ps(p, v); }
  SNOW_INLINE static __m256i first_lanes(int n) {
    return _mm256_cmpgt_epi32(_mm256_set1_epi32(n), _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7));
  }
  SNOW_INLINE static Simd load_first(const float* p, int n) {
    return _mm256_maskload_ps(p, first_lanes(n));
  }
  SNOW_INLINE void store_first(float* p, int n) const { _mm256_maskstore_ps(p, first_lanes(n), v); }
  SNOW_INLINE static Simd load_bytes(const uint8_t* p) {
    return _mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i*)p)));
  }
  SNOW_INLINE static Simd iota() { return _mm256_setr_ps(0, 1, 2, 3, 4, 5, 6, 7); }
  SNOW_INLINE static Mask first(int n) { return {_mm256_castsi256_ps(first_lanes(n))}; }
  SNOW_INLINE static uint32_t bits(Mask m) { return uint32_t(_mm256_movemask_ps(m.m)); }
  SNOW_INLINE static Mask from_bits(uint32_t b) {
    const __m256i lane = _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128);
    __m256i x = _mm256_and_si256(_mm256_set1_epi32(int(b)), lane);
    return {_mm256_castsi256_ps(_mm256_cmpeq_epi32(x, lane))};
  }

  SNOW_INLINE friend Simd select(Mask m, Simd a, Simd b) { return _mm256_blendv_ps(b.v, a.v, m.m); }
  SNOW_INLINE friend Simd zero_unless(Mask m, Simd a) { return _mm256_and_ps(m.m, a.v); }
  SNOW_INLINE friend Simd min(Simd a, Simd b) { return _mm256_min_ps(a.v, b.v); }
  SNOW_INLINE friend Simd max(Simd a, Simd b) { return _mm256_max_ps(a.v, b.v); }
  SNOW_INLINE friend Simd sqrt(Simd a) { return _mm256_sqrt_ps(a.v); }
  SNOW_INLINE friend Simd reciprocal(Simd a) {  // 12-bit estimate and one Newton step: 2^-23
    Simd r = _mm256_rcp_ps(a.v);
    return r * (Simd(2.f) - a * r);
  }
  SNOW_INLINE friend Simd reciprocal_estimate(Simd a) { return reciprocal(a); }
  SNOW_INLINE friend Simd rsqrt(Simd a) {
    Simd r = _mm256_rsqrt_ps(a.v);
    return r * (Simd(1.5f) - Simd(0.5f) * a * r * r);
  }
  SNOW_INLINE static void split(Simd x, Simd& f, IVec& whole) {
    __m256 fl = _mm256_floor_ps(x.v);
    f = x.v - fl;
    whole = _mm256_cvtps_epi32(fl);
  }
  SNOW_INLINE static Simd scale_by_pow2(Simd a, IVec whole) {
    return _mm256_castsi256_ps(
        _mm256_add_epi32(_mm256_castps_si256(a.v), _mm256_slli_epi32(whole, 23)));
  }
  SNOW_INLINE static void split_log2(Simd x, Simd& mantissa_part, Simd& exponent) {
    __m256i i = _mm256_castps_si256(x.v);
    __m256i e = _mm256_srai_epi32(_mm256_sub_epi32(i, _mm256_set1_epi32(0x3f3504f3)), 23);
    mantissa_part = _mm256_castsi256_ps(_mm256_sub_epi32(i, _mm256_slli_epi32(e, 23)));
    exponent = _mm256_cvtepi32_ps(e);
  }
};
#endif

#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <>
struct Simd<float, 16> {
  using Scalar = float;
  using Int = int32_t;
  static constexpr int width = 16;
  typedef __m512 Vec;
  typedef __m512 IVec;  // split() keeps x itself: vscalefps does floor and scale in one

  struct Mask {
    __mmask16 m;
    SNOW_INLINE friend Mask operator&(Mask a, Mask b) { return {__mmask16(a.m & b.m)}; }
    SNOW_INLINE friend Mask operator|(Mask a, Mask b) { return {__mmask16(a.m | b.m)}; }
  };

  Vec v;

  Simd() = default;
  SNOW_INLINE Simd(Vec x) : v(x) {}
  template <class S, IfNumber<S> = 0>
  SNOW_INLINE Simd(S s) : v(_mm512_set1_ps(float(s))) {}

  SNOW_INLINE friend Simd operator+(Simd a, Simd b) { return a.v + b.v; }
  SNOW_INLINE friend Simd operator-(Simd a, Simd b) { return a.v - b.v; }
  SNOW_INLINE friend Simd operator*(Simd a, Simd b) { return a.v * b.v; }
  SNOW_INLINE friend Simd operator/(Simd a, Simd b) { return a.v / b.v; }
  SNOW_INLINE friend Simd operator-(Simd a) { return -a.v; }
  SNOW_INLINE Simd& operator+=(Simd b) { return v += b.v, *this; }
  SNOW_INLINE Simd& operator-=(Simd b) { return v -= b.v, *this; }
  SNOW_INLINE Simd& operator*=(Simd b) { return v *= b.v, *this; }
  SNOW_INLINE friend Mask operator>=(Simd a, Simd b) {
    return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GE_OQ)};
  }
  SNOW_INLINE friend Mask operator>(Simd a, Simd b) {
    return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_GT_OQ)};
  }
  SNOW_INLINE friend Mask operator<(Simd a, Simd b) {
    return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LT_OQ)};
  }

  SNOW_INLINE static Simd load(const float* p) { return _mm512_loadu_ps(p); }
  SNOW_INLINE void store(float* p) const { _mm512_storeu_ps(p, v); }
  SNOW_INLINE static __mmask16 first_lanes(int n) {
    return __mmask16(n >= 16 ? 0xffff : (1u << n) - 1);
  }
  SNOW_INLINE static Simd load_first(const float* p, int n) {
    return _mm512_maskz_loadu_ps(first_lanes(n), p);
  }
  SNOW_INLINE void store_first(float* p, int n) const {
    _mm512_mask_storeu_ps(p, first_lanes(n), v);
  }
  SNOW_INLINE static Simd load_bytes(const uint8_t* p) {
    return _mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i*)p)));
  }
  SNOW_INLINE static Simd iota() {
    return _mm512_setr_ps(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  }
  SNOW_INLINE static Mask first(int n) { return {first_lanes(n)}; }
  SNOW_INLINE static uint32_t bits(Mask m) { return m.m; }
  SNOW_INLINE static Mask from_bits(uint32_t b) { return {__mmask16(b)}; }

  SNOW_INLINE friend Simd select(Mask m, Simd a, Simd b) {
    return _mm512_mask_blend_ps(m.m, b.v, a.v);
  }
  SNOW_INLINE friend Simd zero_unless(Mask m, Simd a) { return _mm512_maskz_mov_ps(m.m, a.v); }
  SNOW_INLINE friend Simd min(Simd a, Simd b) { return _mm512_min_ps(a.v, b.v); }
  SNOW_INLINE friend Simd max(Simd a, Simd b) { return _mm512_max_ps(a.v, b.v); }
  SNOW_INLINE friend Simd sqrt(Simd a) { return _mm512_sqrt_ps(a.v); }
  SNOW_INLINE friend Simd reciprocal(Simd a) {  // 14-bit estimate and one Newton step
    Simd r = _mm512_rcp14_ps(a.v);
    return r * (Simd(2.f) - a * r);
  }
  SNOW_INLINE friend Simd reciprocal_estimate(Simd a) { return _mm512_rcp14_ps(a.v); }
  SNOW_INLINE friend Simd rsqrt(Simd a) {
    Simd r = _mm512_rsqrt14_ps(a.v);
    return r * (Simd(1.5f) - Simd(0.5f) * a * r * r);
  }
  SNOW_INLINE static void split(Simd x, Simd& f, IVec& whole) {
    f = _mm512_reduce_ps(x.v, 1);  // x - floor(x)
    whole = x.v;
  }
  SNOW_INLINE static Simd scale_by_pow2(Simd a, IVec whole) { return _mm512_scalef_ps(a.v, whole); }
  SNOW_INLINE static void split_log2(Simd x, Simd& mantissa_part, Simd& exponent) {
    __m512i i = _mm512_castps_si512(x.v);
    __m512i e = _mm512_srai_epi32(_mm512_sub_epi32(i, _mm512_set1_epi32(0x3f3504f3)), 23);
    mantissa_part = _mm512_castsi512_ps(_mm512_sub_epi32(i, _mm512_slli_epi32(e, 23)));
    exponent = _mm512_cvtepi32_ps(e);
  }
};
#endif

// The native vector of this build, and the one in which the double-precision checks run.
#if defined(__AVX512F__) && defined(__AVX512DQ__)
using VecF = Simd<float, 16>;
#elif defined(__AVX2__) && defined(__FMA__)
using VecF = Simd<float, 8>;
#else
using VecF = Simd<float, 4>;
#endif
using VecD = Simd<double, 4>;

// ---- transcendental functions -------------------------------------------------------------------

template <class V>
SNOW_INLINE V map_lanes(V x, double (*f)(double)) {
  for (int l = 0; l < V::width; l++) x.v[l] = f(x.v[l]);
  return x;
}

// 2^x for blending, x in about [-30, 1]: minimax quartic on [0, 1), relative error 2.6e-6.
// Lanes far outside give garbage; the caller masks them.
template <int W>
SNOW_INLINE Simd<float, W> exp2_blend(Simd<float, W> x) {
  using V = Simd<float, W>;
  V f;
  typename V::IVec whole;
  V::split(x, f, whole);
  V p = f * V(0.013676527f) + V(0.051690261f);
  p = p * f + V(0.24168065f);
  p = p * f + V(0.69294637f);
  p = p * f + V(1.0000026f);
  return V::scale_by_pow2(p, whole);
}
SNOW_INLINE VecD exp2_blend(VecD x) { return map_lanes(x, std::exp2); }

// e^x, clamped to e^±80: degree 6 on [0, 1), relative error 2e-7.
template <int W>
SNOW_INLINE Simd<float, W> exp(Simd<float, W> x) {
  using V = Simd<float, W>;
  x = max(min(x * V(kLog2E), V(115.f)), V(-115.f));
  V f;
  typename V::IVec whole;
  V::split(x, f, whole);
  V p = f * V(2.1702255e-4f) + V(1.2439688e-3f);
  p = p * f + V(9.6788410e-3f);
  p = p * f + V(5.5483342e-2f);
  p = p * f + V(2.4022984e-1f);
  p = p * f + V(6.9314698e-1f);
  p = p * f + V(1.0f);
  return V::scale_by_pow2(p, whole);
}
SNOW_INLINE VecD exp(VecD x) { return map_lanes(x, std::exp); }

template <int W>
SNOW_INLINE Simd<float, W> log2(Simd<float, W> x) {
  using V = Simd<float, W>;
  V m, e;
  V::split_log2(x, m, e);
  V t = (m - V(1.f)) / (m + V(1.f)), t2 = t * t;
  V p = t2 * V(0.3206f) + V(0.41219858f);
  p = p * t2 + V(0.57707802f);
  p = p * t2 + V(0.96179669f);
  p = p * t2 + V(2.88539008f);
  return e + t * p;
}
SNOW_INLINE VecD log2(VecD x) { return map_lanes(x, std::log2); }

// ---- rows ⇄ lanes -------------------------------------------------------------------------------
// Parameters are stored a Gaussian a row, (N, K); the kernels want a Gaussian a lane. These move W
// rows of K columns between the two, four columns at a time as 4×4 transposes inside 128-bit lanes.

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
  // rows[l] + column: four (n) columns of row l → out[0..n) in lane l.
  SNOW_INLINE static void gather4(const T* const* rows, int column, int n, V* out) {
    for (int k = 0; k < n; k++)
      for (int l = 0; l < V::width; l++) out[k].v[l] = rows[l][column + k];
  }
  SNOW_INLINE static void scatter4(T* const* rows, int column, int n, const V* in, int count) {
    for (int l = 0; l < count; l++)
      for (int k = 0; k < n; k++) rows[l][column + k] = in[k].v[l];
  }
};

#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <>
struct RowMover<Simd<float, 16>> {
  using V = Simd<float, 16>;
  SNOW_INLINE static void transpose4(__m512 (&r)[4]) {
    __m512 a = _mm512_unpacklo_ps(r[0], r[1]), b = _mm512_unpacklo_ps(r[2], r[3]);
    __m512 c = _mm512_unpackhi_ps(r[0], r[1]), d = _mm512_unpackhi_ps(r[2], r[3]);
    r[0] = _mm512_shuffle_ps(a, b, 0x44), r[1] = _mm512_shuffle_ps(a, b, 0xEE);
    r[2] = _mm512_shuffle_ps(c, d, 0x44), r[3] = _mm512_shuffle_ps(c, d, 0xEE);
  }
  SNOW_INLINE static void gather4(const float* const* rows, int column, int n, V* out) {
    __m512 r[4];
    for (int j = 0; j < 4; j++) {
      __m512 x = _mm512_castps128_ps512(load_quad(rows[j] + column, n));
      x = _mm512_insertf32x4(x, load_quad(rows[j + 4] + column, n), 1);
      x = _mm512_insertf32x4(x, load_quad(rows[j + 8] + column, n), 2);
      r[j] = _mm512_insertf32x4(x, load_quad(rows[j + 12] + column, n), 3);
    }
    transpose4(r);
    for (int k = 0; k < n; k++) out[k] = r[k];
  }
  SNOW_INLINE static void scatter4(float* const* rows, int column, int n, const V* in, int count) {
    __m512 r[4];
    for (int k = 0; k < 4; k++) r[k] = k < n ? in[k].v : _mm512_setzero_ps();
    transpose4(r);
    for (int j = 0; j < 4; j++) {
      if (j < count) store_quad(rows[j] + column, _mm512_castps512_ps128(r[j]), n);
      if (j + 4 < count) store_quad(rows[j + 4] + column, _mm512_extractf32x4_ps(r[j], 1), n);
      if (j + 8 < count) store_quad(rows[j + 8] + column, _mm512_extractf32x4_ps(r[j], 2), n);
      if (j + 12 < count) store_quad(rows[j + 12] + column, _mm512_extractf32x4_ps(r[j], 3), n);
    }
  }
};
#endif

#if defined(__AVX2__) && defined(__FMA__)
template <>
struct RowMover<Simd<float, 8>> {
  using V = Simd<float, 8>;
  SNOW_INLINE static void transpose4(__m256 (&r)[4]) {
    __m256 a = _mm256_unpacklo_ps(r[0], r[1]), b = _mm256_unpacklo_ps(r[2], r[3]);
    __m256 c = _mm256_unpackhi_ps(r[0], r[1]), d = _mm256_unpackhi_ps(r[2], r[3]);
    r[0] = _mm256_shuffle_ps(a, b, 0x44), r[1] = _mm256_shuffle_ps(a, b, 0xEE);
    r[2] = _mm256_shuffle_ps(c, d, 0x44), r[3] = _mm256_shuffle_ps(c, d, 0xEE);
  }
  SNOW_INLINE static void gather4(const float* const* rows, int column, int n, V* out) {
    __m256 r[4];
    for (int j = 0; j < 4; j++)
      r[j] = _mm256_insertf128_ps(_mm256_castps128_ps256(load_quad(rows[j] + column, n)),
                                  load_quad(rows[j + 4] + column, n), 1);
    transpose4(r);
    for (int k = 0; k < n; k++) out[k] = r[k];
  }
  SNOW_INLINE static void scatter4(float* const* rows, int column, int n, const V* in, int count) {
    __m256 r[4];
    for (int k = 0; k < 4; k++) r[k] = k < n ? in[k].v : _mm256_setzero_ps();
    transpose4(r);
    for (int j = 0; j < 4; j++) {
      if (j < count) store_quad(rows[j] + column, _mm256_castps256_ps128(r[j]), n);
      if (j + 4 < count) store_quad(rows[j + 4] + column, _mm256_extractf128_ps(r[j], 1), n);
    }
  }
};
#endif

// W rows of `columns` columns ⇄ `columns` vectors. Calls, not inlined: a kernel moves a dozen tensors,
// and unrolled they would not fit the instruction cache.
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

// ---- sums over lanes ----------------------------------------------------------------------------
// out[k] = sum of the lanes of in[k], k < K <= 16; out has room for 16.
template <int K, class V>
SNOW_INLINE void sum_lanes(const V* in, typename V::Scalar* out) {
  for (int k = 0; k < K; k++) {
    typename V::Scalar s = 0;
    for (int l = 0; l < V::width; l++) s += in[k].v[l];
    out[k] = s;
  }
}

#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <int K>
SNOW_INLINE void sum_lanes(const Simd<float, 16>* in, float* out) {
  const __m512 zero = _mm512_setzero_ps();
  auto vec = [&](int k) { return k < K ? in[k].v : zero; };
  auto halves = [](__m512 a, __m512 b) {  // [a.lo + a.hi | b.lo + b.hi]
    return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
  };
  __m512 quad[4];
#pragma GCC unroll 4
  for (int q = 0; q < 4; q++) {  // quad[q]: 128-bit lane j holds 4 partial sums of in[4q + j]
    if (4 * q >= K) {
      quad[q] = zero;
      continue;
    }
    __m512 ab = halves(vec(4 * q), vec(4 * q + 1)), cd = halves(vec(4 * q + 2), vec(4 * q + 3));
    quad[q] = _mm512_add_ps(_mm512_shuffle_f32x4(ab, cd, 0x88), _mm512_shuffle_f32x4(ab, cd, 0xDD));
  }
  __m512 u =
      _mm512_add_ps(_mm512_unpacklo_ps(quad[0], quad[1]), _mm512_unpackhi_ps(quad[0], quad[1]));
  __m512 w =
      _mm512_add_ps(_mm512_unpacklo_ps(quad[2], quad[3]), _mm512_unpackhi_ps(quad[2], quad[3]));
  __m512 r = _mm512_add_ps(_mm512_shuffle_ps(u, w, 0x44), _mm512_shuffle_ps(u, w, 0xEE));
  // lane 4j + q now holds the sum of in[4q + j]
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_storeu_ps(out, _mm512_permutexvar_ps(order, r));
}
#endif

#if defined(__AVX2__) && defined(__FMA__)
template <int K>
SNOW_INLINE void sum_lanes(const Simd<float, 8>* in, float* out) {
  const __m256 zero = _mm256_setzero_ps();
  auto vec = [&](int k) { return k < K ? in[k].v : zero; };
#pragma GCC unroll 4
  for (int q = 0; q < (K + 3) / 4; q++) {
    __m256 s = _mm256_hadd_ps(_mm256_hadd_ps(vec(4 * q), vec(4 * q + 1)),
                              _mm256_hadd_ps(vec(4 * q + 2), vec(4 * q + 3)));
    _mm_storeu_ps(out + 4 * q, _mm_add_ps(_mm256_castps256_ps128(s), _mm256_extractf128_ps(s, 1)));
  }
}
#endif

SNOW_INLINE void prefetch(const void* p) { __builtin_prefetch(p, 0, 3); }

// Denormals cost 1.7× in blending: every kernel turns them off on each of its threads, and restores
// what the caller had.
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
