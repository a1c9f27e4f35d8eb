// accumulate_screen_statistics: what density control has to know of the splats of a view. A thread a
// splat; rows are distinct Gaussians, so no two threads share a sum. One whose gradient is not finite
// does not count.
#include "cuda/device.h"

namespace snow {
namespace {

// Columns of Splats2D: 0 and 1 are the mean, 7 the radius. max_radii may be null.
template <class T>
SNOW_INLINE void accumulate(int64_t m, const int32_t* ids, const T* packed, const T* grad_packed,
                            int64_t stride, T half_width, T half_height, T* norm_sum, T* views,
                            T* max_radii, const bool* valid) {
  const int64_t i = thread_index();
  if (i >= m || (valid && !*valid)) return;
  const int32_t row = ids[i];
  if (row < 0) return;
  const T* g = grad_packed + i * stride;
  const T x = g[0] * half_width, y = g[1] * half_height;
  const T norm = sqrt(x * x + y * y);
  if (!is_finite(norm)) return;
  norm_sum[row] += norm;
  views[row] += T(1);
  if (max_radii) max_radii[row] = max(packed[i * stride + 7], max_radii[row]);
}

}  // namespace
}  // namespace snow

#define SNOW_STATISTIC_KERNEL(NAME, T)                                                         \
  SNOW_KERNEL(                                                                                 \
      NAME, 256,                                                                               \
      (int64_t m, const int32_t* ids, const T* packed, const T* grad_packed, int64_t stride,   \
       double width, double height, T* norm_sum, T* views, T* max_radii, const bool* valid)) { \
    snow::accumulate(m, ids, packed, grad_packed, stride, T(0.5 * width), T(0.5 * height),     \
                     norm_sum, views, max_radii, valid);                                       \
  }

SNOW_STATISTIC_KERNEL(accumulate_screen_statistics, float)
SNOW_STATISTIC_KERNEL(accumulate_screen_statistics_f64, double)
