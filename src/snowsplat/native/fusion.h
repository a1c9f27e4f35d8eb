// fuse_depth for samples, for CPU and GPU: the pixels around a sample, and what they say about it.
#pragma once

#include "params.h"

namespace snow {

// Four neighbouring pixels, and a position in units of a pixel from the centre of the first one:
// between the centres 0 to 1; at the border of the image, down to −1/2 or up to 3/2.
template <class Real>
struct FourPixels {
  Real a, b, c, d;  // above left, above right, below left, below right
  Real fx, fy;

  SNOW_INLINE auto is_between() const {
    return (fx >= Real(0.f)) & (fx < Real(1.f)) & (fy >= Real(0.f)) & (fy < Real(1.f));
  }
  SNOW_INLINE Real nearest() const {
    const auto right = fx >= Real(0.5f);
    return select(fy >= Real(0.5f), select(right, d, c), select(right, b, a));
  }
  SNOW_INLINE Real interpolated() const {
    const Real above = a + fx * (b - a), below = c + fx * (d - c);
    return above + fy * (below - above);
  }
  // Across the edge of an object, an interpolated depth would be in the air.
  SNOW_INLINE Real depth(Real truncation) const {
    const Real low = min(min(a, b), min(c, d)), high = max(max(a, b), max(c, d));
    const auto smooth = is_between() & (low > Real(0.f)) & (high - low < truncation);
    return select(smooth, interpolated(), nearest());
  }
};

// The weight of a sample at the depth z, 0 if it is hidden, and its signed distance s (Curless and
// Levoy 1996). `weight`: of the nearest pixel. A `surface` is not at samples in front of it.
template <class Real>
SNOW_INLINE Real weight_of_sample(const FourPixels<Real>& depths, Real z, Real weight,
                                  Real truncation, bool surface, Real& s) {
  const Real nearest = depths.nearest();
  s = (depths.depth(truncation) - z) / truncation;
  const auto known = (weight > Real(0.f)) & (nearest > Real(0.f)) & (z - nearest < truncation) &
                     (s > Real(-1.f)) & (Real(surface ? 1.f : 2.f) > min(s, Real(1.f)));
  // Less behind the surface, where the other side of something thin may be.
  const Real w = select(known, weight * min(Real(1.f), Real(1.f) + s), Real(0.f));
  s = select(known, min(s, Real(1.f)), Real(0.f));
  return w;
}

// The four pixels around (u, v) pixels, which is inside of the image. In an image that is one pixel
// wide or high, there are no four: the position is at the border.
template <class T>
struct PixelIndex {
  int first, right, below;  // the first pixel; the steps to the right and downwards
  T fx, fy;

  SNOW_INLINE PixelIndex(int width, int height, T u, T v)
      : right(width > 1), below(height > 1 ? width : 0) {
    const T x = u - T(0.5), y = v - T(0.5);
    const int column = int(x) < width - 1 ? int(x) : width - 1 - right;
    const int row = int(y) < height - 1 ? int(y) : height - 1 - (height > 1);
    first = row * width + column;
    fx = right ? x - T(column) : T(-0.5), fy = below ? y - T(row) : T(-0.5);
  }
  SNOW_INLINE int nearest() const {
    return first + (fx >= T(0.5) ? right : 0) + (fy >= T(0.5) ? below : 0);
  }
  SNOW_INLINE FourPixels<T> load(const T* image) const {
    const T* at = image + first;
    return {at[0], at[right], at[below], at[below + right], fx, fy};
  }
};

// Adds the colours of the four pixels around (u, v) to the sums of a sample with the weight w.
template <class T>
SNOW_INLINE void add_colours(const FuseDepthParams<T>& p, const PixelIndex<T>& at, T w, T* sums) {
  for (int k = 0; k < int(p.channels); k++) {
    const FourPixels<T> c = at.load(p.image + k * p.width * p.height);
    sums[k] += w * (c.is_between() ? c.interpolated() : c.nearest());
  }
}

}  // namespace snow
