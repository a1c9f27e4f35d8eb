// project: which Gaussians a camera sees (project_cull), their 2D splats (project_fwd), and the
// gradient of the splats carried to the parameters and the pose (project_bwd). Unlike on the CPU
// nothing is compacted: ids[i] is i, or −1 where a Gaussian is not seen, and its row is empty.
#include "cuda/gaussian_row.h"

namespace snow {
namespace {

constexpr int kPose = 15;  // sums: 9 (rotation) + 3 (translation) + 3 (the camera's centre)

template <class T>
SNOW_INLINE void cull(int64_t n, const GaussianTensors<T>& tensors, const PinholeCamera<T>& cam,
                      int32_t* ids) {
  const int64_t i = thread_index();
  if (i >= n) return;
  GaussianShape<T> g;
  load_shape(tensors, i, g);
  ProjectedGaussian<T> projected;
  project_gaussian(g, cam, projected);
  ids[i] = is_visible(projected, cam) ? int32_t(i) : -1;
}

// The ids of the block's splats and a last one of none; this thread's own is returned.
SNOW_INLINE int32_t load_ids(int64_t m, const int32_t* ids, int32_t* of_block) {
  const int64_t i = thread_index();
  const int32_t own = i < m ? ids[i] : -1;
  of_block[threadIdx.x] = own;
  if (threadIdx.x == 0) of_block[kRowThreads] = -1;
  __syncthreads();
  return own;
}

template <class T>
SNOW_INLINE void forward(int64_t m, const int32_t* ids, const GaussianTensors<T>& tensors,
                         int degree, const PinholeCamera<T>& cam, T* packed) {
  constexpr int kStride = kRestColumns;
  SNOW_SHARED(T, tile, kRowThreads * kStride);
  SNOW_SHARED(int32_t, id_of, kRowThreads + 1);
  const int64_t id = load_ids(m, ids, id_of);
  load_rest<kStride>(tensors, degree, id_of, tile);
  __syncthreads();

  T* row = tile + int(threadIdx.x) * kStride;
  T column[kPackedStride] = {};
  if (id >= 0) {
    GaussianShape<T> g;
    load_shape(tensors, id, g);
    T dc[3], *color = column + kPackedHeader;
    for (int k = 0; k < 3; k++) dc[k] = tensors.sh_dc[3 * id + k];
    with_degree(degree, [&](auto constant) {
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
  packed += first * kPackedStride;
  for_each_number<kPackedStride>(kPackedStride, [&](const int* r, const int* c) {
    for (int j = 0; j < kPackedStride; j++)
      if (first + r[j] < m) packed[r[j] * kPackedStride + c[j]] = tile[r[j] * kStride + c[j]];
  });
}

template <class T>
struct GaussianGradients {
  T *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
};

// Columns of a tile → rows `ids` of a tensor.
template <int kBatch, class T>
SNOW_INLINE void store_columns(const T* tile, int columns, const int32_t* ids, int64_t stride,
                               T* tensor) {
  for_each_number<kBatch>(columns, [&](const int* row, const int* column) {
    for (int j = 0; j < kBatch; j++) {
      const int32_t id = ids[row[j]];
      if (id >= 0) tensor[id * stride + column[j]] = tile[row[j] * kRowColumns + column[j]];
    }
  });
}

// pose: kPose sums of each block, or null.
template <class T>
SNOW_INLINE void backward(int64_t m, const int32_t* ids, const GaussianTensors<T>& tensors,
                          int degree, const PinholeCamera<T>& cam, const T* grad_packed,
                          const GaussianGradients<T>& grads, double* pose) {
  SNOW_SHARED(T, tile, kRowThreads * kRowColumns);
  SNOW_SHARED(int32_t, id_of, kRowThreads + 1);
  const int64_t id = load_ids(m, ids, id_of);
  load_rest<kRowColumns>(tensors, degree, id_of, tile);
  __syncthreads();

  T* row = tile + int(threadIdx.x) * kRowColumns;
  PoseGradient<T> d_pose = {};
  T d_position[3] = {};
  if (id >= 0) {
    const T* grad_splat = grad_packed + thread_index() * kPackedStride;
    row_vjp(tensors, id, degree, cam, grad_splat, row, d_pose, d_position);
  }
  __syncthreads();
  store_columns<3>(tile + kMeanColumn, 3, id_of, 3, grads.means);
  store_columns<3>(tile + kLogScaleColumn, 3, id_of, 3, grads.log_scales);
  store_columns<4>(tile + kQuatColumn, 4, id_of, 4, grads.quats);
  store_columns<1>(tile + kLogitColumn, 1, id_of, 1, grads.opacity_logits);
  store_columns<3>(tile + kDcColumn, 3, id_of, 3, grads.sh_dc);
  if (degree > 0)
    store_columns<kRestBatch>(tile, sh_columns(degree), id_of, 3 * tensors.sh_rest_rows,
                              grads.sh_rest);
  if (!pose) return;

  // In double and in a fixed order: a quarter of the rows a thread, then the quarters.
  __syncthreads();
  for (int k = 0; k < 9; k++) row[k] = d_pose.rotation[k];
  for (int k = 0; k < 3; k++) row[9 + k] = d_pose.translation[k];
  for (int k = 0; k < 3; k++) row[12 + k] = d_position[k];
  __syncthreads();
  constexpr int kParts = kRowThreads / 16, kPartRows = kRowThreads / kParts;
  SNOW_SHARED(double, parts, kRowThreads);
  const int column = int(threadIdx.x) % 16, part = int(threadIdx.x) / 16;
  double sum = 0;
  if (column < kPose)
    for (int r = 0; r < kPartRows; r++)
      sum += double(tile[(part * kPartRows + r) * kRowColumns + column]);
  parts[threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.x < kPose) {
    for (int k = 1; k < kParts; k++) sum += parts[16 * k + int(threadIdx.x)];
    pose[int64_t(blockIdx.x) * kPose + threadIdx.x] = sum;
  }
}

constexpr int kSumThreads = 512;

}  // namespace
}  // namespace snow

using namespace snow;

#define SNOW_PROJECT_KERNELS(SUFFIX, T)                                                            \
  SNOW_KERNEL(project_cull##SUFFIX, 256,                                                           \
              (int64_t n, const T* means, const T* log_scales, const T* quats,                     \
               const T* opacity_logits, const T* cam_from_world, double width, double height,      \
               double fx, double fy, double cx, double cy, double near, int32_t* ids)) {           \
    cull<T>(n, {means, log_scales, quats, opacity_logits, nullptr, nullptr, 0},                    \
            {cam_from_world, T(width), T(height), T(fx), T(fy), T(cx), T(cy), T(near)}, ids);      \
  }                                                                                                \
  SNOW_KERNEL(project_fwd##SUFFIX, kRowThreads,                                                    \
              (int64_t m, const int32_t* ids, const T* means, const T* log_scales, const T* quats, \
               const T* opacity_logits, const T* sh_dc, const T* sh_rest, int64_t sh_rest_rows,    \
               int64_t degree, const T* cam_from_world, double width, double height, double fx,    \
               double fy, double cx, double cy, double near, T* packed)) {                         \
    forward<T>(m, ids, {means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_rest_rows},   \
               int(degree),                                                                        \
               {cam_from_world, T(width), T(height), T(fx), T(fy), T(cx), T(cy), T(near)},         \
               packed);                                                                            \
  }                                                                                                \
  SNOW_KERNEL(                                                                                     \
      project_bwd##SUFFIX, kRowThreads,                                                            \
      (int64_t m, const int32_t* ids, const T* means, const T* log_scales, const T* quats,         \
       const T* opacity_logits, const T* sh_dc, const T* sh_rest, int64_t sh_rest_rows,            \
       int64_t degree, const T* cam_from_world, double width, double height, double fx, double fy, \
       double cx, double cy, double near, const T* grad_packed, T* d_means, T* d_log_scales,       \
       T* d_quats, T* d_opacity_logits, T* d_sh_dc, T* d_sh_rest, double* pose)) {                 \
    backward<T>(m, ids, {means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_rest_rows},  \
                int(degree),                                                                       \
                {cam_from_world, T(width), T(height), T(fx), T(fy), T(cx), T(cy), T(near)},        \
                grad_packed,                                                                       \
                {d_means, d_log_scales, d_quats, d_opacity_logits, d_sh_dc, d_sh_rest}, pose);     \
  }

SNOW_PROJECT_KERNELS(, float)
SNOW_PROJECT_KERNELS(_f64, double)

// The sums of the blocks of project_bwd, in a fixed order. One block.
SNOW_KERNEL(project_pose_sum, kSumThreads, (int64_t blocks, const double* sums, double* pose)) {
  SNOW_SHARED(double, parts, kSumThreads);
  const int column = int(threadIdx.x) % 16;
  double sum = 0;
  if (column < kPose)
    for (int64_t b = int(threadIdx.x) / 16; b < blocks; b += kSumThreads / 16)
      sum += sums[b * kPose + column];
  parts[threadIdx.x] = sum;
  __syncthreads();
  if (threadIdx.x < kPose) {
    for (int k = 1; k < kSumThreads / 16; k++) sum += parts[16 * k + int(threadIdx.x)];
    pose[threadIdx.x] = sum;
  }
}
