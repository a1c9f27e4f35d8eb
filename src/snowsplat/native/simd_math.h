// exp, exp2 and log2 of SIMD lanes: polynomials in float, functions of the C library in double.
#pragma once

#include "simd.h"

namespace snow {

template <class V>
SNOW_INLINE V map_lanes(V x, double (*f)(double)) {
  for (int l = 0; l < V::width; l++) x.v[l] = f(x.v[l]);
  return x;
}

// 2^x for blending, for x between about -30 and 1: a minimax polynomial of degree 4 on [0, 1) with
// a relative error of 2.6e-6. The result is undefined for x far outside of this range; the caller
// masks such lanes.
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

// e^x, clamped to e^±80: a polynomial of degree 6 on [0, 1) with a relative error of 2e-7.
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

}  // namespace snow
