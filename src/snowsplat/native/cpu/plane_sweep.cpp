// plane_sweep: the inverse depth of every pixel by a plane sweep over several source images.
//
// A task is a tile of the reference view. For each plane it processes the rows from top to bottom:
// it samples a row of every source at the positions of the tile's pixels on this plane, into a ring
// buffer of 2 radius + 1 rows. Then it adds the windows, first the columns and then the rows, and
// updates the best plane of each pixel. Sums are computed anew for each window. So their rounding
// errors do not accumulate, an invalid sample (NaN) affects its own windows only, and results do
// not depend on the tiles.
#include "plane_sweep.h"

#include <algorithm>
#include <cmath>
#include <memory>

#include "cpu/entry.h"
#include "cpu/pool.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int kColumns = 256, kRows = 32;  // maximum size of a tile
constexpr int kMargin = 16;                // columns of buffer on each side
constexpr int kRow = kColumns + 2 * kMargin;
constexpr int kTaps = 2 * kMaxSweepRadius + 1;

template <class V>
class Tile {
  using T = typename V::Scalar;
  static constexpr int W = V::width;

 public:
  Tile(const PlaneSweepParams<T>& p, Range columns, Range rows)
      : p_(p), radius_(int(p.radius)), x0_(int(columns.begin)), y0_(int(rows.begin)),
        width_(int(columns.end - columns.begin)), height_(int(rows.end - rows.begin)),
        left_(int(std::max<int64_t>(0, columns.begin - p.radius))),
        right_(int(std::min(p.width, columns.end + p.radius))) {}

  void run() {
    load_reference();
    const int64_t last = std::min<int64_t>(p_.height, y0_ + height_ + radius_);
    for (int64_t k = 0; k < p_.planes; k++) {
      const T offset = T(p_.first + double(k) * p_.step);
      for (int64_t y = std::max(0, y0_ - radius_); y < y0_ + height_ + radius_; y++) {
        if (y < last)
          for (int s = 0; s < p_.n; s++) sample_row(s, int(y), offset);
        if (y >= y0_ + radius_) score_row(int(y) - y0_ - radius_, T(k));
      }
    }
    write();
  }

 private:
  // The rows of a window that lie in the image, of buffers with rows y0 − radius, …
  struct Window {
    int begin, end;
    Window(const Tile& t, int row)
        : begin(std::max(row, t.radius_ - t.y0_)),
          end(int(std::min<int64_t>(row + 2 * t.radius_ + 1, t.p_.height - t.y0_ + t.radius_))) {}
  };

  // Also prepares the means, deviations and sizes of the windows.
  void load_reference() {
    for (int y = std::max(0, y0_ - radius_);
         y < std::min<int64_t>(p_.height, y0_ + height_ + radius_); y++) {
      const int row = y - y0_ + radius_;
      for (int x = left_; x < right_; x++) {
        const int64_t at = y * p_.width + x;
        reference_[row][x - x0_ + kMargin] = p_.image[at] - T(kSweepMiddle);
        if (p_.centre) centre_[row][x - x0_ + kMargin] = p_.centre[at];
      }
    }
    for (int x = 0; x < width_; x++) {
      const int64_t begin = std::max(0, x0_ + x - radius_);
      inverse_columns_[x] = T(1) / T(std::min(p_.width, x0_ + x + radius_ + int64_t(1)) - begin);
    }
    for (int row = 0; row < height_; row++) {
      const Window window(*this, row);
      const T* rows[kTaps];
      for (int j = window.begin; j < window.end; j++) rows[j - window.begin] = reference_[j];
      add_columns(rows, rows, window.end - window.begin);
      for (int x = 0; x < width_; x += W) {
        V mean, mean_square, mean_product;
        add_rows(x, window, mean, mean_square, mean_product);
        mean.store(mean_[row] + x);
        inverse_deviation(mean, mean_square).store(inverse_deviation_[row] + x);
      }
    }
  }

  // Samples source s at the positions of row y. The first loop is vectorised by the compiler; the
  // second one loads from other places for every pixel.
  void sample_row(int s, int y, T offset) {
    T map[12];
    std::copy_n(p_.source_from_pixel + 12 * s, 12, map);
    const int columns = int(p_.source_width), rows = int(p_.source_height);
    const T v = T(y) + T(0.5), right = T(columns - 1), bottom = T(rows - 1);
    const int count = right_ - left_, begin = left_ - x0_ + kMargin;
    const T* centre = centre_[y - y0_ + radius_] + begin;
    T fx[kRow], fy[kRow];
    int32_t index[kRow];
    for (int i = 0; i < count; i++) {
      T x, y;
      const bool valid =
          source_position(map, T(left_ + i) + T(0.5), v, centre[i] + offset, right, bottom, x, y);
      const int column = std::min(int(valid ? x : T(0)), columns - 2);
      const int row = std::min(int(valid ? y : T(0)), rows - 2);
      index[i] = row * columns + column;
      fx[i] = valid ? x - T(column) : invalid<T>();
      fy[i] = y - T(row);
    }
    const T* source = p_.sources + s * p_.source_width * p_.source_height;
    T* samples = samples_[s][y % (2 * radius_ + 1)] + begin;
    for (int i = 0; i < count; i++)
      samples[i] = bilinear(source + index[i], columns, fx[i], fy[i]) - T(kSweepMiddle);
  }

