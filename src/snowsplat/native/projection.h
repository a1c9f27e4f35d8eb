// The geometry of one Gaussian: world → camera → 2D splat (EWA splatting, Zwicker et al. 2002;
// Kerbl et al. 2023, eq. 5 and 6), and the vector-Jacobian product of this map.
//
//   Σ  = R S Sᵀ Rᵀ            3D covariance, R from the quaternion, S = diag(exp(log_scales))
//   Σ' = J W Σ Wᵀ Jᵀ + d I   2D covariance, W the rotation of cam_from_world, J the Jacobian of
//                            the pinhole projection at the mean; d = 0.3
//
// Σ' is computed as U Uᵀ + d I, with U = T M, T = J W (2×3) and M = R S (3×3), without the 3D
// covariance Σ.
//
// The dilation by d I makes a splat larger, and so small splats too prominent. If `antialiased`, the
// opacity is multiplied by ρ = √(det(U Uᵀ) / det Σ'), so that the integral of the splat does not
// change, and d = 0.1, which is about the area of a pixel (the 2D mip filter of Yu et al. 2024).
#pragma once

#include "params.h"
#include "rasterize.h"

namespace snow {

// Values derived from CameraParams, once per call (CPU) or per thread (CUDA).
template <class T>
struct PinholeCamera {
  T rotation[9], translation[3];  // cam_from_world
  T position[3];                  // camera centre in the world, -Rᵀ t
  T fx, fy, cx, cy, width, height, near;
  bool antialiased;
  T dilation;  // d
  // Limits of x/z and y/z, 15% outside of the image. J is evaluated with the clamped values,
  // because the linear approximation of the projection is unbounded farther outside.
  T min_tx, max_tx, min_ty, max_ty;

  // Real is the type in which the limits are computed: double on the CPU, T on a GPU, because there
  // every thread computes them.
  template <class Real>
  SNOW_INLINE PinholeCamera(const CameraParams<T>& c, Real)
      : width(T(c.width)), height(T(c.height)), near(T(c.near)), antialiased(c.antialiased != 0),
        dilation(T(c.antialiased ? kMipDilation : kDilation)) {
    const double* given = c.intrinsics;
    const Real focal_x(given ? given[0] : c.fx), focal_y(given ? given[1] : c.fy),
        centre_x(given ? given[2] : c.cx), centre_y(given ? given[3] : c.cy);
    fx = T(focal_x), fy = T(focal_y), cx = T(centre_x), cy = T(centre_y);
    for (int i = 0; i < 3; i++) {
      for (int j = 0; j < 3; j++) rotation[3 * i + j] = c.cam_from_world[4 * i + j];
      translation[i] = c.cam_from_world[4 * i + 3];
    }
    for (int k = 0; k < 3; k++) {
      position[k] = -(rotation[k] * translation[0] + rotation[3 + k] * translation[1] +
                      rotation[6 + k] * translation[2]);
    }
    const Real w(c.width), h(c.height);
    const Real beyond_x = Real(0.15) * w, beyond_y = Real(0.15) * h;
    min_tx = T(-(centre_x + beyond_x) / focal_x), max_tx = T((w - centre_x + beyond_x) / focal_x);
    min_ty = T(-(centre_y + beyond_y) / focal_y), max_ty = T((h - centre_y + beyond_y) / focal_y);
  }
};

template <class Real>
struct GaussianShape {  // the inputs of one Gaussian that affect its geometry
  Real mean[3], log_scale[3], quat[4], opacity_logit;
};

template <class Real>
struct ProjectedGaussian {
  Real x, y, z, inv_z;     // mean in the camera frame
  Real tx, ty;             // clamped x/z, y/z
  Real scale[3], quat[4];  // activated: exp, normalised
  Real inv_quat_norm;
  Real R[9], M[9], T[6], U[6];
  Real normal[3];  // U₀ × U₁, the cross product of the rows of U
  Real cov_xx, cov_xy, cov_yy, inv_det;
  Real undilated_det;  // det(U Uᵀ) = |U₀ × U₁|²
  Real mean2d[2], conic[3];
  Real activated_opacity, opacity;  // sigmoid(logit); of the splat
};

// Divides a quaternion by its length, and returns the inverse of the length. A zero quaternion stays
// zero; quat_to_rotation returns the identity for it.
template <class Real>
SNOW_INLINE Real normalise_quat(const Real* q, Real* unit) {
  const Real norm2 = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] + Real(1e-24f);
  const Real inverse = Real(1.f) / sqrt(norm2);
  for (int k = 0; k < 4; k++) unit[k] = q[k] * inverse;
  return inverse;
}

