// adam_step: the gradient of the splats, carried through the projection and used up at once by Adam
// (Kingma & Ba 2015), without ever writing the gradients of the parameters to memory.
//
//   m ← β₁ m + (1 − β₁) g,   v ← β₂ v + (1 − β₂) g²,   p ← p − lr m̂ / √(v̂ + ε²)
//
// ε is inside the root, where a fast reciprocal root applies; for the ε = 1e-15 of this field that
// is the same number.
//
// A number that this would make infinite or NaN stays as it is, with its moments: no gradient, however
// broken, gets into the parameters. Rows with such numbers are counted.
#include <algorithm>
#include <cmath>

#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 2048;
constexpr int kParameters = 6;  // means, log_scales, quats, opacity_logits, sh_dc, sh_rest

template <class T>
struct AdamTensor {
  T *value, *m, *v;
  const T* extra;           // a gradient to add, of the whole tensor; or null
  int64_t stride;           // columns as stored
  T rate;                   // lr / (1 − β₁ᵗ)
  int32_t* held = nullptr;  // a count of rows with numbers that stayed as they were; or null

  void count_held(int rows) const {
    if (held) __atomic_fetch_add(held, rows, __ATOMIC_RELAXED);
  }
};

template <class V>
struct AdamRule {
  V beta1, beta2, gain1, gain2, inv_correction2, eps2;
  SNOW_INLINE void step(V g, V& m, V& v, V& p, V rate) const {
    m = beta1 * m + gain1 * g;
    v = beta2 * v + gain2 * g * g;
    p -= rate * m * rsqrt(v * inv_correction2 + eps2);
  }
};

template <class V>
SNOW_INLINE bool all_finite(V a) {
  return __builtin_expect(V::bits(is_finite(a)) == V::bits(V::first(V::width)), 1);
}

// For lanes where a step comes to numbers that are not finite: the step for the others alone, and
// the lanes of those. Rare, so it stays out of the way.
template <class V>
__attribute__((noinline, cold)) uint32_t step_where_finite(const AdamRule<V>& rule, const V& g,
                                                           V& m, V& v, V& p, const V& rate) {
  const V m0 = m, v0 = v, p0 = p;
  rule.step(g, m, v, p, rate);
  const auto took = is_finite(v + p);  // v is finite only if g and m are
  m = select(took, m, m0), v = select(took, v, v0), p = select(took, p, p0);
  return ~V::bits(took);
}

template <class V, class T>
__attribute__((noinline, cold)) void update_finite_lanes(const AdamRule<V>& rule,
                                                         const AdamTensor<T>& t,
                                                         const RowIndex<V::width>& rows,
                                                         const V* g) {
  const int columns = int(t.stride);
  V p[4], m[4], v[4];
  gather_rows(t.value, t.stride, rows.row, columns, p);
  gather_rows(t.m, t.stride, rows.row, columns, m);
  gather_rows(t.v, t.stride, rows.row, columns, v);
  uint32_t held = 0;
  for (int k = 0; k < columns; k++)
    held |= step_where_finite(rule, g[k], m[k], v[k], p[k], V(t.rate));
  t.count_held(__builtin_popcount(held & V::bits(V::first(rows.count))));
  scatter_rows(t.value, t.stride, rows.row, rows.count, columns, p);
  scatter_rows(t.m, t.stride, rows.row, rows.count, columns, m);
  scatter_rows(t.v, t.stride, rows.row, rows.count, columns, v);
}

// A few columns (at most four) of W rows, in lanes.
template <class V, class T = typename V::Scalar>
__attribute__((noinline)) void update_lanes(const AdamRule<V>& rule, const AdamTensor<T>& t,
                                            const RowIndex<V::width>& rows, V* g) {
  const int columns = int(t.stride);
  V p[4], m[4], v[4], extra[4];
  gather_rows(t.value, t.stride, rows.row, columns, p);
  gather_rows(t.m, t.stride, rows.row, columns, m);
  gather_rows(t.v, t.stride, rows.row, columns, v);
  if (t.extra) {
    gather_rows(t.extra, t.stride, rows.row, columns, extra);
    for (int k = 0; k < columns; k++) g[k] += extra[k];
  }
  V sum(0.f);
  for (int k = 0; k < columns; k++) {
    rule.step(g[k], m[k], v[k], p[k], V(t.rate));
    sum += v[k] + p[k];
  }
  if (!all_finite(sum)) return update_finite_lanes(rule, t, rows, g);
  scatter_rows(t.value, t.stride, rows.row, rows.count, columns, p);
  scatter_rows(t.m, t.stride, rows.row, rows.count, columns, m);
  scatter_rows(t.v, t.stride, rows.row, rows.count, columns, v);
}

