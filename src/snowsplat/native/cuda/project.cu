// project: the Gaussians that a camera sees (project_cull), their 2D splats (project_fwd), and the
// gradients of the parameters and the pose from the gradients of the splats (project_bwd). Unlike
// on the CPU, rows are not compacted: ids[i] is i, or −1 if Gaussian i is not visible. The row of a
// Gaussian that is not visible is empty.
#include "cuda/gaussian_row.h"

namespace snow {
namespace {

// Adds the sums of the blocks of project_bwd, in a fixed order. One block.
struct PoseSumParams {
  int64_t n;           // blocks of project_bwd
  const double* sums;  // (n, 16)
  double* pose;        // out, (16,)
  SNOW_FIELDS(n, sums, pose)
};

template <class T>
SNOW_INLINE void cull(const ProjectCullParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n) return;
  const PinholeCamera<T> cam(p.camera, T());
  GaussianShape<T> g;
  load_shape(p.gaussians, i, g);
  ProjectedGaussian<T> projected;
  project_gaussian(g, cam, projected);
  p.ids[i] = is_visible(projected, cam) ? int32_t(i) : -1;
}

// Loads the ids of the block's splats, followed by −1, and returns the id of this thread's splat.
SNOW_INLINE int32_t load_ids(int64_t m, const int32_t* ids, int32_t* of_block) {
  const int64_t i = thread_index();
  const int32_t own = i < m ? ids[i] : -1;
  of_block[threadIdx.x] = own;
  if (threadIdx.x == 0) of_block[kRowThreads] = -1;
  __syncthreads();
  return own;
}

template <class T>
SNOW_INLINE void forward(const ProjectForwardParams<T>& p) {
  constexpr int kStride = kRestColumns;
  const GaussianTensors<T>& tensors = p.gaussians;
  SNOW_SHARED(T, tile, kRowThreads * kStride);
  SNOW_SHARED(int32_t, id_of, kRowThreads + 1);
  const int64_t id = load_ids(p.n, p.ids, id_of);
  load_rest<kStride>(tensors, id_of, tile);
  __syncthreads();

  T* row = tile + int(threadIdx.x) * kStride;
  T column[kPackedStride] = {};
  if (id >= 0) {
    const PinholeCamera<T> cam(p.camera, T());
    GaussianShape<T> g;
    load_shape(tensors, id, g);
    T dc[3], *color = column + kPackedHeader;
    for (int k = 0; k < 3; k++) dc[k] = tensors.sh_dc[3 * tensors.sh_dc_rows * id + k];
    with_degree(int(tensors.sh_degree), [&](auto constant) {
      sh_color(constant.value, view_direction(g.mean, cam.position), dc, row, color);
    });
    for (int k = 0; k < 3; k++) color[k] = max(color[k], T(0));
    ProjectedGaussian<T> projected;
    project_gaussian(g, cam, projected);
    splat_header(projected, column);
  }
  for (int k = 0; k < kPackedStride; k++) row[k] = column[k];
  __syncthreads();

  const int64_t first = int64_t(blockIdx.x) * kRowThreads;
  T* const packed = p.packed + first * kPackedStride;
  for_each_number<kPackedStride>(kPackedStride, [&](const int* r, const int* c) {
    for (int j = 0; j < kPackedStride; j++)
      if (first + r[j] < p.n) packed[r[j] * kPackedStride + c[j]] = tile[r[j] * kStride + c[j]];
  });
}

// Adds columns of a tile to the rows `ids` of a tensor.
template <int kBatch, class T>
SNOW_INLINE void add_columns(const T* tile, int columns, const int32_t* ids, int64_t stride,
                             T* tensor) {
  for_each_number<kBatch>(columns, [&](const int* row, const int* column) {
    for (int j = 0; j < kBatch; j++) {
      const int32_t id = ids[row[j]];
      if (id >= 0) tensor[id * stride + column[j]] += tile[row[j] * kRowColumns + column[j]];
    }
  });
}

// p.pose: kPoseSums sums of each block, or null.
template <class T>
SNOW_INLINE void backward(const ProjectBackwardParams<T>& p) {
  const GaussianTensors<T>& tensors = p.gaussians;
  const GaussianGradients<T>& grads = p.grads;
  const int degree = int(tensors.sh_degree);
  SNOW_SHARED(T, tile, kRowThreads * kRowColumns);
  SNOW_SHARED(int32_t, id_of, kRowThreads + 1);
  const int64_t id = load_ids(p.n, p.ids, id_of);
  load_rest<kRowColumns>(tensors, id_of, tile);
  __syncthreads();

  T* row = tile + int(threadIdx.x) * kRowColumns;
  PoseGradient<T> d_pose = {};
  T d_position[3] = {};
  if (id >= 0) {
    const PinholeCamera<T> cam(p.camera, T());
    const T* grad_splat = p.grad_packed + thread_index() * kPackedStride;
    row_vjp(tensors, id, cam, grad_splat, row, d_pose, d_position);
  }
  __syncthreads();
  if (grads.means) {
    add_columns<3>(tile + kMeanColumn, 3, id_of, 3, grads.means);
    add_columns<3>(tile + kLogScaleColumn, 3, id_of, 3, grads.log_scales);
    add_columns<4>(tile + kQuatColumn, 4, id_of, 4, grads.quats);
    add_columns<1>(tile + kLogitColumn, 1, id_of, 1, grads.opacity_logits);
    add_columns<3>(tile + kDcColumn, 3, id_of, 3 * tensors.sh_dc_rows, grads.sh_dc);
    if (degree > 0)
      add_columns<kRestBatch>(tile, sh_columns(degree), id_of, 3 * tensors.sh_rest_rows,
                              grads.sh_rest);
  }
  if (!p.pose) return;

  // The sums are computed in double and in a fixed order: each thread sums a quarter of the rows,
  // then the quarters are added.
  __syncthreads();
  for (int k = 0; k < 9; k++) row[k] = d_pose.rotation[k];
  for (int k = 0; k < 3; k++) row[9 + k] = d_pose.translation[k];
  for (int k = 0; k < 3; k++) row[12 + k] = d_position[k];
  row[15] = d_pose.log_focal;
  __syncthreads();
  constexpr int kParts = kRowThreads / kPoseSums, kPartRows = kRowThreads / kParts;
  SNOW_SHARED(double, parts, kRowThreads);
  const int column = int(threadIdx.x) % kPoseSums, part = int(threadIdx.x) / kPoseSums;
  double sum = 0;
  for (int r = 0; r < kPartRows; r++) {
    const double term = double(tile[(part * kPartRows + r) * kRowColumns + column]);
    sum += (term + p.rounding) - p.rounding;
  }
  parts[threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.x < kPoseSums) {
    for (int k = 1; k < kParts; k++) sum += parts[kPoseSums * k + int(threadIdx.x)];
    p.pose[int64_t(blockIdx.x) * kPoseSums + threadIdx.x] = sum;
  }
}

constexpr int kSumThreads = 512;

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(project_cull, 256, ProjectCullParams<float>) { cull(p); }
SNOW_KERNEL(project_cull_f64, 256, ProjectCullParams<double>) { cull(p); }
SNOW_KERNEL(project_fwd, kRowThreads, ProjectForwardParams<float>) { forward(p); }
SNOW_KERNEL(project_fwd_f64, kRowThreads, ProjectForwardParams<double>) { forward(p); }
SNOW_KERNEL(project_bwd, kRowThreads, ProjectBackwardParams<float>) { backward(p); }
SNOW_KERNEL(project_bwd_f64, kRowThreads, ProjectBackwardParams<double>) { backward(p); }

SNOW_KERNEL(project_pose_sum, kSumThreads, PoseSumParams) {
  SNOW_SHARED(double, parts, kSumThreads);
  const int column = int(threadIdx.x) % kPoseSums;
  double sum = 0;
  for (int64_t b = int(threadIdx.x) / kPoseSums; b < p.n; b += kSumThreads / kPoseSums)
    sum += p.sums[b * kPoseSums + column];
  parts[threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.x < kPoseSums) {
    for (int k = 1; k < kSumThreads / kPoseSums; k++)
      sum += parts[kPoseSums * k + int(threadIdx.x)];
    p.pose[threadIdx.x] = sum;
  }
}
