// Real spherical harmonics up to degree 3, and the view-dependent colour max(0, ½ + Σ c_k
// Y_k(dir)). The coefficients of the three channels are adjacent: c[3 k + channel].
#pragma once

#include "portable.h"

namespace snow {

constexpr int kMaxShCoefficients = 16;

// Number of columns of sh_rest that a degree uses.
SNOW_INLINE int sh_columns(int degree) { return 3 * ((degree + 1) * (degree + 1) - 1); }

constexpr double kSH0 = 0.28209479177387814;
constexpr double kSH1 = 0.4886025119029199;
constexpr double kSH2[5] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005,
                            -1.0925484305920792, 0.5462742152960396};
constexpr double kSH3[7] = {-0.5900435899266435, 2.890611442640554,   -0.4570457994644658,
                            0.3731763325901154,  -0.4570457994644658, 1.445305721320277,
                            -0.5900435899266435};

// Y_0 … Y_15 at the unit vector (x, y, z); only the first (degree+1)² are written.
template <class Real>
SNOW_INLINE void sh_basis(int degree, Real x, Real y, Real z, Real* Y) {
  auto c = [](double value) { return Real(value); };
  Y[0] = c(kSH0);
  if (degree < 1) return;
  Y[1] = c(-kSH1) * y, Y[2] = c(kSH1) * z, Y[3] = c(-kSH1) * x;
  if (degree < 2) return;
  const Real xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  const Real two = c(2), three = c(3), four = c(4);
  Y[4] = c(kSH2[0]) * xy, Y[5] = c(kSH2[1]) * yz, Y[6] = c(kSH2[2]) * (two * zz - xx - yy);
  Y[7] = c(kSH2[3]) * xz, Y[8] = c(kSH2[4]) * (xx - yy);
  if (degree < 3) return;
  Y[9] = c(kSH3[0]) * y * (three * xx - yy), Y[10] = c(kSH3[1]) * xy * z;
  Y[11] = c(kSH3[2]) * y * (four * zz - xx - yy);
  Y[12] = c(kSH3[3]) * z * (two * zz - three * xx - three * yy);
  Y[13] = c(kSH3[4]) * x * (four * zz - xx - yy), Y[14] = c(kSH3[5]) * z * (xx - yy);
  Y[15] = c(kSH3[6]) * x * (xx - three * yy);
}

// The gradient with respect to x, y and z (as independent variables) from d[k] = ∂L/∂Y_k.
template <class Real>
SNOW_INLINE void sh_basis_vjp(int degree, Real x, Real y, Real z, const Real* d, Real* g) {
  auto c = [](double value) { return Real(value); };
  g[0] = g[1] = g[2] = c(0);
  if (degree < 1) return;
  g[0] = c(-kSH1) * d[3], g[1] = c(-kSH1) * d[1], g[2] = c(kSH1) * d[2];
  if (degree < 2) return;
  const Real xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  g[0] += c(kSH2[0]) * y * d[4] + c(-2 * kSH2[2]) * x * d[6] + c(kSH2[3]) * z * d[7] +
          c(2 * kSH2[4]) * x * d[8];
  g[1] += c(kSH2[0]) * x * d[4] + c(kSH2[1]) * z * d[5] + c(-2 * kSH2[2]) * y * d[6] +
          c(-2 * kSH2[4]) * y * d[8];
  g[2] += c(kSH2[1]) * y * d[5] + c(4 * kSH2[2]) * z * d[6] + c(kSH2[3]) * x * d[7];
  if (degree < 3) return;
  const Real three = c(3), four = c(4);
  g[0] += c(6 * kSH3[0]) * xy * d[9] + c(kSH3[1]) * yz * d[10] + c(-2 * kSH3[2]) * xy * d[11] +
          c(-6 * kSH3[3]) * xz * d[12] + c(kSH3[4]) * (four * zz - three * xx - yy) * d[13] +
          c(2 * kSH3[5]) * xz * d[14] + c(3 * kSH3[6]) * (xx - yy) * d[15];
  g[1] += c(3 * kSH3[0]) * (xx - yy) * d[9] + c(kSH3[1]) * xz * d[10] +
          c(kSH3[2]) * (four * zz - xx - three * yy) * d[11] + c(-6 * kSH3[3]) * yz * d[12] +
          c(-2 * kSH3[4]) * xy * d[13] + c(-2 * kSH3[5]) * yz * d[14] +
          c(-6 * kSH3[6]) * xy * d[15];
  g[2] += c(kSH3[1]) * xy * d[10] + c(8 * kSH3[2]) * yz * d[11] +
          c(3 * kSH3[3]) * (zz + zz - xx - yy) * d[12] + c(8 * kSH3[4]) * xz * d[13] +
          c(kSH3[5]) * (xx - yy) * d[14];
}