// The first n columns (all of V at most) from m, v and value on; the lanes that stayed as they were.
template <class V, class T = typename V::Scalar>
__attribute__((noinline, cold)) uint32_t update_finite(const AdamRule<V>& rule, int n, T* value,
                                                       T* m, T* v, const T* g, const T* extra,
                                                       T rate) {
  V gradient = g ? V::load_first(g, n) : V(0.f);
  if (extra) gradient += V::load_first(extra, n);
  V mc = V::load_first(m, n), vc = V::load_first(v, n), pc = V::load_first(value, n);
  const uint32_t held = step_where_finite(rule, gradient, mc, vc, pc, V(rate));
  mc.store_first(m, n), vc.store_first(v, n), pc.store_first(value, n);
  return held & V::bits(V::first(n));
}

// `columns` (many) of one row, contiguous; g may be null (zero gradient).
template <class V, class T = typename V::Scalar>
__attribute__((noinline)) void update_row(const AdamRule<V>& rule, const AdamTensor<T>& t,
                                          int64_t row, int columns, const T* g) {
  T *value = t.value + row * t.stride, *m = t.m + row * t.stride, *v = t.v + row * t.stride;
  const T* extra = t.extra ? t.extra + row * t.stride : nullptr;
  uint32_t held = 0;
  for (int c = 0; c < columns; c += V::width) {
    const int n = columns - c;
    V gradient = g ? V::load(g + c) : V(0.f), mc, vc, pc;
    if (n >= V::width) {
      mc = V::load(m + c), vc = V::load(v + c), pc = V::load(value + c);
      if (extra) gradient += V::load(extra + c);
      rule.step(gradient, mc, vc, pc, V(t.rate));
      if (all_finite(vc + pc)) {
        mc.store(m + c), vc.store(v + c), pc.store(value + c);
        continue;
      }
    } else {
      mc = V::load_first(m + c, n), vc = V::load_first(v + c, n), pc = V::load_first(value + c, n);
      if (extra) gradient += V::load_first(extra + c, n);
      rule.step(gradient, mc, vc, pc, V(t.rate));
      if (all_finite(vc + pc)) {
        mc.store_first(m + c, n), vc.store_first(v + c, n), pc.store_first(value + c, n);
        continue;
      }
    }
    held |= update_finite(rule, n, value + c, m + c, v + c, g ? g + c : nullptr,
                          extra ? extra + c : nullptr, t.rate);
  }
  if (held) t.count_held(1);
}

// Visible rows have gaps between them that the hardware does not foresee.
template <class T>
SNOW_INLINE void prefetch_row(int64_t row, const AdamTensor<T>* t, int rest_columns) {
  for (int k = 0; k < kParameters; k++) {
    const int64_t at = row * t[k].stride;
    for (int c = 0; c < (k < 5 ? 1 : rest_columns); c += 16)
      prefetch(t[k].value + at + c), prefetch(t[k].m + at + c), prefetch(t[k].v + at + c);
  }
}

template <class V, class T = typename V::Scalar>
void step(int64_t n, int64_t m, const int32_t* ids, const GaussianTensors<T>& tensors, int degree,
          const PinholeCamera<T>& cam, const T* grad_packed, const AdamTensor<T>* t,
          const AdamRule<V>& rule, bool visible_only) {
  constexpr int W = V::width;
  const int rest_columns = sh_columns(degree);
  // Tasks are ranges of Gaussians, each with the splats that came from it: ids ascend.
  const int64_t units = visible_only ? m : n;
  parallel_for((units + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = std::min(begin + kBlock, units);
    int64_t first = begin, last = end;
    if (!visible_only) {
      first = std::lower_bound(ids, ids + m, int32_t(begin)) - ids;
      last = std::lower_bound(ids, ids + m, int32_t(end)) - ids;
    }
    alignas(64) T by_row[W][48] = {};
    for (int64_t i = first; i < last; i += W) {
      GaussianGroup<V> g;
      g.rows = RowIndex<W>::of(ids, i, last);
      g.load(tensors, degree);
      GaussianGroupGradient<V> d;
      group_vjp<V>(g, cam, degree, grad_packed, i, last, d, nullptr, nullptr);
      V* small[5] = {d.shape.mean, d.shape.log_scale, d.shape.quat, &d.shape.opacity_logit, d.dc};
      for (int k = 0; k < 5; k++) update_lanes(rule, t[k], g.rows, small[k]);
      int64_t lane[W];
      for (int l = 0; l < W; l++) lane[l] = l;
      scatter_rows(by_row[0], 48, lane, W, rest_columns, d.rest);
      for (int k = 0; k < g.rows.count; k++) {
        if (i + W + k < last) prefetch_row(ids[i + W + k], t, rest_columns);
        if (degree > 0) update_row(rule, t[5], g.rows.row[k], rest_columns, by_row[k]);
      }
    }
    if (visible_only) return;
    for (int64_t row = begin, i = first; row < end; row++) {
      if (i < last && ids[i] == row) {
        i++;
        continue;
      }
      for (int k = 0; k < 5; k++) update_row(rule, t[k], row, int(t[k].stride), (const T*)nullptr);
      if (degree > 0) update_row(rule, t[5], row, rest_columns, (const T*)nullptr);
    }
  });
}

}  // namespace
}  // namespace snow

