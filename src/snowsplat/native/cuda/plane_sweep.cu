// plane_sweep: the inverse depth of every pixel by a plane sweep over several source images.
//
// A block processes a tile of the reference view, one thread per pixel. For each plane and source,
// its threads sample the source at the positions of the tile's pixels, and of a margin, into shared
// memory. Then each thread adds up its window.
#include "cuda/device.h"
#include "plane_sweep.h"

namespace snow {
namespace {

constexpr int kEdge = 16, kThreads = kEdge * kEdge;
constexpr int kWide = kEdge + 2 * kMaxSweepRadius;

// The means over a window.
template <class T>
struct Means {
  T b, bb, ab;
};

template <class T>
class Tile {
 public:
  SNOW_INLINE Tile(const PlaneSweepParams<T>& p, T* reference, T* samples)
      : p_(p), reference_(reference), samples_(samples), radius_(int(p.radius)),
        wide_(kEdge + 2 * radius_), width_(int(p.width)), height_(int(p.height)) {
    const int across = (width_ + kEdge - 1) / kEdge, block = int(blockIdx.x);
    left_ = block % across * kEdge - radius_, top_ = block / across * kEdge - radius_;
    column_ = int(threadIdx.x) % kEdge, row_ = int(threadIdx.x) / kEdge;
  }

  SNOW_INLINE void run() {
    for (int i = int(threadIdx.x); i < wide_ * wide_; i += kThreads) {
      const int x = left_ + i % wide_, y = top_ + i / wide_;
      reference_[i] = in_image(x, y) ? p_.image[int64_t(y) * width_ + x] - T(kSweepMiddle) : T(0);
    }
    __syncthreads();
    const Means<T> mean = window_means(reference_);
    const T deviation = inverse_deviation(mean.b, mean.bb);

    BestPlane<T> best;
    for (int k = 0; k < int(p_.planes); k++) {
      BestTwo<T> two;
      for (int s = 0; s < int(p_.n); s++) {
        sample(s, T(p_.first + double(k) * p_.step));
        __syncthreads();
        const Means<T> means = window_means(samples_);
        two.add(window_correlation(mean.b, deviation, means.b, means.bb, means.ab));
        __syncthreads();  // before the next samples are written
      }
      best.add(T(k), two.score());
    }

    const int x = left_ + radius_ + column_, y = top_ + radius_ + row_;
    if (!in_image(x, y)) return;
    const int64_t at = int64_t(y) * width_ + x;
    const T depth = centre(at) + T(p_.first) + T(p_.step) * best.refined();
    p_.inverse_depth[at] = best.is_valid() ? depth : T(0);
    p_.score[at] = max(best.score, T(-1));
  }

 private:
  SNOW_INLINE bool in_image(int x, int y) const {
    return x >= 0 && y >= 0 && x < width_ && y < height_;
  }
  SNOW_INLINE T centre(int64_t at) const { return p_.centre ? p_.centre[at] : T(0); }

  SNOW_INLINE void sample(int s, T offset) const {
    const int columns = int(p_.source_width), rows = int(p_.source_height);
    const T* source = p_.sources + int64_t(s) * columns * rows;
    for (int i = int(threadIdx.x); i < wide_ * wide_; i += kThreads) {
      const int u = left_ + i % wide_, v = top_ + i / wide_;
      T value = T(0);
      if (in_image(u, v)) {
        T x, y;
        const T w = centre(int64_t(v) * width_ + u) + offset;
        const bool valid = source_position(p_.source_from_pixel + 12 * s, T(u) + T(0.5),
                                           T(v) + T(0.5), w, T(columns - 1), T(rows - 1), x, y);
        value = invalid<T>();
        if (valid) {
          const int column = int(x) < columns - 2 ? int(x) : columns - 2;
          const int row = int(y) < rows - 2 ? int(y) : rows - 2;
          value = bilinear(source + row * columns + column, columns, x - T(column), y - T(row)) -
                  T(kSweepMiddle);
        }
      }
      samples_[i] = value;
    }
  }

  // Of the window of this thread's pixel, in the reference view (a) and in `b`.
  SNOW_INLINE Means<T> window_means(const T* b) const {
    Means<T> sum = {T(0), T(0), T(0)};
    int count = 0;
    for (int j = row_; j <= row_ + 2 * radius_; j++)
      for (int i = column_; i <= column_ + 2 * radius_; i++) {
        const T sample = b[j * wide_ + i];
        sum.b += sample, sum.bb += sample * sample;
        sum.ab += sample * reference_[j * wide_ + i];
        count += in_image(left_ + i, top_ + j);
      }
    const T share = T(1) / T(count);
    return {sum.b * share, sum.bb * share, sum.ab * share};
  }

  const PlaneSweepParams<T>& p_;
  T *const reference_, *const samples_;  // in shared memory, (wide, wide); 0 outside of the image
  const int radius_, wide_, width_, height_;
  int left_, top_;    // of the tile with its margin
  int column_, row_;  // of this thread's pixel in the tile
};

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(plane_sweep, kThreads, PlaneSweepParams<float>) {
  SNOW_SHARED(float, reference, kWide* kWide);
  SNOW_SHARED(float, samples, kWide* kWide);
  Tile<float>(p, reference, samples).run();
}
SNOW_KERNEL(plane_sweep_f64, kThreads, PlaneSweepParams<double>) {
  SNOW_SHARED(double, reference, kWide* kWide);
  SNOW_SHARED(double, samples, kWide* kWide);
  Tile<double>(p, reference, samples).run();
}
