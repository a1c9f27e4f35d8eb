// The vocabulary in which the maths headers are written, so that one text serves every `Real`:
// plain float (CUDA), Simd<float, W> (CPU) and Simd<double, W> (checks). A branch on data is a
// select(), because in lanes both sides exist.
#pragma once

#include <cmath>

#if defined(__CUDACC__) || defined(__CUDACC_RTC__)
#define SNOW_INLINE __device__ __forceinline__
#else
#define SNOW_INLINE inline __attribute__((always_inline))
#endif

namespace snow {

SNOW_INLINE float select(bool m, float a, float b) { return m ? a : b; }
SNOW_INLINE float min(float a, float b) { return a < b ? a : b; }
SNOW_INLINE float max(float a, float b) { return a > b ? a : b; }
SNOW_INLINE float sqrt(float a) { return ::sqrtf(a); }
SNOW_INLINE float exp(float a) { return ::expf(a); }
SNOW_INLINE float log2(float a) { return ::log2f(a); }

constexpr double kLog2E = 1.4426950408889634;
constexpr double kLn2 = 0.6931471805599453;
constexpr double kLn255 = 5.541263545158426;

// Blending constants of Kerbl et al. 2023, section 6 and appendix C.
constexpr double kMinAlpha = 1.0 / 255.0;             // fainter contributions are skipped
constexpr double kMaxAlpha = 0.99;                    // keeps 1 - alpha away from 0
constexpr double kMinTransmittance = 1e-4;            // a pixel this opaque is finished
constexpr double kLog2MinAlpha = -7.994353436858858;  // log2(1/255)
constexpr double kDilation = 0.3;  // low-pass added to the 2D covariance, pixels^2

constexpr int kTile = 16;  // tile edge, pixels

}  // namespace snow
