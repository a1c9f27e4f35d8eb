// Groups of W Gaussians, one per SIMD lane. Loads their parameters from row-major tensors, and
// computes the gradients of the parameters from the gradients of the splats. project_bwd writes the
// gradients of the parameters; adam_step applies them immediately.
#pragma once

#include "projection.h"
#include "sh.h"
#include "simd.h"

namespace snow {

// The rows of the W Gaussians of a group. If the last group is shorter, the remaining lanes repeat
// its last row.
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
  static RowIndex contiguous(int64_t first, int64_t end) { return of(nullptr, first, end); }
};

template <class V>
struct GaussianGroup {
  static constexpr int W = V::width;
  using T = typename V::Scalar;
  RowIndex<W> rows;
  GaussianShape<V> shape;
  V dc[3], rest[3 * (kMaxShCoefficients - 1) + 1];

  SNOW_INLINE void load_position(const GaussianTensors<T>& g) {
    gather_rows(g.means, 3, rows.row, 3, shape.mean);
    gather_rows(g.log_scales, 3, rows.row, 3, shape.log_scale);
  }
  SNOW_INLINE void load_orientation(const GaussianTensors<T>& g) {
    gather_rows(g.quats, 4, rows.row, 4, shape.quat);
    gather_rows(g.opacity_logits, 1, rows.row, 1, &shape.opacity_logit);
  }
  SNOW_INLINE void load(const GaussianTensors<T>& g) {
    load_position(g), load_orientation(g);
    gather_rows(g.sh_dc, 3 * g.sh_dc_rows, rows.row, 3, dc);
    gather_rows(g.sh_rest, 3 * g.sh_rest_rows, rows.row, sh_columns(int(g.sh_degree)), rest);
  }
};

// The hardware prefetcher does not predict the next visible row, because the gaps between them
// vary.
template <class T>
SNOW_INLINE void prefetch_row(const GaussianTensors<T>& g, int64_t row) {
  prefetch(g.means + 3 * row), prefetch(g.log_scales + 3 * row), prefetch(g.quats + 4 * row);
  prefetch(g.opacity_logits + row), prefetch(g.sh_dc + 3 * g.sh_dc_rows * row);
  const T* rest = g.sh_rest + 3 * g.sh_rest_rows * row;
  for (int c = 0; c < sh_columns(int(g.sh_degree)); c += 16) prefetch(rest + c);
}

template <class V>
struct GaussianGroupGradient {
  GaussianShape<V> shape;
  V dc[3], rest[3 * (kMaxShCoefficients - 1) + 1];
};

// Computes the gradients of a group's parameters from the rows [first, first + W) of grad_packed.
// `position` receives the gradient of the camera's centre through the view directions. `pose` and
// `position` may be null.
template <class V, class T = typename V::Scalar>
SNOW_INLINE void group_vjp(const GaussianGroup<V>& g, const PinholeCamera<T>& cam, int degree,
                           const T* grad_packed, int64_t first, int64_t end,
                           GaussianGroupGradient<V>& out, PoseGradient<V>* pose, V* position) {
  V column[12], d_mean[3];
  const auto splats = RowIndex<V::width>::contiguous(first, end);
  gather_rows(grad_packed, kPackedStride, splats.row, 12, column);
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