// Quaternion wxyz (unit) → rotation matrix, row-major.
template <class Real>
SNOW_INLINE void quat_to_rotation(const Real* q, Real* R) {
  const Real one(1.f), two(2.f);
  const Real w = q[0], x = q[1], y = q[2], z = q[3];
  R[0] = one - two * (y * y + z * z), R[1] = two * (x * y - w * z), R[2] = two * (x * z + w * y);
  R[3] = two * (x * y + w * z), R[4] = one - two * (x * x + z * z), R[5] = two * (y * z - w * x);
  R[6] = two * (x * z - w * y), R[7] = two * (y * z + w * x), R[8] = one - two * (x * x + y * y);
}

template <class Real>
SNOW_INLINE void quat_to_rotation_vjp(const Real* q, const Real* dR, Real* dq) {
  const Real two(2.f);
  const Real w = q[0], x = q[1], y = q[2], z = q[3];
  dq[0] = two * (x * (dR[7] - dR[5]) + y * (dR[2] - dR[6]) + z * (dR[3] - dR[1]));
  dq[1] = two * (y * (dR[1] + dR[3]) + z * (dR[2] + dR[6]) + w * (dR[7] - dR[5]) -
                 two * x * (dR[4] + dR[8]));
  dq[2] = two * (x * (dR[1] + dR[3]) + z * (dR[5] + dR[7]) + w * (dR[2] - dR[6]) -
                 two * y * (dR[0] + dR[8]));
  dq[3] = two * (x * (dR[2] + dR[6]) + y * (dR[5] + dR[7]) + w * (dR[3] - dR[1]) -
                 two * z * (dR[0] + dR[4]));
}

template <class Real, class T>
SNOW_INLINE void project_gaussian(const GaussianShape<Real>& g, const PinholeCamera<T>& cam,
                                  ProjectedGaussian<Real>& p) {
  const T* W = cam.rotation;
  const Real mx = g.mean[0], my = g.mean[1], mz = g.mean[2];
  p.x = Real(W[0]) * mx + Real(W[1]) * my + Real(W[2]) * mz + Real(cam.translation[0]);
  p.y = Real(W[3]) * mx + Real(W[4]) * my + Real(W[5]) * mz + Real(cam.translation[1]);
  p.z = Real(W[6]) * mx + Real(W[7]) * my + Real(W[8]) * mz + Real(cam.translation[2]);
  p.inv_z = Real(1.f) / p.z;

  p.inv_quat_norm = normalise_quat(g.quat, p.quat);
  quat_to_rotation(p.quat, p.R);
  for (int k = 0; k < 3; k++) p.scale[k] = exp(g.log_scale[k]);
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) p.M[3 * i + k] = p.R[3 * i + k] * p.scale[k];

  const Real u = p.x * p.inv_z, v = p.y * p.inv_z;
  p.tx = min(max(u, Real(cam.min_tx)), Real(cam.max_tx));
  p.ty = min(max(v, Real(cam.min_ty)), Real(cam.max_ty));
  const Real j00 = Real(cam.fx) * p.inv_z, j11 = Real(cam.fy) * p.inv_z;
  const Real j02 = -(j00 * p.tx), j12 = -(j11 * p.ty);
  for (int k = 0; k < 3; k++) {
    p.T[k] = j00 * Real(W[k]) + j02 * Real(W[6 + k]);
    p.T[3 + k] = j11 * Real(W[3 + k]) + j12 * Real(W[6 + k]);
  }
  for (int i = 0; i < 2; i++)
    for (int k = 0; k < 3; k++)
      p.U[3 * i + k] =
          p.T[3 * i] * p.M[k] + p.T[3 * i + 1] * p.M[3 + k] + p.T[3 * i + 2] * p.M[6 + k];
  const Real *U = p.U, dilation(cam.dilation);
  p.cov_xx = U[0] * U[0] + U[1] * U[1] + U[2] * U[2] + dilation;
  p.cov_xy = U[0] * U[3] + U[1] * U[4] + U[2] * U[5];
  p.cov_yy = U[3] * U[3] + U[4] * U[4] + U[5] * U[5] + dilation;
  // det Σ' = |U₀ × U₁|² + d (U₀·U₀ + U₁·U₁) + d². The formula xx·yy − xy² is inaccurate
  // for long thin splats: in float, its error is 19% at σ = 1000 pixels, and it gives NaN for larger
  // splats.
  Real* n = p.normal;
  n[0] = U[1] * U[5] - U[2] * U[4];
  n[1] = U[2] * U[3] - U[0] * U[5];
  n[2] = U[0] * U[4] - U[1] * U[3];
  p.undilated_det = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
  p.inv_det = Real(1.f) / (p.undilated_det + dilation * (p.cov_xx + p.cov_yy - dilation));
  p.conic[0] = p.cov_yy * p.inv_det;
  p.conic[1] = -(p.cov_xy * p.inv_det);
  p.conic[2] = p.cov_xx * p.inv_det;
  p.mean2d[0] = Real(cam.fx) * u + Real(cam.cx);
  p.mean2d[1] = Real(cam.fy) * v + Real(cam.cy);
  p.activated_opacity = Real(1.f) / (Real(1.f) + exp(-g.opacity_logit));
  p.opacity = p.activated_opacity;
  if (cam.antialiased) p.opacity = p.opacity * sqrt(p.undilated_det * p.inv_det);
}

