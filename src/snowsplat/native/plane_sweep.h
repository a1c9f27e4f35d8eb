// plane_sweep for one pixel, for CPU and GPU: its position in a source image, the correlation of
// two windows, the score of a plane, and the refinement of the best plane.
//
// A position, sum or score that is not valid is NaN: arithmetic keeps it, and comparisons with it
// are false. So pixels outside of a source need no counters.
#pragma once

#include "portable.h"

namespace snow {

// Subtracted from luminances in [0, 1]. The variance is a difference of two sums, whose rounding
// errors grow with the square of the luminances.
constexpr double kSweepMiddle = 0.5;
// Of the luminances of a window: a standard deviation of one 8-bit level. A window of the reference
// view with a smaller variance has no score.
constexpr double kSweepMinVariance = 1.0 / (255.0 * 255.0);
// The score of a plane that no source sees; less than every correlation.
constexpr double kSweepNoScore = -2.0;

// The position of the pixel with centre (u, v) at inverse depth w in a source, in pixels from the
// centre of its first pixel. Returns whether it lies between the centres of the first and the last
// pixel, where `right` and `bottom` are the coordinates of the last. map: [A | b], (3, 4).
template <class Real>
SNOW_INLINE bool source_position(const Real* map, Real u, Real v, Real w, Real right, Real bottom,
                                 Real& x, Real& y) {
  const Real z = map[8] * u + (map[9] * v + map[10]) + map[11] * w;
  const Real inverse = Real(1) / z;
  x = (map[0] * u + (map[1] * v + map[2]) + map[3] * w) * inverse - Real(0.5);
  y = (map[4] * u + (map[5] * v + map[6]) + map[7] * w) * inverse - Real(0.5);
  return (z > Real(0)) & (w >= Real(0)) & (x >= Real(0)) & (y >= Real(0)) & (x <= right) &
         (y <= bottom);
}

// Bilinear interpolation between `at` and its neighbours to the right and below.
template <class Real>
SNOW_INLINE Real bilinear(const Real* at, int64_t stride, Real fx, Real fy) {
  const Real upper = at[0] + fx * (at[1] - at[0]);
  const Real lower = at[stride] + fx * (at[stride + 1] - at[stride]);
  return upper + fy * (lower - upper);
}

template <class Real>
SNOW_INLINE Real invalid() {  // NaN
  return sqrt(Real(-1.f));
}

// 1/σ of a window from the means of a and a², or NaN if its variance is too small.
template <class Real>
SNOW_INLINE Real inverse_deviation(Real mean, Real mean_square) {
  const Real variance = mean_square - mean * mean, least(kSweepMinVariance);
  return select(variance >= least, Real(1.f) / sqrt(variance), invalid<Real>());
}

// The zero-mean normalised cross-correlation of a window of the reference view (a) and one of a
// source (b), or kSweepNoScore. A variance of b below kSweepMinVariance counts as this variance.
template <class Real>
SNOW_INLINE Real window_correlation(Real mean_a, Real inverse_deviation_a, Real mean_b,
                                    Real mean_bb, Real mean_ab) {
  const Real variance = max(mean_bb - mean_b * mean_b, Real(kSweepMinVariance));
  const Real correlation = (mean_ab - mean_a * mean_b) * inverse_deviation_a / sqrt(variance);
  const Real clamped = max(min(correlation, Real(1.f)), Real(-1.f));
  return select(correlation >= Real(-1.5f), clamped, Real(kSweepNoScore));
}

// The two best correlations of a plane.
template <class Real>
struct BestTwo {
  Real first = Real(kSweepNoScore), second = Real(kSweepNoScore);

  SNOW_INLINE void add(Real correlation) {
    second = max(second, min(first, correlation));
    first = max(first, correlation);
  }
  // Their mean, or the only one.
  SNOW_INLINE Real score() const {
    return select(second >= Real(-1.f), Real(0.5f) * (first + second), first);
  }
};

// The best plane so far, and the scores of the planes before and after it.
template <class Real>
struct BestPlane {
  Real plane = Real(-2.f), score = Real(kSweepNoScore);
  Real before = Real(kSweepNoScore), after = Real(kSweepNoScore);
  Real previous = Real(kSweepNoScore);  // of the last plane that was added

  // Adds the planes in order, k = 0, 1, …
  SNOW_INLINE void add(Real k, Real added) {
    after = select(plane >= k - Real(1.f), added, after);
    const auto better = added > score;
    plane = select(better, k, plane);
    score = select(better, added, score);
    before = select(better, previous, before);
    after = select(better, Real(kSweepNoScore), after);
    previous = added;
  }
  SNOW_INLINE auto is_valid() const { return score >= Real(-1.f); }
  // The maximum of the parabola through the scores, in planes; the plane itself if a neighbour has
  // no score. `before` is less than `score`, so the curvature is negative.
  SNOW_INLINE Real refined() const {
    const Real shift = Real(0.5f) * (before - after) / (before - score + (after - score));
    return plane + select(min(before, after) >= Real(-1.f), shift, Real(0.f));
  }
};

}  // namespace snow
