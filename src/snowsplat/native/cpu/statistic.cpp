// accumulate_screen_gradients: the statistic by which density control chooses whom to densify, in one
// pass over the gradient of the splats. Rows are distinct Gaussians, so no two threads share a sum.
#include <cmath>
#include <cstdint>

#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 4096;

template <class T>
void accumulate(int64_t m, const int32_t* ids, const T* grad_packed, int64_t stride, double width,
                double height, T* norm_sum, T* views) {
  const T half_width = T(0.5 * width), half_height = T(0.5 * height);
  parallel_for((m + kBlock - 1) / kBlock, [&](int64_t block) {
    for (int64_t i = block * kBlock; i < m && i < (block + 1) * kBlock; i++) {
      const T x = grad_packed[i * stride] * half_width,
              y = grad_packed[i * stride + 1] * half_height;
      norm_sum[ids[i]] += std::sqrt(x * x + y * y);
      views[ids[i]] += T(1);
    }
  });
}

}  // namespace
}  // namespace snow

#define SNOW_STATISTIC_ENTRY(NAME, T)                                                           \
  SNOW_EXPORT int64_t NAME(int64_t m, const int32_t* ids, const T* grad_packed, int64_t stride, \
                           double width, double height, T* norm_sum, T* views) {                \
    snow::accumulate(m, ids, grad_packed, stride, width, height, norm_sum, views);              \
    return 0;                                                                                   \
  }

SNOW_STATISTIC_ENTRY(accumulate_screen_gradients, float)
SNOW_STATISTIC_ENTRY(accumulate_screen_gradients_f64, double)
