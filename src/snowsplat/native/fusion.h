// fuse_depth for one sample, for CPU and GPU.
#pragma once

#include "params.h"

namespace snow {

// Adds what a depth map says about a sample to its sums (Curless and Levoy 1996). The sample is shown
// at (u, v) pixels, which are inside of the depth map, with the depth z > 0.
template <class T>
SNOW_INLINE void fuse_sample(const FuseDepthParams<T>& p, T u, T v, T z, T* sums) {
  const int width = int(p.width), column = int(u), row = int(v);
  const int nearest = row * width + column;
  const T weight = p.weight[nearest], truncation = T(p.truncation);
  T depth = p.depth[nearest];
  if (!(weight > T(0)) || !(depth > T(0)) || z - depth >= truncation) return;
  // The four pixels whose centres are around (u, v), if there are four.
  const T x = u - T(0.5), y = v - T(0.5);
  const int left = x < T(0) ? -1 : int(x), top = y < T(0) ? -1 : int(y);
  const bool inner = left >= 0 && top >= 0 && left + 1 < width && top + 1 < int(p.height);
  const int first = inner ? top * width + left : 0;
  const T fx = x - T(left), fy = y - T(top);
  if (inner) {
    const T* d = p.depth + first;
    const T a = d[0], b = d[1], c = d[width], e = d[width + 1];
    const T low = min(min(a, b), min(c, e)), high = max(max(a, b), max(c, e));
    // Across the edge of an object, an interpolated depth would be in the air.
    if (low > T(0) && high - low < truncation) {
      const T above = a + fx * (b - a), below = c + fx * (e - c);
      depth = above + fy * (below - above);
    }
  }
  const T signed_distance = (depth - z) / truncation;
  if (!(signed_distance > T(-1))) return;
  const bool free = signed_distance >= T(1);
  if (free && p.channels > 0) return;
  const T s = free ? T(1) : signed_distance;
  // Less behind the surface, where the other side of something thin may be.
  const T w = s < T(0) ? weight * (T(1) + s) : weight;
  sums[0] += w, sums[1] += w * s;
  for (int k = 0; k < int(p.channels); k++) {
    const T* c = p.image + k * p.width * p.height;
    T colour = c[nearest];
    if (inner) {
      const T* d = c + first;
      const T above = d[0] + fx * (d[1] - d[0]);
      const T below = d[width] + fx * (d[width + 1] - d[width]);
      colour = above + fy * (below - above);
    }
    sums[2 + k] += w * colour;
  }
}

}  // namespace snow
