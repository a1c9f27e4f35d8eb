// The opacity of one splat at one pixel, and where it can be seen at all.
//
// With d = pixel − mean, α(d) = o exp(−½ dᵀ K d) (Kerbl et al. 2023, eq. 3 and appendix). Kernels
// use the base-2 logarithm, in which the opacity is a summand and the test α ≥ 1/255 one
// comparison:
//
//   log₂ α = A dx² + B dx dy + C dy² + log₂ o,   A = −½ log₂e · a,  B = −log₂e · b,  C = −½ log₂e ·
//   c
//
// Along a row of pixels x = X + x₀ this is a quadratic in X whose coefficients depend on the row
// only.
#pragma once

#include "portable.h"

namespace snow {

template <class Real>
struct SplatTerms {
  Real mean_x, mean_y, A, B, C, log2_opacity;
  Real slope_x,
      slope_y;  // −B/2A, −B/2C: where log₂α peaks along a row (x = slope_x · dy), a column
};

template <class Real>
SNOW_INLINE SplatTerms<Real> splat_terms(Real mean_x, Real mean_y, const Real* conic,
                                         Real opacity) {
  SplatTerms<Real> s;
  s.mean_x = mean_x, s.mean_y = mean_y;
  s.A = Real(-0.5 * kLog2E) * conic[0];
  s.B = Real(-kLog2E) * conic[1];
  s.C = Real(-0.5 * kLog2E) * conic[2];
  s.log2_opacity = log2(opacity);
  s.slope_x = -(conic[1] / conic[0]);
  s.slope_y = -(conic[1] / conic[2]);
  return s;
}

// The largest log₂(α / o) over the pixel centres' rectangle [x0, x1] × [y0, y1], relative to the
// mean. The quadratic is concave with its top at the origin, so over a rectangle it peaks on the
// edges that face the origin.
template <class Real>
SNOW_INLINE Real peak_over_rectangle(const SplatTerms<Real>& s, Real x0, Real y0, Real x1,
                                     Real y1) {
  const Real zero(0.f);
  const Real y = min(max(zero, y0), y1), x_on = min(max(s.slope_x * y, x0), x1);
  const Real x = min(max(zero, x0), x1), y_on = min(max(s.slope_y * x, y0), y1);
  const Real on_row = (s.A * x_on + s.B * y) * x_on + s.C * y * y;
  const Real on_column = (s.C * y_on + s.B * x) * y_on + s.A * x * x;
  return max(on_row, on_column);
}

constexpr int kGroupChannels = 4;  // channels that one blending pass carries at most
constexpr int kSlotWidth = 16;     // scalars of one (tile, splat) gradient: ≤ 4 colours, 6 moments

// Culling keeps this much more than the exact threshold, for rounding.
constexpr double kCullSlack = 1e-3;

// Sums of q = ∂L/∂(log α) over pixels, weighted by the powers of d, are all that the geometric
// gradients need:  ∂ log α/∂mean = K d,  ∂/∂a = −½ dx²,  ∂/∂b = −dx dy,  ∂/∂c = −½ dy²,  ∂/∂o =
// 1/o.
template <class Real>
struct BlendMoments {
  Real q, qx, qy, qxx, qxy, qyy;
};

template <class Real>
SNOW_INLINE void splat_terms_vjp(const Real* conic, Real opacity, const BlendMoments<Real>& m,
                                 Real* d_mean, Real* d_conic, Real& d_opacity) {
  d_mean[0] = conic[0] * m.qx + conic[1] * m.qy;
  d_mean[1] = conic[1] * m.qx + conic[2] * m.qy;
  d_conic[0] = Real(-0.5f) * m.qxx;
  d_conic[1] = -m.qxy;
  d_conic[2] = Real(-0.5f) * m.qyy;
  d_opacity = m.q / opacity;
}

}  // namespace snow
