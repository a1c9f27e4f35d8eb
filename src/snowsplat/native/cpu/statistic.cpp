// accumulate_screen_statistics: adds the splats of a view to the statistics of density control.
#include "statistic.h"

#include "cpu/entry.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 4096;  // splats per task

template <class T>
int64_t accumulate(const ScreenStatisticsParams<T>& p) {
  if (p.valid && !*p.valid) return 0;
  const T half_width = T(0.5 * p.width), half_height = T(0.5 * p.height);
  parallel_for((p.n + kBlock - 1) / kBlock, [&](int64_t block) {
    for (int64_t i = block * kBlock; i < p.n && i < (block + 1) * kBlock; i++)
      accumulate_splat(p, i, half_width, half_height);
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(accumulate_screen_statistics, ScreenStatisticsParams<float>) { return accumulate(p); }
SNOW_ENTRY(accumulate_screen_statistics_f64, ScreenStatisticsParams<double>) {
  return accumulate(p);
}
