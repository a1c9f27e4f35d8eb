// adam_step: computes the gradients of the parameters from those of the splats, and applies Adam
// (adam.h) immediately. The gradients of the parameters are never written to global memory. The
// time is limited by the memory traffic. A block writes the gradients of its Gaussians to shared
// memory; then all its threads together update each tensor and its moments.
#include "adam.h"
#include "cuda/gaussian_row.h"

namespace snow {
namespace {

// Values in `splats` for rows without a splat. kUnseen: the row is updated with a gradient of 0.
// kNotUpdated: the row is not updated.
constexpr int32_t kUnseen = -1, kNotUpdated = -2;

// adam_splat_of: finds the splat of each Gaussian, if the rows of the splats are compacted. The
// caller fills splat_of with −1 before.
struct AdamSplatOfParams {
  int64_t n;           // splats
  const int32_t* ids;  // (n,) rows of Gaussians
  int64_t gaussians;   // length of splat_of
  int32_t* splat_of;   // out, (gaussians,)
  SNOW_FIELDS(n, ids, gaussians, splat_of)
};

// Updates the columns of the block's rows; row 0 is Gaussian `first`. `gradient` points to the
// first of these columns in the tile of gradients. `bit` is set in `nonfinite` for each row in
// which a value was skipped.
template <int kBatch, class T>
SNOW_INLINE void update(const AdamRule<T>& rule, const AdamTensor<T>& tensor, int64_t first,
                        int stride, int columns, const int32_t* splats, const T* gradient,
                        int32_t* nonfinite, int bit) {
  T* value = tensor.value + first * stride;
  T *ms = tensor.m + first * stride, *vs = tensor.v + first * stride;
  const T* extra = tensor.extra ? tensor.extra + first * stride : nullptr;
  const T rate = T(tensor.rate);
  for_each_number<kBatch>(columns, [&](const int* row, const int* column) {
    T g[kBatch] = {}, m[kBatch] = {}, v[kBatch] = {}, p[kBatch] = {};
    for (int j = 0; j < kBatch; j++) {
      const int32_t splat = splats[row[j]];
      if (splat == kNotUpdated) continue;
      const int at = row[j] * stride + column[j];
      m[j] = ms[at], v[j] = vs[at], p[j] = value[at];
      if (extra) g[j] = extra[at];
    }
    for (int j = 0; j < kBatch; j++) {
      const int32_t splat = splats[row[j]];
      if (splat == kNotUpdated) continue;
      if (splat >= 0) g[j] += gradient[row[j] * kRowColumns + column[j]];
      rule.step(g[j], m[j], v[j], p[j], rate);
      const int at = row[j] * stride + column[j];
      if (rule.is_taken(v[j], p[j])) {
        ms[at] = m[j], vs[at] = v[j], value[at] = p[j];
      } else {
        atomicOr(&nonfinite[row[j]], bit);
      }
    }
  });
}

// p.ids: the splat of every Gaussian, or −1.
template <class T>
SNOW_INLINE void step(const AdamStepParams<T>& p) {
  SNOW_SHARED(T, tile, kRowThreads * kRowColumns);
  SNOW_SHARED(int32_t, ids, kRowThreads + 1);
  SNOW_SHARED(int32_t, splats, kRowThreads + 1);
  SNOW_SHARED(int32_t, nonfinite, kRowThreads);
  const int64_t i = thread_index(), first = int64_t(blockIdx.x) * kRowThreads;
  const int32_t splat = i < p.n ? p.ids[i] : kUnseen;
  nonfinite[threadIdx.x] = 0;
  const bool has_gradient = splat >= 0 && p.grad_packed;
  ids[threadIdx.x] = has_gradient ? int32_t(i) : -1;
  splats[threadIdx.x] = i >= p.n || (p.visible_only && splat < 0) ? kNotUpdated
                        : has_gradient                            ? splat
                                                                  : kUnseen;
  if (threadIdx.x == 0) ids[kRowThreads] = -1, splats[kRowThreads] = kNotUpdated;
  __syncthreads();

  const GaussianTensors<T> gaussians = {p.means.value,          p.log_scales.value, p.quats.value,
                                        p.opacity_logits.value, p.sh_dc.value,      p.sh_rest.value,
                                        p.sh_rest_rows,         p.sh_degree};
  load_rest<kRowColumns>(gaussians, ids, tile);
  __syncthreads();
  if (has_gradient) {
    const PinholeCamera<T> cam(p.camera, T());
    PoseGradient<T> pose;
    T position[3];
    row_vjp(gaussians, i, cam, p.grad_packed + int64_t(splat) * kPackedStride,
            tile + int(threadIdx.x) * kRowColumns, pose, position);
  }
  __syncthreads();
  const AdamRule<T> rule(p);
  update<3>(rule, p.means, first, 3, 3, splats, tile + kMeanColumn, nonfinite, 1);
  update<3>(rule, p.log_scales, first, 3, 3, splats, tile + kLogScaleColumn, nonfinite, 2);
  update<4>(rule, p.quats, first, 4, 4, splats, tile + kQuatColumn, nonfinite, 4);
  update<1>(rule, p.opacity_logits, first, 1, 1, splats, tile + kLogitColumn, nonfinite, 8);
  update<3>(rule, p.sh_dc, first, 3, 3, splats, tile + kDcColumn, nonfinite, 16);
  if (p.sh_degree > 0) {
    const int stride = 3 * int(p.sh_rest_rows), columns = sh_columns(int(p.sh_degree));
    update<kRestBatch>(rule, p.sh_rest, first, stride, columns, splats, tile, nonfinite, 32);
  }
  __syncthreads();
  if (!p.nonfinite_rows || nonfinite[threadIdx.x] == 0) return;
  for (int k = 0; k < kAdamParameters; k++)
    if (nonfinite[threadIdx.x] >> k & 1) atomicAdd(&p.nonfinite_rows[k], 1);
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(adam_splat_of, 256, AdamSplatOfParams) {
  const int64_t i = thread_index();
  if (i < p.n && p.ids[i] >= 0 && p.ids[i] < p.gaussians) p.splat_of[p.ids[i]] = int32_t(i);
}

SNOW_KERNEL(adam_update, kRowThreads, AdamStepParams<float>) {
  if (!p.valid || *p.valid) step(p);
}
SNOW_KERNEL(adam_update_f64, kRowThreads, AdamStepParams<double>) {
  if (!p.valid || *p.valid) step(p);
}
