// adam_step: computes the gradients of the parameters from those of the splats, and applies Adam
// (adam.h) immediately. The gradients of the parameters are never written to memory.
#include "adam.h"

#include <algorithm>

#include "cpu/entry.h"
#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 2048;

// A parameter as a matrix with one row per Gaussian.
template <class T>
struct AdamRows {
  T *value, *m, *v;
  const T* extra;           // additional gradient; or null
  T rate;                   // lr / (1 − β₁ᵗ)
  int64_t stride;           // columns as stored
  int32_t* nonfinite_rows;  // number of skipped rows; or null

  AdamRows(const AdamTensor<T>& t, int64_t columns, int32_t* count)
      : value(t.value), m(t.m), v(t.v), extra(t.extra), rate(T(t.rate)), stride(columns),
        nonfinite_rows(count) {}

  void count_nonfinite(int rows) const {
    if (nonfinite_rows) __atomic_fetch_add(nonfinite_rows, rows, __ATOMIC_RELAXED);
  }
};

template <class V>
SNOW_INLINE bool all_finite(V a) {
  return __builtin_expect(V::bits(is_finite(a)) == V::bits(V::first(V::width)), 1);
}

// Applies the step in the lanes in which its results are finite, and returns the bits of the other
// lanes. It is rarely called, so it is not inlined.
template <class V>
__attribute__((noinline, cold)) uint32_t step_where_finite(const AdamRule<V>& rule, const V& g,
                                                           V& m, V& v, V& p, const V& rate) {
  const V m0 = m, v0 = v, p0 = p;
  rule.step(g, m, v, p, rate);
  const auto taken = rule.is_taken(v, p);
  m = select(taken, m, m0), v = select(taken, v, v0), p = select(taken, p, p0);
  return ~V::bits(taken);
}

template <class V, class T>
__attribute__((noinline, cold)) void update_finite_lanes(const AdamRule<V>& rule,
                                                         const AdamRows<T>& t,
                                                         const RowIndex<V::width>& rows,
                                                         const V* g) {
  const int columns = int(t.stride);
  V p[4], m[4], v[4];
  gather_rows(t.value, t.stride, rows.row, columns, p);
  gather_rows(t.m, t.stride, rows.row, columns, m);
  gather_rows(t.v, t.stride, rows.row, columns, v);
  uint32_t nonfinite = 0;
  for (int k = 0; k < columns; k++)
    nonfinite |= step_where_finite(rule, g[k], m[k], v[k], p[k], V(t.rate));
  t.count_nonfinite(__builtin_popcount(nonfinite & V::bits(V::first(rows.count))));
  scatter_rows(t.value, t.stride, rows.row, rows.count, columns, p);
  scatter_rows(t.m, t.stride, rows.row, rows.count, columns, m);
  scatter_rows(t.v, t.stride, rows.row, rows.count, columns, v);
}

// Updates at most four columns of W rows, with one row per lane.
template <class V, class T = typename V::Scalar>
__attribute__((noinline)) void update_lanes(const AdamRule<V>& rule, const AdamRows<T>& t,
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

// Updates n ≤ W adjacent columns; returns the bits of the lanes that were skipped.
template <class V, class T = typename V::Scalar>
__attribute__((noinline, cold)) uint32_t update_finite(const AdamRule<V>& rule, int n, T* value,
                                                       T* m, T* v, const T* g, const T* extra,
                                                       T rate) {
  V gradient = g ? V::load_first(g, n) : V(0.f);
  if (extra) gradient += V::load_first(extra, n);
  V mc = V::load_first(m, n), vc = V::load_first(v, n), pc = V::load_first(value, n);
  const uint32_t nonfinite = step_where_finite(rule, gradient, mc, vc, pc, V(rate));
  mc.store_first(m, n), vc.store_first(v, n), pc.store_first(value, n);
  return nonfinite & V::bits(V::first(n));
}

// Updates `columns` contiguous columns of one row. g may be null: a gradient of zero.
template <class V, class T = typename V::Scalar>
__attribute__((noinline)) void update_row(const AdamRule<V>& rule, const AdamRows<T>& t,
                                          int64_t row, int columns, const T* g) {
  T *value = t.value + row * t.stride, *m = t.m + row * t.stride, *v = t.v + row * t.stride;
  const T* extra = t.extra ? t.extra + row * t.stride : nullptr;
  uint32_t nonfinite = 0;
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
    nonfinite |= update_finite(rule, n, value + c, m + c, v + c, g ? g + c : nullptr,
                               extra ? extra + c : nullptr, t.rate);
  }
  if (nonfinite) t.count_nonfinite(1);
}

// The hardware prefetcher does not predict the next visible row, because the gaps between them
// vary.
template <class T>
SNOW_INLINE void prefetch_row(int64_t row, const AdamRows<T>* t, int rest_columns) {
  for (int k = 0; k < kAdamParameters; k++) {
    const int64_t at = row * t[k].stride;
    for (int c = 0; c < (k < 5 ? 1 : rest_columns); c += 16)
      prefetch(t[k].value + at + c), prefetch(t[k].m + at + c), prefetch(t[k].v + at + c);
  }
}

// If an id is negative, returns −1 and changes nothing: only a GPU creates such rows.
template <class V, class T = typename V::Scalar>
int64_t step(const AdamStepParams<T>& p) {
  constexpr int W = V::width;
  const int64_t n = p.n, m = p.splats;
  const int32_t* ids = p.ids;
  if (p.valid && !*p.valid) return 0;
  if (std::any_of(ids, ids + m, [](int32_t id) { return id < 0; })) return -1;

  const PinholeCamera<T> cam(p.camera, double());
  const GaussianTensors<T> tensors = {p.means.value,          p.log_scales.value, p.quats.value,
                                      p.opacity_logits.value, p.sh_dc.value,      p.sh_rest.value,
                                      p.sh_rest_rows,         p.sh_degree};
  const auto count = [&](int k) { return p.nonfinite_rows ? p.nonfinite_rows + k : nullptr; };
  const AdamRows<T> t[kAdamParameters] = {
      {p.means, 3, count(0)}, {p.log_scales, 3, count(1)},
      {p.quats, 4, count(2)}, {p.opacity_logits, 1, count(3)},
      {p.sh_dc, 3, count(4)}, {p.sh_rest, 3 * p.sh_rest_rows, count(5)}};
  const AdamRule<V> rule(p);
  const bool visible_only = p.visible_only != 0;
  const int degree = int(p.sh_degree), rest_columns = sh_columns(degree);
  // A task is a range of Gaussians and their splats, which are contiguous because ids are
  // ascending.
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
      g.load(tensors);
      GaussianGroupGradient<V> d;
      if (p.grad_packed)
        group_vjp<V>(g, cam, degree, p.grad_packed, i, last, d, nullptr, nullptr);
      else
        d = {};
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
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(adam_step, AdamStepParams<float>) { return step<VecF>(p); }
SNOW_ENTRY(adam_step_f64, AdamStepParams<double>) { return step<VecD>(p); }
