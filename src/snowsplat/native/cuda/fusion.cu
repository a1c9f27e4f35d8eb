// fuse_depth: adds a depth map to a truncated signed distance field. One thread per sample.
#include "cuda/device.h"
#include "fusion.h"

namespace snow {

template <class T>
SNOW_INLINE void fuse(const FuseDepthParams<T>& p) {
  const int64_t i = thread_index();
  if (i >= p.n) return;
  const int64_t samples = p.side * p.side * p.side, local = i % samples;
  const int64_t index[3] = {local % p.side, local / p.side % p.side, local / (p.side * p.side)};
  T point[3], at[3];
  for (int c = 0; c < 3; c++)
    point[c] = p.origins[i / samples * 3 + c] + T(index[c]) * T(p.spacing);
  for (int c = 0; c < 3; c++) {
    const T* row = p.to_image + 4 * c;
    at[c] = row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + row[3];
  }
  const T u = at[0] / at[2], v = at[1] / at[2];
  if (!(at[2] > T(0) && u >= T(0) && v >= T(0) && u < T(p.width) && v < T(p.height))) return;
  const PixelIndex<T> pixels(int(p.width), int(p.height), u, v);
  T s, *sums = p.sums + i * (2 + p.channels);
  const T w = weight_of_sample(pixels.load(p.depth), at[2], p.weight[pixels.nearest()],
                               T(p.truncation), p.channels > 0, s);
  if (!(w > T(0))) return;
  sums[0] += w, sums[1] += w * s;
  add_colours(p, pixels, w, sums + 2);
}

}  // namespace snow

using namespace snow;

SNOW_KERNEL(fuse_depth, 128, FuseDepthParams<float>) { fuse(p); }
SNOW_KERNEL(fuse_depth_f64, 128, FuseDepthParams<double>) { fuse(p); }
