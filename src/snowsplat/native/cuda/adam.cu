// adam_step: the gradient of the splats, carried through the projection and used up at once by Adam
// (Kingma & Ba 2015), without ever writing the gradients of the parameters to memory. The rule is
// that of cpu/adam.cpp. In time this is memory alone: the gradients of a block's Gaussians are made
// in shared memory, then all threads go along each tensor and its moments together. As there, a number
// that would become infinite or NaN stays as it is, and rows with such numbers are counted.
#include "cuda/gaussian_row.h"

namespace snow {
namespace {

template <class T>
struct AdamTensor {
  T *value, *m, *v;
  const T* extra;  // a gradient to add, of the whole tensor; or null
  T rate;          // lr / (1 − β₁ᵗ)
};

template <class T>
struct AdamRule {
  T beta1, beta2, gain1, gain2, inv_correction2, eps2;
  SNOW_INLINE void step(T g, T& m, T& v, T& p, T rate) const {
    m = beta1 * m + gain1 * g;
    v = beta2 * v + gain2 * g * g;
    p -= rate * m * rsqrt(v * inv_correction2 + eps2);
  }
};

// Of a row, in place of its splat.
constexpr int32_t kUnseen = -1, kLeaveAlone = -2;

// Columns of the rows from `first` on. `gradient` is their first column of the tile. Rows with numbers
// that stayed as they were get `bit` in `held`.
template <int kBatch, class T>
SNOW_INLINE void update(const AdamRule<T>& rule, const AdamTensor<T>& tensor, int64_t first,
                        int stride, int columns, const int32_t* splats, const T* gradient,
                        int32_t* held, int bit) {
  T* value = tensor.value + first * stride;
  T *ms = tensor.m + first * stride, *vs = tensor.v + first * stride;
  const T* extra = tensor.extra ? tensor.extra + first * stride : nullptr;
  for_each_number<kBatch>(columns, [&](const int* row, const int* column) {
    T g[kBatch] = {}, m[kBatch] = {}, v[kBatch] = {}, p[kBatch] = {};
    for (int j = 0; j < kBatch; j++) {
      const int32_t splat = splats[row[j]];
      if (splat == kLeaveAlone) continue;
      const int at = row[j] * stride + column[j];
      m[j] = ms[at], v[j] = vs[at], p[j] = value[at];
      if (extra) g[j] = extra[at];
    }
    for (int j = 0; j < kBatch; j++) {
      const int32_t splat = splats[row[j]];
      if (splat == kLeaveAlone) continue;
      if (splat >= 0) g[j] += gradient[row[j] * kRowColumns + column[j]];
      rule.step(g[j], m[j], v[j], p[j], tensor.rate);
      const int at = row[j] * stride + column[j];
      if (is_finite(v[j] + p[j])) {  // v is only if the gradient and m are
        ms[at] = m[j], vs[at] = v[j], value[at] = p[j];
      } else {
        atomicOr(&held[row[j]], bit);
      }
    }
  });
}

// splat_of[i] is the splat of Gaussian i, or −1.
template <class T>
SNOW_INLINE void step(int64_t n, const int32_t* splat_of, const GaussianTensors<T>& tensors,
                      int degree, const PinholeCamera<T>& cam, const T* grad_packed,
                      const AdamTensor<T> (&t)[6], const AdamRule<T>& rule, bool visible_only,
                      int32_t* counts) {
  SNOW_SHARED(T, tile, kRowThreads * kRowColumns);
  SNOW_SHARED(int32_t, ids, kRowThreads + 1);
  SNOW_SHARED(int32_t, splats, kRowThreads + 1);
  SNOW_SHARED(int32_t, held, kRowThreads);
  const int64_t i = thread_index(), first = int64_t(blockIdx.x) * kRowThreads;
  const int32_t splat = i < n ? splat_of[i] : kUnseen;
  held[threadIdx.x] = 0;
  ids[threadIdx.x] = splat >= 0 ? int32_t(i) : -1;
  splats[threadIdx.x] = i >= n || (visible_only && splat < 0) ? kLeaveAlone : splat;
  if (threadIdx.x == 0) ids[kRowThreads] = -1, splats[kRowThreads] = kLeaveAlone;
  __syncthreads();
  load_rest<kRowColumns>(tensors, degree, ids, tile);
  __syncthreads();
  if (splat >= 0) {
    PoseGradient<T> pose;
    T position[3];
    row_vjp(tensors, i, degree, cam, grad_packed + int64_t(splat) * kPackedStride,
            tile + int(threadIdx.x) * kRowColumns, pose, position);
  }
  __syncthreads();
  update<3>(rule, t[0], first, 3, 3, splats, tile + kMeanColumn, held, 1);
  update<3>(rule, t[1], first, 3, 3, splats, tile + kLogScaleColumn, held, 2);
  update<4>(rule, t[2], first, 4, 4, splats, tile + kQuatColumn, held, 4);
  update<1>(rule, t[3], first, 1, 1, splats, tile + kLogitColumn, held, 8);
  update<3>(rule, t[4], first, 3, 3, splats, tile + kDcColumn, held, 16);
  if (degree > 0) {
    const int stride = 3 * int(tensors.sh_rest_rows);
    update<kRestBatch>(rule, t[5], first, stride, sh_columns(degree), splats, tile, held, 32);
  }
  __syncthreads();
  if (!counts || held[threadIdx.x] == 0) return;
  for (int k = 0; k < 6; k++)
    if (held[threadIdx.x] >> k & 1) atomicAdd(&counts[k], 1);
}

}  // namespace
}  // namespace snow

