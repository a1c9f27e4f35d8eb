// accumulate_screen_statistics for one splat, for CPU and GPU.
#pragma once

#include "params.h"

namespace snow {

// The ids are distinct, so two threads never add to the same sum. A splat with a non-finite
// gradient is skipped. Columns of Splats2D: 0 and 1 are the mean, 7 the radius.
template <class T>
SNOW_INLINE void accumulate_splat(const ScreenStatisticsParams<T>& p, int64_t i, T half_width,
                                  T half_height) {
  const int32_t row = p.ids[i];
  if (row < 0) return;
  const T* g = p.grad_means + i * p.grad_stride;
  const T x = g[0] * half_width, y = g[1] * half_height;
  const T norm = sqrt(x * x + y * y);
  if (!is_finite(norm)) return;
  p.norm_sum[row] += norm;
  p.views[row] += T(1);
  if (p.max_radii) p.max_radii[row] = max(p.packed[i * p.stride + 7], p.max_radii[row]);
}

}  // namespace snow
