// Simd<float, 16> with AVX-512 (F and DQ). simd.h includes this file if the compiler supports them.
#pragma once

#include "simd.h"

namespace snow {

template <>
struct Simd<float, 16> {
  using Scalar = float;
  using Int = int32_t;
  static constexpr int width = 16;
  typedef __m512 Vec;
  typedef __m512 IVec;  // split() returns x itself: vscalefps computes floor and scale

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
  SNOW_INLINE Simd<float, 4> sum_of_quads() const {
    const __m256 high = _mm512_extractf32x8_ps(v, 1);
    return Simd<float, 8>(_mm256_add_ps(_mm512_castps512_ps256(v), high)).sum_of_quads();
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
  SNOW_INLINE friend Simd fma(Simd a, Simd b, Simd c) { return _mm512_fmadd_ps(a.v, b.v, c.v); }
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

}  // namespace snow
