// points_in_frusta: how many cameras show each point, and from how near.
#include "frusta.h"

#include <algorithm>

#include "cpu/entry.h"
#include "cpu/gaussian_rows.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 1024;  // points per task

template <class V, class T = typename V::Scalar>
int64_t find(const PointsInFrustaParams<T>& p) {
  parallel_for((p.n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t end = std::min(p.n, (block + 1) * kBlock);
    for (int64_t i = block * kBlock; i < end; i += V::width) {
      const auto rows = RowIndex<V::width>::contiguous(i, end);
      V point[3], count(T(0)), rate(T(0));
      gather_rows(p.points, 3, rows.row, 3, point);
      for (int64_t view = 0; view < p.views; view++)
        add_frustum(Frustum<T>(p, view), point, count, rate);
      count.store_first(p.counts + i, rows.count);
      rate.store_first(p.rates + i, rows.count);
    }
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(points_in_frusta, PointsInFrustaParams<float>) { return find<VecF>(p); }
SNOW_ENTRY(points_in_frusta_f64, PointsInFrustaParams<double>) { return find<VecD>(p); }
