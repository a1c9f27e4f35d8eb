// add_noise: random displacements of the means along their covariances. One thread per row; the
// time is limited by the memory traffic.
#include "cuda/device.h"
#include "noise.h"

using namespace snow;

SNOW_KERNEL(add_noise, 128, AddNoiseParams<float>) {
  const int64_t i = thread_index();
  if (i < p.n) add_noise_to_row(p, i);
}
SNOW_KERNEL(add_noise_f64, 128, AddNoiseParams<double>) {
  const int64_t i = thread_index();
  if (i < p.n) add_noise_to_row(p, i);
}
