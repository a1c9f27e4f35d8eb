// project: the Gaussians that a camera sees (project_cull), their 2D splats (project_fwd), and the
// gradients of the parameters and the pose from the gradients of the splats (project_bwd).
#include <algorithm>
#include <cstring>
#include <vector>

#include "cpu/entry.h"
#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 2048;  // Gaussians per task: independent of the number of threads

// Whether a Gaussian may be visible, by an upper bound on the half extents of its splat. The bound
// needs only the largest scale s: λmax(Σ) = s², so Σ'xx ≤ |J_x|² s² + 0.3 with
// |J_x|² = (fx/z)² (1 + tx²). It is fast to compute.
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
int64_t cull(const ProjectCullParams<T>& p) {
  constexpr int W = V::width;
  const int64_t n = p.n;
  const GaussianTensors<T>& tensors = p.gaussians;
  const PinholeCamera<T> cam(p.camera, double());
  int32_t* ids = p.ids;
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
int64_t forward(const ProjectForwardParams<T>& p) {
  constexpr int W = V::width;
  const int64_t n = p.n;
  const int degree = int(p.gaussians.sh_degree);
  const PinholeCamera<T> cam(p.camera, double());
  parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < n ? begin + kBlock : n;
    for (int64_t i = begin; i < end; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::of(p.ids, i, end);
      g.load(p.gaussians);
      for (int64_t next = i + W; next < i + 2 * W && next < end; next++)
        prefetch_row(p.gaussians, p.ids[next]);
      ProjectedGaussian<V> projected;
      project_gaussian(g.shape, cam, projected);
      V column[kPackedStride], *color = column + kPackedHeader;
      sh_color(degree, view_direction(g.shape.mean, cam.position), g.dc, g.rest, color);
      splat_header(projected, column);
      for (int k = 0; k < 3; k++) color[k] = max(color[k], V(0.f));
      for (int k = kPackedHeader + 3; k < kPackedStride; k++) column[k] = V(0.f);
      const auto splats = RowIndex<W>::contiguous(i, end);
      scatter_rows(p.packed, kPackedStride, splats.row, splats.count, kPackedStride, column);
    }
  });
  return 0;
}

// Adds `columns` columns of W rows, with one row per lane.
template <class V, class T = typename V::Scalar>
SNOW_INLINE void add_rows(T* base, int64_t stride, const RowIndex<V::width>& rows, int columns,
                          const V* in) {
  V sum[3 * (kMaxShCoefficients - 1) + 1];
  gather_rows(base, stride, rows.row, columns, sum);
  for (int k = 0; k < columns; k++) sum[k] += in[k];
  scatter_rows(base, stride, rows.row, rows.count, columns, sum);
}

// If an id is negative, returns −1 and changes nothing: only a GPU creates such rows.
template <class V, class T = typename V::Scalar>
int64_t backward(const ProjectBackwardParams<T>& p) {
  constexpr int W = V::width;
  const int64_t n = p.n;
  if (std::any_of(p.ids, p.ids + n, [](int32_t id) { return id < 0; })) return -1;
  const GaussianTensors<T>& tensors = p.gaussians;
  const GaussianGradients<T>& grads = p.grads;
  const int degree = int(tensors.sh_degree);
  const PinholeCamera<T> cam(p.camera, double());
  double* pose = p.pose;
  parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < n ? begin + kBlock : n;
    double sums[kPoseSums] = {0};
    for (int64_t i = begin; i < end; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::of(p.ids, i, end);
      g.load(tensors);
      GaussianGroupGradient<V> d;
      PoseGradient<V> dpose;
      V dposition[3];
      group_vjp(g, cam, degree, p.grad_packed, i, end, d, pose ? &dpose : nullptr,
                pose ? dposition : nullptr);
      if (grads.means) {
        add_rows(grads.means, 3, g.rows, 3, d.shape.mean);
        add_rows(grads.log_scales, 3, g.rows, 3, d.shape.log_scale);
        add_rows(grads.quats, 4, g.rows, 4, d.shape.quat);
        add_rows(grads.opacity_logits, 1, g.rows, 1, &d.shape.opacity_logit);
        add_rows(grads.sh_dc, 3 * tensors.sh_dc_rows, g.rows, 3, d.dc);
        add_rows(grads.sh_rest, 3 * tensors.sh_rest_rows, g.rows, sh_columns(degree), d.rest);
      }
      if (pose) {
        const auto rounded = [&](T term) { return (double(term) + p.rounding) - p.rounding; };
        for (int l = 0; l < g.rows.count; l++) {
          for (int k = 0; k < 9; k++) sums[k] += rounded(dpose.rotation[k].v[l]);
          for (int k = 0; k < 3; k++) sums[9 + k] += rounded(dpose.translation[k].v[l]);
          for (int k = 0; k < 3; k++) sums[12 + k] += rounded(dposition[k].v[l]);
          sums[15] += rounded(dpose.log_focal.v[l]);
        }
      }
    }
    if (pose) std::memcpy(pose + kPoseSums * block, sums, sizeof sums);
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(project_cull, ProjectCullParams<float>) { return cull<VecF>(p); }
SNOW_ENTRY(project_cull_f64, ProjectCullParams<double>) { return cull<VecD>(p); }
SNOW_ENTRY(project_fwd, ProjectForwardParams<float>) { return forward<VecF>(p); }
SNOW_ENTRY(project_fwd_f64, ProjectForwardParams<double>) { return forward<VecD>(p); }
SNOW_ENTRY(project_bwd, ProjectBackwardParams<float>) { return backward<VecF>(p); }
SNOW_ENTRY(project_bwd_f64, ProjectBackwardParams<double>) { return backward<VecD>(p); }

// Rows of `pose` that project_bwd fills for n splats.
SNOW_ENTRY(project_pose_blocks, SizeQueryParams) { return (p.n + kBlock - 1) / kBlock; }
