// Functions that make the mathematics headers work for every type `Real`: float and double (CUDA),
// Simd<float, W> (CPU) and Simd<double, W> (CPU, for gradient checks). A choice that depends on
// data is written as select() instead of a branch, because it may differ between SIMD lanes.
#pragma once

#if defined(__CUDACC_RTC__)  // NVRTC has no headers of the C library
using int8_t = signed char;
using uint8_t = unsigned char;
using int16_t = short;
using uint16_t = unsigned short;
using int32_t = int;
using uint32_t = unsigned int;
using int64_t = long long;
using uint64_t = unsigned long long;
#else
#include <cmath>
#include <cstdint>
#include <cstring>
#endif

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define SNOW_INLINE __device__ __forceinline__
#else
#define SNOW_INLINE inline __attribute__((always_inline))
#endif

namespace snow {

SNOW_INLINE float select(bool m, float a, float b) { return m ? a : b; }
SNOW_INLINE float min(float a, float b) { return a < b ? a : b; }
SNOW_INLINE float max(float a, float b) { return a > b ? a : b; }
SNOW_INLINE float abs(float a) { return ::fabsf(a); }
SNOW_INLINE float sqrt(float a) { return ::sqrtf(a); }
SNOW_INLINE float exp(float a) { return ::expf(a); }
SNOW_INLINE float log2(float a) { return ::log2f(a); }
SNOW_INLINE float exp2_blend(float a) { return ::exp2f(a); }
SNOW_INLINE float fma(float a, float b, float c) { return ::fmaf(a, b, c); }

SNOW_INLINE double select(bool m, double a, double b) { return m ? a : b; }
SNOW_INLINE double min(double a, double b) { return a < b ? a : b; }
SNOW_INLINE double max(double a, double b) { return a > b ? a : b; }
SNOW_INLINE double abs(double a) { return ::fabs(a); }
SNOW_INLINE double sqrt(double a) { return ::sqrt(a); }
SNOW_INLINE double exp(double a) { return ::exp(a); }
SNOW_INLINE double log2(double a) { return ::log2(a); }
SNOW_INLINE double exp2_blend(double a) { return ::exp2(a); }
SNOW_INLINE double fma(double a, double b, double c) { return ::fma(a, b, c); }

// 1/a and 1/√a. In float, GPUs have instructions for them.
SNOW_INLINE double reciprocal(double a) { return 1.0 / a; }
SNOW_INLINE double rsqrt(double a) { return 1.0 / ::sqrt(a); }
SNOW_INLINE double reciprocal_estimate(double a) { return 1.0 / a; }
#if defined(__CUDACC_RTC__)
SNOW_INLINE float reciprocal(float a) { return __frcp_rn(a); }
SNOW_INLINE float rsqrt(float a) { return ::rsqrtf(a); }
SNOW_INLINE float reciprocal_estimate(float a) { return __fdividef(1.f, a); }
#else
SNOW_INLINE float reciprocal(float a) { return 1.f / a; }
SNOW_INLINE float rsqrt(float a) { return 1.f / ::sqrtf(a); }
SNOW_INLINE float reciprocal_estimate(float a) { return 1.f / a; }
#endif

// Whether a is neither infinite nor NaN. Infinity minus itself is NaN, and comparisons with NaN are
// false.
template <class Real>
SNOW_INLINE auto is_finite(Real a) {
  return a - a >= Real(0.f);
}

// The bits of a number as an unsigned integer.
#if defined(__CUDACC_RTC__)
SNOW_INLINE uint32_t bits_of(float a) { return __float_as_uint(a); }
SNOW_INLINE uint64_t bits_of(double a) { return uint64_t(__double_as_longlong(a)); }
#else
SNOW_INLINE uint32_t bits_of(float a) {
  uint32_t bits;
  std::memcpy(&bits, &a, sizeof bits);
  return bits;
}
SNOW_INLINE uint64_t bits_of(double a) {
  uint64_t bits;
  std::memcpy(&bits, &a, sizeof bits);
  return bits;
}
#endif

constexpr double kLog2E = 1.4426950408889634;
constexpr double kLn2 = 0.6931471805599453;
constexpr double kLn255 = 5.541263545158426;

// Constants of Kerbl et al. 2023, section 6 and appendix C.
constexpr double kMinAlpha = 1.0 / 255.0;   // contributions with a smaller alpha are skipped
constexpr double kMaxAlpha = 0.99;          // keeps 1 - alpha away from 0
constexpr double kMinTransmittance = 1e-4;  // a pixel is finished before T falls below
constexpr double kLog2MinAlpha = -7.994353436858858;  // log2(1/255)
constexpr double kDilation = 0.3;     // added to the diagonal of the 2D covariance, pixels^2
constexpr double kMipDilation = 0.1;  // instead, for antialiased scenes (Yu et al. 2024)

}  // namespace snow
