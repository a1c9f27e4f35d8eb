// The opacity α of one splat at one pixel, the pixels in which a splat is visible, and the
// compositing of splats.
//
// α(d) = o exp(−½ dᵀ K d), where d = pixel − mean, o is the opacity and K the conic (Kerbl et al.
// 2023, eq. 3 and appendix). The kernels use the base-2 logarithm. Then the opacity is a summand,
// and the test α ≥ 1/255 is a single comparison:
//
//   log₂ α = A dx² + B dx dy + C dy² + log₂ o,
//   A = −½ log₂e · a,  B = −log₂e · b,  C = −½ log₂e · c
//
// Along a row of pixels of a tile, dy is constant and dx = X − x₀, where X is the column of the
// pixel and x₀ that of the mean. Therefore log₂ α is a quadratic function of X, whose coefficients
// depend only on the row.
#pragma once

#include "layout.h"

namespace snow {

// ---- Where a splat is visible -------------------------------------------------------------------

// The squared Mahalanobis distance k² at which α = o exp(−k²/2) is 1/255.
template <class Real>
SNOW_INLINE Real squared_cutoff(Real opacity) {
  return Real(2 * kLn2) * (log2(opacity) - Real(kLog2MinAlpha));
}

// The rectangle of pixels that the bounding box of a splat's ellipse {α ≥ 1/255} covers, clamped to
// an image whose last pixel is (right, bottom). `visible` is false if the box does not overlap the
// image or the conic is not positive definite.
template <class Real>
struct PixelExtent {
  Real x0, y0, x1, y1;
  decltype(Real(0.f) >= Real(0.f)) visible;

  SNOW_INLINE PixelExtent(Real x, Real y, const Real* conic, Real opacity, Real right,
                          Real bottom) {
    const Real a = conic[0], b = conic[1], c = conic[2], zero(0.f), half(0.5f);
    const Real det = a * c - b * b;
    const Real k2 = squared_cutoff(opacity);
    const Real reach = max(k2, zero) / det;
    const Real ex = sqrt(reach * c), ey = sqrt(reach * a);
    x0 = max(x - ex - half, zero), x1 = min(x + ex - half, right);
    y0 = max(y - ey - half, zero), y1 = min(y + ey - half, bottom);
    visible = (k2 >= zero) & (det > zero) & (a > zero) & (x1 >= x0) & (y1 >= y0);
  }
};

// An unsigned integer for each float, in the same order: the keys for sorting splats by depth.
SNOW_INLINE uint32_t ordered_bits(float x) {
  const uint32_t b = bits_of(x);
  return b >> 31 ? ~b : b | 0x80000000u;
}
SNOW_INLINE uint64_t ordered_bits(double x) {
  const uint64_t b = bits_of(x);
  return b >> 63 ? ~b : b | 0x8000000000000000ull;
}

template <class Real>
struct SplatTerms {
  Real mean_x, mean_y, A, B, C, log2_opacity;
  // −B/2A and −B/2C: along a row, log₂α is largest at dx = slope_x · dy; along a column, it is
  // largest at dy = slope_y · dx.
  Real slope_x, slope_y;
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

// The maximum of log₂(α / o) over the rectangle [x0, x1] × [y0, y1] of pixel centres, whose
// coordinates are relative to the mean. The quadratic is concave, with its maximum at the origin.
// So its maximum over a rectangle that does not contain the origin is on an edge that faces the
// origin.
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

// Because of rounding, culling lowers the threshold of log₂α by this margin.
constexpr double kCullSlack = 1e-3;

// ---- Compositing --------------------------------------------------------------------------------
//
// Splats are composited front to back. T = Π (1 − α) is the transmittance of the splats in front.
// The weight of a splat is α T; a splat with α < 1/255 is skipped. A pixel is finished when the
// next splat would make T < 1e-4.
//
// In the additive mode, the weight of a splat is o exp(−½ dᵀ K d), without a limit, and T stays 1. A
// splat with a weight below 1/255 is skipped. The order of the splats has no effect, and ∂L/∂(log α)
// is the weight times the dot product of ∂L/∂C and the colour.

template <class Real>
SNOW_INLINE auto is_blended(Real log2_alpha) {
  return log2_alpha >= Real(kLog2MinAlpha);
}

// α, limited so that 1 − α is not near 0.
template <class Real>
SNOW_INLINE Real capped_alpha(Real alpha) {
  return min(alpha, Real(kMaxAlpha));
}

template <class Real>
SNOW_INLINE auto is_open(Real transmittance) {
  return transmittance >= Real(kMinTransmittance);
}

// ∂L/∂(log α) of a splat at a pixel. `weighted_dot` is the weight of the splat times the dot
// product of ∂L/∂C and its colour; `behind` is the sum of this product over the splats behind it.
// No division by T is needed.
template <class Real>
SNOW_INLINE Real log_alpha_gradient(Real weighted_dot, Real alpha, Real behind) {
  return weighted_dot - alpha * behind * reciprocal_estimate(Real(1.f) - alpha);
}

// The gradients of the mean, the conic and the opacity are computed from sums of q = ∂L/∂(log α)
// over pixels, weighted by powers of d. The derivatives of log α are:
//   ∂/∂mean = K d,  ∂/∂a = −½ dx²,  ∂/∂b = −dx dy,  ∂/∂c = −½ dy²,  ∂/∂o = 1/o
template <class Real>
struct BlendMoments {
  Real q, qx, qy, qxx, qxy, qyy;
};

// ∂L/∂mean, from the sums of q dx and q dy over any set of pixels.
template <class Real>
SNOW_INLINE void mean_vjp(const Real* conic, Real qx, Real qy, Real* d_mean) {
  d_mean[0] = conic[0] * qx + conic[1] * qy;
  d_mean[1] = conic[1] * qx + conic[2] * qy;
}

template <class Real>
SNOW_INLINE void splat_terms_vjp(const Real* conic, Real opacity, const BlendMoments<Real>& m,
                                 Real* d_mean, Real* d_conic, Real& d_opacity) {
  mean_vjp(conic, m.qx, m.qy, d_mean);
  d_conic[0] = Real(-0.5f) * m.qxx;
  d_conic[1] = -m.qxy;
  d_conic[2] = Real(-0.5f) * m.qyy;
  d_opacity = m.q / opacity;
}

}  // namespace snow
