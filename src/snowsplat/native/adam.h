// The update rule of Adam (Kingma & Ba 2015), for CPU and GPU:
//
//   m ← β₁ m + (1 − β₁) g,   v ← β₂ v + (1 − β₂) g²,   p ← p − lr m̂ / √(v̂ + ε²)
//
// ε is inside the root, so that one reciprocal square root suffices. For ε = 1e-15, which is used
// here, the result equals that of √v̂ + ε in practice.
//
// If a step would make a value infinite or NaN, the value and its moments stay unchanged. So a
// non-finite gradient does not change the parameters. Rows with such values are counted.
#pragma once

#include "params.h"

namespace snow {

constexpr int kAdamParameters = 6;  // means, log_scales, quats, opacity_logits, sh_dc, sh_rest

template <class Real>
struct AdamRule {
  Real beta1, beta2, gain1, gain2, inv_correction2, eps2;

  template <class T>
  SNOW_INLINE explicit AdamRule(const AdamStepParams<T>& p)
      : beta1(Real(p.beta1)), beta2(Real(p.beta2)), gain1(Real(1 - p.beta1)),
        gain2(Real(1 - p.beta2)), inv_correction2(Real(p.inv_correction2)), eps2(Real(p.eps2)) {}

  // rate: lr / (1 − β₁ᵗ)
  SNOW_INLINE void step(Real g, Real& m, Real& v, Real& p, Real rate) const {
    m = beta1 * m + gain1 * g;
    v = beta2 * v + gain2 * g * g;
    p -= rate * m * rsqrt(v * inv_correction2 + eps2);
  }
  // Whether the results of a step are finite. m need not be tested: v is finite only if the
  // gradient and m are.
  SNOW_INLINE static auto is_taken(Real v, Real p) { return is_finite(v + p); }
};

}  // namespace snow
