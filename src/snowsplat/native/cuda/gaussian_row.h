// Rows of parameters in a block of threads. A block processes as many Gaussians as it has threads;
// each thread computes one Gaussian. Loads and stores are cooperative. The rows of a block are
// contiguous in a tensor, and all threads copy them together, so that neighbouring threads access
// neighbouring addresses. The copy in shared memory is called a tile. Its stride is odd, so that
// threads that access the same column use different banks.
#pragma once

#include "cuda/device.h"
#include "projection.h"
#include "sh.h"

namespace snow {

constexpr int kRowThreads = 64;
constexpr int kRestColumns = 3 * (kMaxShCoefficients - 1);

// The columns of a tile, for parameters or their gradients: sh_rest, then the others.
constexpr int kMeanColumn = kRestColumns;
constexpr int kLogScaleColumn = kMeanColumn + 3;
constexpr int kQuatColumn = kLogScaleColumn + 3;
constexpr int kLogitColumn = kQuatColumn + 4;
constexpr int kDcColumn = kLogitColumn + 1;
constexpr int kRowColumns = kDcColumn + 3;

// Calls f(row, column) for `columns` (> 0) columns of the block's rows, in batches of kBatch, so
// that loads do not wait for each other. Row kRowThreads stands for no row.
template <int kBatch, class F>
SNOW_INLINE void for_each_number(int columns, const F& f) {
  const int rows_a_step = kRowThreads / columns, columns_a_step = kRowThreads % columns;
  int row = int(threadIdx.x) / columns, column = int(threadIdx.x) % columns;
  for (int i = 0; i < columns; i += kBatch) {
    int rows[kBatch], at[kBatch];
    for (int j = 0; j < kBatch; j++) {
      rows[j] = i + j < columns ? row : kRowThreads, at[j] = column;
      row += rows_a_step, column += columns_a_step;
      if (column >= columns) column -= columns, row++;
    }
    f(rows, at);
  }
}

constexpr int kRestBatch = 8;  // kBatch for sh_rest

// Calls f with the degree as a compile-time constant. The loops over coefficients are then
// unrolled, and the arrays that they index stay in registers.
template <int kValue>
struct Constant {
  static constexpr int value = kValue;
};
template <class F>
SNOW_INLINE void with_degree(int degree, const F& f) {
  switch (degree) {
    case 0: f(Constant<0>{}); break;
    case 1: f(Constant<1>{}); break;
    case 2: f(Constant<2>{}); break;
    default: f(Constant<3>{}); break;
  }
}

// Loads the active columns of sh_rest into the tile. ids: the Gaussian of each of the kRowThreads +
// 1 rows, or −1 for none.
template <int kStride, class T>
SNOW_INLINE void load_rest(const GaussianTensors<T>& tensors, const int32_t* ids, T* tile) {
  const int degree = int(tensors.sh_degree);
  if (degree == 0) return;
  const int64_t stride = 3 * tensors.sh_rest_rows;
  for_each_number<kRestBatch>(sh_columns(degree), [&](const int* row, const int* column) {
    T value[kRestBatch];
    for (int j = 0; j < kRestBatch; j++) {
      const int32_t id = ids[row[j]];
      value[j] = id >= 0 ? tensors.sh_rest[id * stride + column[j]] : T(0);
    }
    for (int j = 0; j < kRestBatch; j++)
      if (ids[row[j]] >= 0) tile[row[j] * kStride + column[j]] = value[j];
  });
}

template <class T>
SNOW_INLINE void load_shape(const GaussianTensors<T>& tensors, int64_t id, GaussianShape<T>& g) {
  for (int k = 0; k < 3; k++) g.mean[k] = tensors.means[3 * id + k];
  for (int k = 0; k < 3; k++) g.log_scale[k] = tensors.log_scales[3 * id + k];
  for (int k = 0; k < 4; k++) g.quat[k] = tensors.quats[4 * id + k];
  g.opacity_logit = tensors.opacity_logits[id];
}

// Computes the gradients of the parameters of a Gaussian from the gradient of its splat, a row of
// 16 numbers. `row` is the row of the tile: it contains sh_rest before the call, and the gradients
// after it. `position` receives the gradient of the camera's position.
template <class T>
SNOW_INLINE void row_vjp(const GaussianTensors<T>& tensors, int64_t id, const PinholeCamera<T>& cam,
                         const T* grad_splat, T* row, PoseGradient<T>& pose, T* position) {
  GaussianShape<T> g, d;
  load_shape(tensors, id, g);
  const SplatGradient<T> d_splat = {{grad_splat[0], grad_splat[1]},
                                    {grad_splat[2], grad_splat[3], grad_splat[4]},
                                    grad_splat[5],
                                    grad_splat[6]};
  T dc[3], d_color[3], d_mean[3];
  for (int k = 0; k < 3; k++) dc[k] = tensors.sh_dc[3 * tensors.sh_dc_rows * id + k];
  for (int k = 0; k < 3; k++) d_color[k] = grad_splat[kPackedHeader + k];
  with_degree(int(tensors.sh_degree), [&](auto constant) {
    sh_color_vjp(constant.value, view_direction(g.mean, cam.position), dc, row, d_color,
                 row + kDcColumn, row, d_mean);
  });
  ProjectedGaussian<T> projected;
  project_gaussian(g, cam, projected);
  project_gaussian_vjp(g, cam, projected, d_splat, d, &pose);
  for (int k = 0; k < 3; k++) {
    row[kMeanColumn + k] = d.mean[k] + d_mean[k];
    row[kLogScaleColumn + k] = d.log_scale[k];
    position[k] = -d_mean[k];
  }
  for (int k = 0; k < 4; k++) row[kQuatColumn + k] = d.quat[k];
  row[kLogitColumn] = d.opacity_logit;
}

}  // namespace snow