template <class Real>
struct ViewDirection {  // unit vector from the camera to the mean
  Real x, y, z, inv_length;
};

template <class Real, class T>
SNOW_INLINE ViewDirection<Real> view_direction(const Real* mean, const T* position) {
  Real x = mean[0] - Real(position[0]), y = mean[1] - Real(position[1]);
  Real z = mean[2] - Real(position[2]);
  Real inv = Real(1.f) / sqrt(x * x + y * y + z * z);
  return {x * inv, y * inv, z * inv, inv};
}

// The colour before it is clamped at 0. dc: 3 values; rest: 3 ((degree+1)² − 1) values.
template <class Real>
SNOW_INLINE void sh_color(int degree, const ViewDirection<Real>& dir, const Real* dc,
                          const Real* rest, Real* color) {
  Real Y[kMaxShCoefficients];
  sh_basis(degree, dir.x, dir.y, dir.z, Y);
  for (int ch = 0; ch < 3; ch++) color[ch] = Real(0.5f) + Y[0] * dc[ch];
  for (int k = 1; k < (degree + 1) * (degree + 1); k++)
    for (int ch = 0; ch < 3; ch++) color[ch] += Y[k] * rest[3 * (k - 1) + ch];
}

// Computes d_dc, d_rest and d_mean from d_color. −d_mean is the gradient of the camera's position.
template <class Real>
SNOW_INLINE void sh_color_vjp(int degree, const ViewDirection<Real>& dir, const Real* dc,
                              const Real* rest, const Real* d_color, Real* d_dc, Real* d_rest,
                              Real* d_mean) {
  // The clamp passes the gradient only where the colour is positive.
  Real color[3], dcol[3], Y[kMaxShCoefficients], dY[kMaxShCoefficients], g[3];
  sh_basis(degree, dir.x, dir.y, dir.z, Y);
  const int count = (degree + 1) * (degree + 1);
  for (int ch = 0; ch < 3; ch++) color[ch] = Real(0.5f) + Y[0] * dc[ch];
  for (int k = 1; k < count; k++)
    for (int ch = 0; ch < 3; ch++) color[ch] += Y[k] * rest[3 * (k - 1) + ch];
  for (int ch = 0; ch < 3; ch++) {
    dcol[ch] = select(color[ch] >= Real(0.f), d_color[ch], Real(0.f));
    d_dc[ch] = Y[0] * dcol[ch];
  }
  for (int k = 1; k < count; k++) {
    dY[k] = rest[3 * (k - 1)] * dcol[0] + rest[3 * (k - 1) + 1] * dcol[1] +
            rest[3 * (k - 1) + 2] * dcol[2];
    for (int ch = 0; ch < 3; ch++) d_rest[3 * (k - 1) + ch] = Y[k] * dcol[ch];
  }
  sh_basis_vjp(degree, dir.x, dir.y, dir.z, dY, g);
  // dir = v / |v| ⇒ dv = (g − (g·dir) dir) / |v|
  const Real radial = g[0] * dir.x + g[1] * dir.y + g[2] * dir.z;
  d_mean[0] = (g[0] - radial * dir.x) * dir.inv_length;
  d_mean[1] = (g[1] - radial * dir.y) * dir.inv_length;
  d_mean[2] = (g[2] - radial * dir.z) * dir.inv_length;
}

}  // namespace snow
