// accumulate_screen_statistics: adds the splats of a view to the statistics of density control. One
// thread per splat.
#include "cuda/device.h"
#include "statistic.h"

namespace snow {

template <class T>
SNOW_INLINE void accumulate(const ScreenStatisticsParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n || (p.valid && !*p.valid)) return;
  accumulate_splat(p, i, T(0.5 * p.width), T(0.5 * p.height));
}

}  // namespace snow

using namespace snow;

SNOW_KERNEL(accumulate_screen_statistics, 256, ScreenStatisticsParams<float>) { accumulate(p); }
SNOW_KERNEL(accumulate_screen_statistics_f64, 256, ScreenStatisticsParams<double>) {
  accumulate(p);
}
