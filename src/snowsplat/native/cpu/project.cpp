// project: which Gaussians a camera sees (project_cull), their 2D splats (project_fwd), and the
// gradient of the splats carried to the parameters and the pose (project_bwd).
#include <cstring>
#include <vector>

#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 2048;  // Gaussians a task; fixed, so that nothing depends on the threads

// Bound on the half extents of the splat from its largest scale alone: λmax(Σ) = s², so
// Σ'xx ≤ |J_x|² s² + 0.3 with |J_x|² = (fx/z)² (1 + tx²). Cheap, and never too small.
template <class V, class T>
SNOW_INLINE typename V::Mask may_touch_image(const GaussianShape<V>& g, const PinholeCamera<T>& c) {
  const T* W = c.rotation;
  const V *m = g.mean, *s = g.log_scale;
  V x = V(W[0]) * m[0] + V(W[1]) * m[1] + V(W[2]) * m[2] + V(c.translation[0]);
  V y = V(W[3]) * m[0] + V(W[4]) * m[1] + V(W[5]) * m[2] + V(c.translation[1]);
  V z = V(W[6]) * m[0] + V(W[7]) * m[1] + V(W[8]) * m[2] + V(c.translation[2]);
  V iz = V(1.f) / z, u = x * iz, v = y * iz;
  V tx = min(max(u, V(c.min_tx)), V(c.max_tx)), ty = min(max(v, V(c.min_ty)), V(c.max_ty));
  V scale = exp(max(max(s[0], s[1]), s[2])) * iz;
  const V k2(T(2.02 * kLn255));
  V wx = V(c.fx) * scale, wy = V(c.fy) * scale;
  V ex = sqrt(k2 * (wx * wx * (V(1.f) + tx * tx) + V(0.31f)));
  V ey = sqrt(k2 * (wy * wy * (V(1.f) + ty * ty) + V(0.31f)));
  V px = V(c.fx) * u + V(c.cx), py = V(c.fy) * v + V(c.cy);
  return (z > V(c.near)) & (px + ex >= V(0.f)) & (V(c.width) >= px - ex) & (py + ey >= V(0.f)) &
         (V(c.height) >= py - ey);
}

template <class V, class T = typename V::Scalar>
int64_t cull(int64_t n, const GaussianTensors<T>& tensors, const PinholeCamera<T>& cam,
             int32_t* ids) {
  constexpr int W = V::width;
  const int64_t blocks = (n + kBlock - 1) / kBlock;
  std::vector<int32_t> found(size_t(blocks), 0);
  parallel_for(blocks, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < n ? begin + kBlock : n;
    int32_t* out = ids + begin;
    for (int64_t i = begin; i < end; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::contiguous(i, end);
      g.load_position(tensors);
      if (!V::bits(may_touch_image(g.shape, cam))) continue;
      g.load_orientation(tensors);
      ProjectedGaussian<V> projected;
      project_gaussian(g.shape, cam, projected);
      uint32_t bits = V::bits(is_visible(projected, cam) & V::first(g.rows.count));
      for (; bits; bits &= bits - 1) *out++ = int32_t(i + __builtin_ctz(bits));
    }
    found[size_t(block)] = int32_t(out - (ids + begin));
  });
  int64_t total = 0;
  for (int64_t b = 0; b < blocks; b++) {
    std::memmove(ids + total, ids + b * kBlock, sizeof(int32_t) * size_t(found[size_t(b)]));
    total += found[size_t(b)];
  }
  return total;
}

template <class V, class T = typename V::Scalar>
void forward(int64_t m, const int32_t* ids, const GaussianTensors<T>& tensors, int degree,
             const PinholeCamera<T>& cam, T* packed) {
  constexpr int W = V::width;
  parallel_for((m + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < m ? begin + kBlock : m;
    for (int64_t i = begin; i < end; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::of(ids, i, end);
      g.load(tensors, degree);
      ProjectedGaussian<V> p;
      project_gaussian(g.shape, cam, p);
      V column[kPackedStride], *color = column + kPackedHeader;
      sh_color(degree, view_direction(g.shape.mean, cam.position), g.dc, g.rest, color);
      splat_header(p, column);
      for (int k = 0; k < 3; k++) color[k] = max(color[k], V(0.f));
      for (int k = kPackedHeader + 3; k < kPackedStride; k++) column[k] = V(0.f);
      const auto splats = RowIndex<W>::contiguous(i, end);
      scatter_rows(packed, kPackedStride, splats.row, splats.count, kPackedStride, column);
    }
  });
}

template <class T>
struct GaussianGradients {
  T *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
};

