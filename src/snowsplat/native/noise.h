// add_noise for one Gaussian, for CPU and GPU.
#pragma once

#include "projection.h"

namespace snow {

// The logarithm of the largest variance of the noise: it is finite in float for any scale.
constexpr double kMaxLogVariance = 40.0;

// Four random numbers of 32 bits for a row: Philox 4x32-10 of Salmon et al. 2011, "Parallel random
// numbers: as easy as 1, 2, 3", with the key `seed` and the counter `row`.
SNOW_INLINE void random_bits(uint64_t seed, uint64_t row, uint32_t* bits) {
  uint32_t a = uint32_t(row), b = uint32_t(row >> 32), c = 0, d = 0;
  uint32_t key0 = uint32_t(seed), key1 = uint32_t(seed >> 32);
  for (int round = 0; round < 10; round++) {
    const uint64_t first = uint64_t(0xD2511F53u) * a, second = uint64_t(0xCD9E8D57u) * c;
    a = uint32_t(second >> 32) ^ b ^ key0, b = uint32_t(second);
    c = uint32_t(first >> 32) ^ d ^ key1, d = uint32_t(first);
    key0 += 0x9E3779B9u, key1 += 0xBB67AE85u;
  }
  bits[0] = a, bits[1] = b, bits[2] = c, bits[3] = d;
}

// sin(2π turns) and cos(2π turns). In float, GPUs have instructions for them.
#if defined(__CUDACC_RTC__)
SNOW_INLINE void sine_and_cosine(float turns, float& sine, float& cosine) {
  ::sincospif(2.f * turns, &sine, &cosine);
}
SNOW_INLINE void sine_and_cosine(double turns, double& sine, double& cosine) {
  ::sincospi(2.0 * turns, &sine, &cosine);
}
#else
template <class Real>
SNOW_INLINE void sine_and_cosine(Real turns, Real& sine, Real& cosine) {
  const Real angle = Real(6.283185307179586) * turns;
  sine = std::sin(angle), cosine = std::cos(angle);
}
#endif

// Two samples of N(0, 1) from 64 random bits (Box and Muller 1958).
template <class Real>
SNOW_INLINE void normal_samples(uint32_t bits0, uint32_t bits1, Real* samples) {
  const Real unit(1.0 / 4294967296.0);
  const Real uniform = (Real(bits0) + Real(0.5)) * unit;  // not 0; in float it may be 1
  const Real radius = sqrt(Real(-2.0 * kLn2) * log2(uniform));
  Real sine, cosine;
  sine_and_cosine(Real(bits1) * unit, sine, cosine);
  samples[0] = radius * cosine, samples[1] = radius * sine;
}

// Adds the noise of row i of p: amount · σ(k (t − o)) · R S² Rᵀ η.
template <class T>
SNOW_INLINE void add_noise_to_row(const AddNoiseParams<T>& p, int64_t i) {
  const T opacity = T(1) / (T(1) + exp(-p.opacity_logits[i]));
  const T gate = T(1) / (T(1) + exp(T(p.sharpness) * (opacity - T(p.opacity))));
  if (!(gate > T(p.negligible))) return;
  uint32_t bits[4];
  random_bits(uint64_t(p.seed), uint64_t(p.first + i), bits);
  T eta[4], quat[4], R[9];
  normal_samples(bits[0], bits[1], eta);
  normal_samples(bits[2], bits[3], eta + 2);
  normalise_quat(p.quats + 4 * i, quat);
  quat_to_rotation(quat, R);
  T noise[3] = {};
  for (int k = 0; k < 3; k++) {
    // A NaN stays NaN: `min` returns its second argument.
    const T variance = exp(min(T(kMaxLogVariance), T(2) * p.log_scales[3 * i + k]));
    const T along = variance * (R[k] * eta[0] + R[3 + k] * eta[1] + R[6 + k] * eta[2]);
    for (int j = 0; j < 3; j++) noise[j] += R[3 * j + k] * along;
  }
  T mean[3];
  for (int j = 0; j < 3; j++) mean[j] = p.means[3 * i + j] + T(p.amount) * gate * noise[j];
  if (!is_finite(mean[0] + mean[1] + mean[2])) return;
  for (int j = 0; j < 3; j++) p.means[3 * i + j] = mean[j];
}

}  // namespace snow
