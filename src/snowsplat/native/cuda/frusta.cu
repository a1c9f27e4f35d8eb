// points_in_frusta: how many cameras show each point, and from how near. points_in_spheres: how many
// cameras are near each point, and how far the nearest one is. One thread per point.
#include "cuda/device.h"
#include "frusta.h"

namespace snow {

template <class T>
SNOW_INLINE void find_frusta(const PointsInFrustaParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n) return;
  T count(0), rate(0);
  for (int64_t view = 0; view < p.views; view++)
    add_frustum(Frustum<T>(p, view), p.points + 3 * i, count, rate);
  p.counts[i] = count, p.rates[i] = rate;
}

template <class T>
SNOW_INLINE void find_spheres(const PointsInSpheresParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n) return;
  const T point[3] = {p.points[3 * i], p.points[3 * i + 1], p.points[3 * i + 2]};
  T count(0), nearest = infinity<T>();
  for (int64_t k = 0; k < p.count; k++) add_sphere(p.spheres + 4 * k, point, count, nearest);
  p.counts[i] = count, p.nearest[i] = nearest;
}

}  // namespace snow

using namespace snow;

SNOW_KERNEL(points_in_frusta, 128, PointsInFrustaParams<float>) { find_frusta(p); }
SNOW_KERNEL(points_in_frusta_f64, 128, PointsInFrustaParams<double>) { find_frusta(p); }
SNOW_KERNEL(points_in_spheres, 128, PointsInSpheresParams<float>) { find_spheres(p); }
SNOW_KERNEL(points_in_spheres_f64, 128, PointsInSpheresParams<double>) { find_spheres(p); }
