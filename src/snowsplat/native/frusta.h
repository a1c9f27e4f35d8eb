// points_in_frusta and points_in_spheres for one point and one camera, for CPU and GPU.
#pragma once

#include "params.h"

namespace snow {

// A camera of PointsInFrustaParams.
template <class T>
struct Frustum {
  const T* to_image;
  T width, height, near, far, focal;

  SNOW_INLINE Frustum(const PointsInFrustaParams<T>& p, int64_t i)
      : to_image(p.to_image + 12 * i), width(p.size[2 * i]), height(p.size[2 * i + 1]),
        near(p.depths[2 * i]), far(p.depths[2 * i + 1]), focal(p.focal[i]) {}
};

// Adds to `count` whether the frustum contains the point, and raises `rate` to focal / z if it does.
// (u z, v z, z) = K [R | t] (x, 1); the point is in the image if 0 ≤ u z < width · z, and so on.
template <class Real, class T>
SNOW_INLINE void add_frustum(const Frustum<T>& f, const Real* point, Real& count, Real& rate) {
  Real at[3];
  for (int k = 0; k < 3; k++) {
    const T* row = f.to_image + 4 * k;
    at[k] =
        Real(row[0]) * point[0] + Real(row[1]) * point[1] + Real(row[2]) * point[2] + Real(row[3]);
  }
  const Real zero(T(0)), z = at[2];
  const auto inside = (z > Real(f.near)) & (Real(f.far) > z) & (at[0] >= zero) & (at[1] >= zero) &
                      (Real(f.width) * z > at[0]) & (Real(f.height) * z > at[1]);
  count = count + select(inside, Real(T(1)), zero);
  rate = max(rate, select(inside, Real(f.focal) / z, zero));
}

// Adds to `count` whether the sphere (centre, radius) contains the point, and lowers `nearest` to the
// distance of its centre. The differences are exact for a near point, unlike |a|² + |b|² − 2 a·b.
template <class Real, class T>
SNOW_INLINE void add_sphere(const T* sphere, const Real* point, Real& count, Real& nearest) {
  const Real x = point[0] - Real(sphere[0]), y = point[1] - Real(sphere[1]),
             z = point[2] - Real(sphere[2]);
  const Real distance = sqrt(fma(z, z, fma(y, y, x * x))), zero(T(0));
  count = count + select(Real(sphere[3]) > distance, Real(T(1)), zero);
  nearest = min(nearest, distance);
}

}  // namespace snow
