// W Gaussians at a time, a Gaussian a lane: reading their parameters from row-major tensors, and
// carrying the gradient of their splats back to those parameters. Shared by project_bwd (which
// writes the gradients) and adam_step (which uses them up at once).
#pragma once

#include "projection.h"
#include "sh.h"
#include "simd.h"

namespace snow {

constexpr int kPackedHeader = 8;   // columns of Splats2D before the colours, see ops/splats.py
constexpr int kPackedStride = 16;  // columns of Splats2D with 3 colours

template <class T>
struct GaussianTensors {  // (N, 3), (N, 3), (N, 4), (N,), (N, 1, 3), (N, K, 3)
  const T *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
  int64_t sh_rest_rows;  // K as stored; `degree` says how many of them are active
};

// Rows of the W Gaussians of a group. A last, shorter group repeats its final row in the idle
// lanes.
template <int W>
struct RowIndex {
  int64_t row[W];
  int count;

  SNOW_INLINE static RowIndex of(const int32_t* ids, int64_t first, int64_t end) {
    RowIndex r;
    r.count = end - first < W ? int(end - first) : W;
    for (int l = 0; l < W; l++) {
      int64_t i = first + (l < r.count ? l : r.count - 1);
      r.row[l] = ids ? ids[i] : i;
    }
    return r;
  }
  template <class P>
  SNOW_INLINE void pointers(P* base, int64_t stride, P** out) const {
    for (int l = 0; l < W; l++) out[l] = base + row[l] * stride;
  }
};

template <class V>
struct GaussianGroup {
  static constexpr int W = V::width;
  using T = typename V::Scalar;
  RowIndex<W> rows;
  GaussianShape<V> shape;
  V dc[3], rest[3 * (kMaxShCoefficients - 1) + 1];

  SNOW_INLINE void load_shape(const GaussianTensors<T>& g) {
    const T* p[W];
    rows.pointers(g.means, 3, p), gather_rows<3>(p, shape.mean);
    rows.pointers(g.log_scales, 3, p), gather_rows<3>(p, shape.log_scale);
    rows.pointers(g.quats, 4, p), gather_rows<4>(p, shape.quat);
    rows.pointers(g.opacity_logits, 1, p), gather_rows<1>(p, &shape.opacity_logit);
  }
  SNOW_INLINE void load_sh(const GaussianTensors<T>& g, int degree) {
    const T* p[W];
    rows.pointers(g.sh_dc, 3, p), gather_rows<3>(p, dc);
    if (degree > 0) {
      rows.pointers(g.sh_rest, 3 * g.sh_rest_rows, p);
      gather_rows_n(p, 3 * ((degree + 1) * (degree + 1) - 1), rest);
    }
  }
};

template <class V>
struct GaussianGroupGradient {
  GaussianShape<V> shape;
  V dc[3], rest[3 * (kMaxShCoefficients - 1) + 1];
};

// grad_packed rows [first, first + W) of the splats → gradients of the group's parameters.
// `pose` and `position` (gradient of the camera's centre, through the view directions) may be null.
template <class V, class T = typename V::Scalar>
SNOW_INLINE void group_vjp(const GaussianGroup<V>& g, const PinholeCamera<T>& cam, int degree,
                           const T* grad_packed, int64_t first, int64_t end,
                           GaussianGroupGradient<V>& out, PoseGradient<V>* pose, V* position) {
  const T* p[V::width];
  RowIndex<V::width>::of(nullptr, first, end).pointers(grad_packed, kPackedStride, p);
  V column[12], d_mean[3];
  gather_rows<12>(p, column);
  const SplatGradient<V> d = {
      {column[0], column[1]}, {column[2], column[3], column[4]}, column[5], column[6]};
  ProjectedGaussian<V> projected;
  project_gaussian(g.shape, cam, projected);
  project_gaussian_vjp(g.shape, cam, projected, d, out.shape, pose);
  sh_color_vjp(degree, view_direction(g.shape.mean, cam.position), g.dc, g.rest,
               column + kPackedHeader, out.dc, out.rest, d_mean);
  for (int k = 0; k < 3; k++) {
    out.shape.mean[k] += d_mean[k];
    if (position) position[k] = -d_mean[k];
  }
}

}  // namespace snow
