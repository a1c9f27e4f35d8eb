// points_in_frusta: how many cameras show each point, and from how near. One thread per point.
#include "cuda/device.h"
#include "frusta.h"

namespace snow {

template <class T>
SNOW_INLINE void find(const PointsInFrustaParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n) return;
  T count(0), rate(0);
  for (int64_t view = 0; view < p.views; view++)
    add_frustum(Frustum<T>(p, view), p.points + 3 * i, count, rate);
  p.counts[i] = count, p.rates[i] = rate;
}

}  // namespace snow

using namespace snow;

SNOW_KERNEL(points_in_frusta, 128, PointsInFrustaParams<float>) { find(p); }
SNOW_KERNEL(points_in_frusta_f64, 128, PointsInFrustaParams<double>) { find(p); }