using namespace snow;

// Per parameter, in the order means, log_scales, quats, opacity_logits, sh_dc, sh_rest: value,
// first and second moment, extra gradient or null, and learning rate. Where *valid is false nothing
// changes. held: six counts of rows to add to, or null. −1 where an id is negative, which is a row of
// a GPU: nothing changes then, either.
#define SNOW_ADAM_ENTRY(NAME, V)                                                                   \
  SNOW_EXPORT int64_t NAME(                                                                        \
      int64_t n, int64_t m, const int32_t* ids, const V::Scalar* grad_packed,                      \
      const V::Scalar* cam_from_world, double width, double height, double fx, double fy,          \
      double cx, double cy, double near, int64_t sh_rest_rows, int64_t degree, V::Scalar* p0,      \
      V::Scalar* m0, V::Scalar* v0, const V::Scalar* e0, double lr0, V::Scalar* p1, V::Scalar* m1, \
      V::Scalar* v1, const V::Scalar* e1, double lr1, V::Scalar* p2, V::Scalar* m2, V::Scalar* v2, \
      const V::Scalar* e2, double lr2, V::Scalar* p3, V::Scalar* m3, V::Scalar* v3,                \
      const V::Scalar* e3, double lr3, V::Scalar* p4, V::Scalar* m4, V::Scalar* v4,                \
      const V::Scalar* e4, double lr4, V::Scalar* p5, V::Scalar* m5, V::Scalar* v5,                \
      const V::Scalar* e5, double lr5, int64_t adam_step, double beta1, double beta2, double eps,  \
      int64_t visible_only, const bool* valid, int32_t* held) {                                    \
    if (valid && !*valid) return 0;                                                                \
    if (std::any_of(ids, ids + m, [](int32_t id) { return id < 0; })) return -1;                   \
    using T = V::Scalar;                                                                           \
    const double c1 = 1 - std::pow(beta1, double(adam_step));                                      \
    const double c2 = 1 - std::pow(beta2, double(adam_step));                                      \
    AdamTensor<T> tensors[kParameters] = {                                                         \
        {p0, m0, v0, e0, 3, T(lr0 / c1)}, {p1, m1, v1, e1, 3, T(lr1 / c1)},                        \
        {p2, m2, v2, e2, 4, T(lr2 / c1)}, {p3, m3, v3, e3, 1, T(lr3 / c1)},                        \
        {p4, m4, v4, e4, 3, T(lr4 / c1)}, {p5, m5, v5, e5, 3 * sh_rest_rows, T(lr5 / c1)}};        \
    for (int k = 0; k < kParameters; k++) tensors[k].held = held ? held + k : nullptr;             \
    const AdamRule<V> rule = {V(beta1),     V(beta2),  V(1 - beta1),                               \
                              V(1 - beta2), V(1 / c2), V(eps * eps)};                              \
    step<V>(n, m, ids, {p0, p1, p2, p3, p4, p5, sh_rest_rows}, int(degree),                        \
            {cam_from_world, width, height, fx, fy, cx, cy, near}, grad_packed, tensors, rule,     \
            visible_only != 0);                                                                    \
    return 0;                                                                                      \
  }

SNOW_ADAM_ENTRY(adam_step, VecF)
SNOW_ADAM_ENTRY(adam_step_f64, VecD)