// splat_of of compact ids; it holds −1 before.
SNOW_KERNEL(adam_splat_of, 256, (int64_t m, const int32_t* ids, int64_t n, int32_t* splat_of)) {
  const int64_t i = snow::thread_index();
  if (i < m && ids[i] >= 0 && ids[i] < n) splat_of[ids[i]] = int32_t(i);
}

// Per parameter, in the order means, log_scales, quats, opacity_logits, sh_dc, sh_rest: value,
// first and second moment, extra gradient or null, and lr / (1 − β₁ᵗ). Where *valid is false nothing
// changes. held: six counts of rows to add to, or null.
#define SNOW_ADAM_KERNEL(NAME, T)                                                                 \
  SNOW_KERNEL(NAME, snow::kRowThreads,                                                            \
              (int64_t n, const int32_t* splat_of, const T* grad_packed, const T* cam_from_world, \
               double width, double height, double fx, double fy, double cx, double cy,           \
               double near, int64_t sh_rest_rows, int64_t degree, T* p0, T* m0, T* v0,            \
               const T* e0, double rate0, T* p1, T* m1, T* v1, const T* e1, double rate1, T* p2,  \
               T* m2, T* v2, const T* e2, double rate2, T* p3, T* m3, T* v3, const T* e3,         \
               double rate3, T* p4, T* m4, T* v4, const T* e4, double rate4, T* p5, T* m5, T* v5, \
               const T* e5, double rate5, double beta1, double beta2, double inv_correction2,     \
               double eps2, int64_t visible_only, const bool* valid, int32_t* held)) {            \
    if (valid && !*valid) return;                                                                 \
    const snow::AdamTensor<T> tensors[6] = {                                                      \
        {p0, m0, v0, e0, T(rate0)}, {p1, m1, v1, e1, T(rate1)}, {p2, m2, v2, e2, T(rate2)},       \
        {p3, m3, v3, e3, T(rate3)}, {p4, m4, v4, e4, T(rate4)}, {p5, m5, v5, e5, T(rate5)}};      \
    snow::step<T>(n, splat_of, {p0, p1, p2, p3, p4, p5, sh_rest_rows}, int(degree),               \
                  {cam_from_world, T(width), T(height), T(fx), T(fy), T(cx), T(cy), T(near)},     \
                  grad_packed, tensors,                                                           \
                  {T(beta1), T(beta2), T(1 - beta1), T(1 - beta2), T(inv_correction2), T(eps2)},  \
                  visible_only != 0, held);                                                       \
  }

SNOW_ADAM_KERNEL(adam_update, float)
SNOW_ADAM_KERNEL(adam_update_f64, double)
