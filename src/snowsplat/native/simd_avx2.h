// Simd<float, 8> with AVX2 and FMA. simd.h includes this file if the compiler supports them.
#pragma once

#include "simd.h"

namespace snow {

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
  SNOW_INLINE Simd<float, 4> sum_of_quads() const {
    return _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
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
  SNOW_INLINE friend Simd fma(Simd a, Simd b, Simd c) { return _mm256_fmadd_ps(a.v, b.v, c.v); }
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

}  // namespace snow