template <class Real>
struct SplatGradient {  // with respect to the geometric columns of Splats2D
  Real mean2d[2], conic[3], opacity, depth;
};

template <class Real>
struct PoseGradient {  // with respect to cam_from_world and log f, from one Gaussian
  Real rotation[9], translation[3];
  Real log_focal;  // of fx and fy together
};

// `grad` receives the gradients of mean, log_scale, quat and opacity_logit. `pose` may be null.
template <class Real, class T>
SNOW_INLINE void project_gaussian_vjp(const GaussianShape<Real>& g, const PinholeCamera<T>& cam,
                                      const ProjectedGaussian<Real>& p,
                                      const SplatGradient<Real>& d, GaussianShape<Real>& grad,
                                      PoseGradient<Real>* pose) {
  const T* W = cam.rotation;
  const Real two(2.f), half(0.5f);
  grad.opacity_logit = d.opacity * p.opacity * (Real(1.f) - p.activated_opacity);

  // V = K U, where K = Σ'⁻¹ is the conic. It is computed from the identity
  // (v·v) u − (u·v) v = v × (u × v). The direct product K U is inaccurate for long thin splats, for
  // the same reason as the determinant above.
  const Real dilation(cam.dilation);
  const Real *U = p.U, *n = p.normal;
  Real X[6], V[6];  // X = det(U Uᵀ) (U Uᵀ)⁻¹ U
  for (int k = 0; k < 3; k++) {
    const int k1 = (k + 1) % 3, k2 = (k + 2) % 3;
    X[k] = U[3 + k1] * n[k2] - U[3 + k2] * n[k1];
    X[3 + k] = n[k1] * U[k2] - n[k2] * U[k1];
    V[k] = (dilation * U[k] + X[k]) * p.inv_det;
    V[3 + k] = (dilation * U[3 + k] + X[3 + k]) * p.inv_det;
  }

  // G is the symmetric matrix of the gradient of the conic; its off-diagonal element is half of
  // d.conic[1]. From Σ' = U Uᵀ + d I follow dΣ' = −K G K and dU = −2 K G V. Because U = T M and
  // M = R S, the gradient of log s_k is the dot product of the columns k of U and dU:
  // U_k·dU_k = −2 V_k·(G V_k).
  //
  // If antialiased, the opacity o' = o ρ depends on A = U Uᵀ: d ln ρ = ½ (A⁻¹ − K), as the gradient
  // of A, and A⁻¹ − K = d A⁻¹ K. With Y = A⁻¹ U, it adds o' d K Y to dU, and o' d V_k·Y_k to the
  // gradient of log s_k. So o' d Y is added to −2 G V. A visible splat has ρ ≥ 1/255.
  const Real a = p.conic[0], b = p.conic[1], c = p.conic[2];
  const Real ga = d.conic[0], gb = half * d.conic[1], gc = d.conic[2];
  Real dU[6], dM[9], dT[6];
  Real gain(0.f);  // of A⁻¹ U · det A
  if (cam.antialiased) gain = d.opacity * p.opacity * dilation / p.undilated_det;
  for (int k = 0; k < 3; k++) {
    Real g0 = -two * (ga * V[k] + gb * V[3 + k]), g1 = -two * (gb * V[k] + gc * V[3 + k]);
    if (cam.antialiased) g0 += gain * X[k], g1 += gain * X[3 + k];
    dU[k] = a * g0 + b * g1;
    dU[3 + k] = b * g0 + c * g1;
    grad.log_scale[k] = V[k] * g0 + V[3 + k] * g1;
  }
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) dM[3 * i + k] = p.T[i] * dU[k] + p.T[3 + i] * dU[3 + k];
  for (int i = 0; i < 2; i++)
    for (int k = 0; k < 3; k++)
      dT[3 * i + k] =
          dU[3 * i] * p.M[3 * k] + dU[3 * i + 1] * p.M[3 * k + 1] + dU[3 * i + 2] * p.M[3 * k + 2];

  // T = J W, J = [[fx/z, 0, −fx tx/z], [0, fy/z, −fy ty/z]].
  Real dj00(0.f), dj02(0.f), dj11(0.f), dj12(0.f);
  for (int k = 0; k < 3; k++) {
    dj00 += dT[k] * Real(W[k]), dj02 += dT[k] * Real(W[6 + k]);
    dj11 += dT[3 + k] * Real(W[3 + k]), dj12 += dT[3 + k] * Real(W[6 + k]);
  }
  const Real fx(cam.fx), fy(cam.fy), iz = p.inv_z;
  const Real u = p.x * iz, v = p.y * iz;
  const auto free_x = (u >= Real(cam.min_tx)) & (Real(cam.max_tx) >= u);
  const auto free_y = (v >= Real(cam.min_ty)) & (Real(cam.max_ty) >= v);
  // The derivatives with respect to u = x/z and v = y/z: through the 2D mean, and, if u and v are
  // not clamped, through J.
  const Real zero(0.f);
  const Real du = fx * d.mean2d[0] - select(free_x, dj02 * fx * iz, zero);
  const Real dv = fy * d.mean2d[1] - select(free_y, dj12 * fy * iz, zero);
  // The derivative with respect to 1/z at fixed u, v.
  const Real diz = dj00 * fx + dj11 * fy - dj02 * fx * p.tx - dj12 * fy * p.ty;
  const Real dx = du * iz, dy = dv * iz;
  const Real dz = d.depth - iz * (du * u + dv * v + diz * iz);
  for (int k = 0; k < 3; k++)
    grad.mean[k] = Real(W[k]) * dx + Real(W[3 + k]) * dy + Real(W[6 + k]) * dz;

  if (pose) {
    const Real dcam[3] = {dx, dy, dz};
    const Real j00 = fx * iz, j11 = fy * iz, j02 = -(j00 * p.tx), j12 = -(j11 * p.ty);
    for (int i = 0; i < 3; i++) {
      pose->translation[i] = dcam[i];
      for (int k = 0; k < 3; k++) pose->rotation[3 * i + k] = dcam[i] * g.mean[k];
    }
    for (int k = 0; k < 3; k++) {  // T = J W
      pose->rotation[k] += j00 * dT[k];
      pose->rotation[3 + k] += j11 * dT[3 + k];
      pose->rotation[6 + k] += j02 * dT[k] + j12 * dT[3 + k];
    }
    // f multiplies the offset of the mean from the principal point, and J. If u is clamped, f u is
    // constant, and so is this element of J.
    pose->log_focal = d.mean2d[0] * fx * u + d.mean2d[1] * fy * v + dj00 * j00 + dj11 * j11 +
                      select(free_x, dj02 * j02, zero) + select(free_y, dj12 * j12, zero);
  }

  // M = R S.
  Real dR[9], dq[4];
  for (int i = 0; i < 3; i++)
    for (int k = 0; k < 3; k++) dR[3 * i + k] = dM[3 * i + k] * p.scale[k];
  quat_to_rotation_vjp(p.quat, dR, dq);
  const Real radial = dq[0] * p.quat[0] + dq[1] * p.quat[1] + dq[2] * p.quat[2] + dq[3] * p.quat[3];
  for (int k = 0; k < 4; k++) grad.quat[k] = (dq[k] - radial * p.quat[k]) * p.inv_quat_norm;
}

