// add_noise: random displacements of the means along their covariances.
#include "noise.h"

#include <algorithm>

#include "cpu/entry.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 4096;  // rows per task

template <class T>
int64_t add_to_rows(const AddNoiseParams<T>& p) {
  parallel_for((p.n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t end = std::min(p.n, (block + 1) * kBlock);
    for (int64_t i = block * kBlock; i < end; i++) add_noise_to_row(p, i);
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(add_noise, AddNoiseParams<float>) { return add_to_rows(p); }
SNOW_ENTRY(add_noise_f64, AddNoiseParams<double>) { return add_to_rows(p); }
