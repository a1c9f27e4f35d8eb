// accumulate_screen_statistics: what density control has to know of the splats of a view, in one pass.
// Rows are distinct Gaussians, so no two threads share a sum. One whose gradient is not finite does
// not count.
#include <cmath>
#include <cstdint>

#include "cpu/pool.h"
#include "portable.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 4096;

// Columns of Splats2D: 0 and 1 are the mean, 7 the radius. max_radii may be null.
template <class T>
void accumulate(int64_t m, const int32_t* ids, const T* packed, const T* grad_packed,
                int64_t stride, double width, double height, T* norm_sum, T* views, T* max_radii) {
  const T half_width = T(0.5 * width), half_height = T(0.5 * height);
  parallel_for((m + kBlock - 1) / kBlock, [&](int64_t block) {
    for (int64_t i = block * kBlock; i < m && i < (block + 1) * kBlock; i++) {
      const int32_t row = ids[i];
      if (row < 0) continue;
      const T* g = grad_packed + i * stride;
      const T x = g[0] * half_width, y = g[1] * half_height;
      const T norm = std::sqrt(x * x + y * y);
      if (!is_finite(norm)) continue;
      norm_sum[row] += norm;
      views[row] += T(1);
      if (max_radii) {
        T& largest = max_radii[row];
        largest = packed[i * stride + 7] > largest ? packed[i * stride + 7] : largest;
      }
    }
  });
}

}  // namespace
}  // namespace snow

#define SNOW_STATISTIC_ENTRY(NAME, T)                                                            \
  SNOW_EXPORT int64_t NAME(int64_t m, const int32_t* ids, const T* packed, const T* grad_packed, \
                           int64_t stride, double width, double height, T* norm_sum, T* views,   \
                           T* max_radii, const bool* valid) {                                    \
    if (valid && !*valid) return 0;                                                              \
    snow::accumulate(m, ids, packed, grad_packed, stride, width, height, norm_sum, views,        \
                     max_radii);                                                                 \
    return 0;                                                                                    \
  }

SNOW_STATISTIC_ENTRY(accumulate_screen_statistics, float)
SNOW_STATISTIC_ENTRY(accumulate_screen_statistics_f64, double)
