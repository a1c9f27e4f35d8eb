// points_in_frusta: how many cameras show each point, and from how near. points_in_spheres: how many
// cameras are near each point, and how far the nearest one is.
#include "frusta.h"

#include <algorithm>

#include "cpu/entry.h"
#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 1024;  // points per task

// Calls f(point, first, second) for each group of points, whose two results it changes from 0 and
// `initial`.
template <class V, class P, class F, class T = typename V::Scalar>
int64_t for_each_point(const P& p, T initial, T* firsts, T* seconds, const F& f) {
  parallel_for((p.n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t end = std::min(p.n, (block + 1) * kBlock);
    for (int64_t i = block * kBlock; i < end; i += V::width) {
      const auto rows = RowIndex<V::width>::contiguous(i, end);
      V point[3], first(T(0)), second(initial);
      gather_rows(p.points, 3, rows.row, 3, point);
      f(point, first, second);
      first.store_first(firsts + i, rows.count);
      second.store_first(seconds + i, rows.count);
    }
  });
  return 0;
}

template <class V, class T = typename V::Scalar>
int64_t find_frusta(const PointsInFrustaParams<T>& p) {
  return for_each_point<V>(p, T(0), p.counts, p.rates, [&](const V* point, V& count, V& rate) {
    for (int64_t view = 0; view < p.views; view++)
      add_frustum(Frustum<T>(p, view), point, count, rate);
  });
}

template <class V, class T = typename V::Scalar>
int64_t find_spheres(const PointsInSpheresParams<T>& p) {
  const T far = T(INFINITY);
  return for_each_point<V>(p, far, p.counts, p.nearest, [&](const V* point, V& count, V& nearest) {
    for (int64_t i = 0; i < p.count; i++) add_sphere(p.spheres + 4 * i, point, count, nearest);
  });
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(points_in_frusta, PointsInFrustaParams<float>) { return find_frusta<VecF>(p); }
SNOW_ENTRY(points_in_frusta_f64, PointsInFrustaParams<double>) { return find_frusta<VecD>(p); }
SNOW_ENTRY(points_in_spheres, PointsInSpheresParams<float>) { return find_spheres<VecF>(p); }
SNOW_ENTRY(points_in_spheres_f64, PointsInSpheresParams<double>) { return find_spheres<VecD>(p); }