// pose: per block 9 (rotation) + 3 (translation) + 3 (camera position) sums, or null.
template <class V, class T = typename V::Scalar>
void backward(int64_t m, const int32_t* ids, const GaussianTensors<T>& tensors, int degree,
              const PinholeCamera<T>& cam, const T* grad_packed, const GaussianGradients<T>& grads,
              double* pose) {
  constexpr int W = V::width;
  parallel_for((m + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < m ? begin + kBlock : m;
    double sums[15] = {0};
    for (int64_t i = begin; i < end; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::of(ids, i, end);
      g.load(tensors, degree);
      GaussianGroupGradient<V> d;
      PoseGradient<V> dpose;
      V dposition[3];
      group_vjp(g, cam, degree, grad_packed, i, end, d, pose ? &dpose : nullptr,
                pose ? dposition : nullptr);
      const int64_t* row = g.rows.row;
      const int count = g.rows.count;
      scatter_rows(grads.means, 3, row, count, 3, d.shape.mean);
      scatter_rows(grads.log_scales, 3, row, count, 3, d.shape.log_scale);
      scatter_rows(grads.quats, 4, row, count, 4, d.shape.quat);
      scatter_rows(grads.opacity_logits, 1, row, count, 1, &d.shape.opacity_logit);
      scatter_rows(grads.sh_dc, 3, row, count, 3, d.dc);
      scatter_rows(grads.sh_rest, 3 * tensors.sh_rest_rows, row, count, sh_columns(degree), d.rest);
      if (pose) {
        for (int l = 0; l < count; l++) {
          for (int k = 0; k < 9; k++) sums[k] += double(dpose.rotation[k].v[l]);
          for (int k = 0; k < 3; k++) sums[9 + k] += double(dpose.translation[k].v[l]);
          for (int k = 0; k < 3; k++) sums[12 + k] += double(dposition[k].v[l]);
        }
      }
    }
    if (pose) std::memcpy(pose + 15 * block, sums, sizeof sums);
  });
}

}  // namespace
}  // namespace snow

using namespace snow;

#define SNOW_PROJECT_ENTRIES(SUFFIX, V)                                                           \
  SNOW_EXPORT int64_t project_cull##SUFFIX(                                                       \
      int64_t n, const V::Scalar* means, const V::Scalar* log_scales, const V::Scalar* quats,     \
      const V::Scalar* opacity_logits, const V::Scalar* cam_from_world, double width,             \
      double height, double fx, double fy, double cx, double cy, double near, int32_t* ids) {     \
    return cull<V>(n, {means, log_scales, quats, opacity_logits, nullptr, nullptr, 0},            \
                   {cam_from_world, width, height, fx, fy, cx, cy, near}, ids);                   \
  }                                                                                               \
  SNOW_EXPORT int64_t project_fwd##SUFFIX(                                                        \
      int64_t m, const int32_t* ids, const V::Scalar* means, const V::Scalar* log_scales,         \
      const V::Scalar* quats, const V::Scalar* opacity_logits, const V::Scalar* sh_dc,            \
      const V::Scalar* sh_rest, int64_t sh_rest_rows, int64_t degree,                             \
      const V::Scalar* cam_from_world, double width, double height, double fx, double fy,         \
      double cx, double cy, double near, V::Scalar* packed) {                                     \
    forward<V>(m, ids, {means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_rest_rows},  \
               int(degree), {cam_from_world, width, height, fx, fy, cx, cy, near}, packed);       \
    return 0;                                                                                     \
  }                                                                                               \
  SNOW_EXPORT int64_t project_bwd##SUFFIX(                                                        \
      int64_t m, const int32_t* ids, const V::Scalar* means, const V::Scalar* log_scales,         \
      const V::Scalar* quats, const V::Scalar* opacity_logits, const V::Scalar* sh_dc,            \
      const V::Scalar* sh_rest, int64_t sh_rest_rows, int64_t degree,                             \
      const V::Scalar* cam_from_world, double width, double height, double fx, double fy,         \
      double cx, double cy, double near, const V::Scalar* grad_packed, V::Scalar* d_means,        \
      V::Scalar* d_log_scales, V::Scalar* d_quats, V::Scalar* d_opacity_logits,                   \
      V::Scalar* d_sh_dc, V::Scalar* d_sh_rest, double* pose) {                                   \
    backward<V>(m, ids, {means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_rest_rows}, \
                int(degree), {cam_from_world, width, height, fx, fy, cx, cy, near}, grad_packed,  \
                {d_means, d_log_scales, d_quats, d_opacity_logits, d_sh_dc, d_sh_rest}, pose);    \
    return 0;                                                                                     \
  }

SNOW_PROJECT_ENTRIES(, VecF)
SNOW_PROJECT_ENTRIES(_f64, VecD)

// Rows of the `pose` scratch that project_bwd fills for m splats: 15 doubles each.
SNOW_EXPORT int64_t project_pose_blocks(int64_t m) { return (m + kBlock - 1) / kBlock; }