// Whether the Gaussian is beyond the near plane, its opacity is at least 1/255, and the bounding
// box of the ellipse {α ≥ 1/255} overlaps the rectangle of the pixel centres. With non-finite
// values, one of these comparisons is false.
template <class Real, class T>
SNOW_INLINE auto is_visible(const ProjectedGaussian<Real>& p, const PinholeCamera<T>& c) {
  Real k2 = squared_cutoff(p.opacity);
  Real ex = sqrt(max(k2, Real(0.f)) * p.cov_xx), ey = sqrt(max(k2, Real(0.f)) * p.cov_yy);
  const Real half(0.5f);
  return (p.z > Real(c.near)) & (k2 >= Real(0.f)) & (p.inv_det > Real(0.f)) &
         (p.mean2d[0] + ex >= half) & (Real(c.width) - half >= p.mean2d[0] - ex) &
         (p.mean2d[1] + ey >= half) & (Real(c.height) - half >= p.mean2d[1] - ey);
}

// The columns of Splats2D before the colours.
template <class Real>
SNOW_INLINE void splat_header(const ProjectedGaussian<Real>& p, Real* column) {
  column[0] = p.mean2d[0], column[1] = p.mean2d[1];
  for (int k = 0; k < 3; k++) column[2 + k] = p.conic[k];
  column[5] = p.opacity, column[6] = p.z;
  // The larger eigenvalue of Σ' is mid + sqrt(dif² + cov_xy²).
  Real mid = Real(0.5f) * (p.cov_xx + p.cov_yy), dif = Real(0.5f) * (p.cov_xx - p.cov_yy);
  dif = dif / mid;  // relative to mid, because the squares could overflow
  Real off = p.cov_xy / mid;
  column[7] = Real(3.f) * sqrt(mid + mid * sqrt(dif * dif + off * off));
}

}  // namespace snow
