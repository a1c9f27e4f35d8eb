// Structural similarity of two images a and b at one pixel (Wang et al. 2004), from the windowed
// means of a, b, a² + b² and ab, and its derivatives with respect to the means that depend on a.
#pragma once

#include "portable.h"

namespace snow {

constexpr double kSsimC1 = 0.01 * 0.01, kSsimC2 = 0.03 * 0.03;
constexpr int kSsimRadius = 5;  // 11×11 window, Gaussian with σ = 1.5
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
// The Huber function is x² up to this distance and grows linearly beyond it: δ (2 |x| − δ).
constexpr double kHuberDelta = 0.1;

// The separable window: exp(−x²/(2·1.5²)) / Σ for x = k − 5.
SNOW_INLINE constexpr double ssim_tap(int k) {
  const int x = k < kSsimRadius ? kSsimRadius - k : k - kSsimRadius;
  return x == 0   ? 0.26601172486179436
         : x == 1 ? 0.2130055377112537
         : x == 2 ? 0.10936068950970002
         : x == 3 ? 0.03600077212843083
         : x == 4 ? 0.007598758135239185
                  : 0.00102838008447911;
}

template <class Real>
struct SsimDerivatives {
  Real mean_a, mean_aa, mean_ab;
};

template <class Real>
SNOW_INLINE Real ssim_pixel(Real mean_a, Real mean_b, Real mean_squares, Real mean_ab,
                            SsimDerivatives<Real>& d) {
  const Real two(2.f), c1(kSsimC1), c2(kSsimC2);
  const Real ab = mean_a * mean_b, squares = mean_a * mean_a + mean_b * mean_b;
  const Real l_up = two * ab + c1, l_down = squares + c1;
  const Real s_up = two * (mean_ab - ab) + c2, s_down = mean_squares - squares + c2;
  const Real inverse = reciprocal(l_down * s_down);
  const Real ssim = l_up * s_up * inverse;
  d.mean_ab = two * l_up * inverse;
  d.mean_aa = -(ssim * inverse * l_down);
  d.mean_a =
      two * (mean_b * s_up * inverse - mean_a * ssim * inverse * s_down - mean_a * d.mean_aa) -
      mean_b * d.mean_ab;
  return ssim;
}

}  // namespace snow