  void score_row(int row, T k) {
    const Window window(*this, row);
    const int count = window.end - window.begin, taps = 2 * radius_ + 1;
    BestTwo<V> best[kColumns / W];
    for (int s = 0; s < p_.n; s++) {
      const T *a[kTaps], *b[kTaps];
      for (int j = 0; j < count; j++) {
        a[j] = reference_[window.begin + j];
        b[j] = samples_[s][(window.begin + j + y0_ - radius_) % taps];
      }
      add_columns(a, b, count);
      for (int x = 0; x < width_; x += W) {
        V mean, mean_square, mean_product;
        add_rows(x, window, mean, mean_square, mean_product);
        best[x / W].add(window_correlation(V::load(mean_[row] + x),
                                           V::load(inverse_deviation_[row] + x), mean, mean_square,
                                           mean_product));
      }
    }
    for (int x = 0; x < width_; x += W) best_[row][x / W].add(V(k), best[x / W].score());
  }

  // The sums of b, b² and ab over the rows of a window, for every column of the buffer.
  void add_columns(const T* const* a, const T* const* b, int count) {
    for (int x = (kMargin - radius_) / W * W; x < kMargin + width_ + radius_; x += W) {
      V sum(0.f), square(0.f), product(0.f);
      for (int j = 0; j < count; j++) {
        const V sample = V::load(b[j] + x);
        sum += sample, square += sample * sample, product += sample * V::load(a[j] + x);
      }
      sum.store(sums_[0] + x), square.store(sums_[1] + x), product.store(sums_[2] + x);
    }
  }
  // The means over the windows at column x and those after it, from these sums.
  SNOW_INLINE void add_rows(int x, const Window& window, V& mean, V& mean_square,
                            V& mean_product) const {
    V sum(0.f), square(0.f), product(0.f);
    const int begin = x + kMargin - radius_;
    for (int i = begin; i <= begin + 2 * radius_; i++)
      sum += V::load(sums_[0] + i), square += V::load(sums_[1] + i),
          product += V::load(sums_[2] + i);
    const V share = V::load(inverse_columns_ + x) * V(T(1) / T(window.end - window.begin));
    mean = sum * share, mean_square = square * share, mean_product = product * share;
  }

  void write() const {
    for (int row = 0; row < height_; row++)
      for (int x = 0; x < width_; x += W) {
        const BestPlane<V>& best = best_[row][x / W];
        const V centre = V::load(centre_[row + radius_] + kMargin + x);
        const V depth = centre + V(p_.first) + V(p_.step) * best.refined();
        const int64_t at = (y0_ + row) * p_.width + x0_ + x;
        const int lanes = std::min(W, width_ - x);
        select(best.is_valid(), depth, V(0.f)).store_first(p_.inverse_depth + at, lanes);
        max(best.score, V(-1.f)).store_first(p_.score + at, lanes);
      }
  }

  const PlaneSweepParams<T>& p_;
  const int radius_, x0_, y0_, width_, height_;
  const int left_, right_;  // columns of the image that the windows contain
  // Buffers; 0 outside of the image.
  alignas(64) T reference_[kRows + 2 * kMaxSweepRadius][kRow] = {};  // minus kSweepMiddle
  alignas(64) T centre_[kRows + 2 * kMaxSweepRadius][kRow] = {};
  alignas(64) T samples_[kMaxSweepSources][kTaps][kRow] = {};
  alignas(64) T sums_[3][kRow] = {};
  alignas(64) T inverse_columns_[kColumns] = {};  // 1 / columns of a window
  alignas(64) T mean_[kRows][kColumns], inverse_deviation_[kRows][kColumns];
  alignas(64) BestPlane<V> best_[kRows][kColumns / W];
};

template <class V>
int64_t sweep(const PlaneSweepParams<typename V::Scalar>& p) {
  const int64_t across = (p.width + kColumns - 1) / kColumns, down = (p.height + kRows - 1) / kRows;
  parallel_for(across * down, [&](int64_t task) {
    const Range columns = split_range(p.width, across, task % across);
    const Range rows = split_range(p.height, down, task / across);
    std::make_unique<Tile<V>>(p, columns, rows)->run();
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(plane_sweep, PlaneSweepParams<float>) { return sweep<VecF>(p); }
SNOW_ENTRY(plane_sweep_f64, PlaneSweepParams<double>) { return sweep<VecD>(p); }
