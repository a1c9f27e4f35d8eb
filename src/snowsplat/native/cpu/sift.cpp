// detect_sift: features of a grey photo, and their descriptors, after Lowe, "Distinctive image
// features from scale-invariant keypoints", IJCV 2004.
//
// Each octave has six levels of blur. Their rows are computed when they are needed: a row of a level
// follows the rows of the level before it that are under its kernel, so these are still in the cache.
// Only the levels of which gradients are needed are kept; of the others a ring of rows. The largest
// features are chosen before orientations and descriptors are computed.
//
// Photos are processed in several threads, so a call uses only the thread of its caller.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <new>
#include <tuple>
#include <vector>

#include "cpu/entry.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int kLayers = 3;            // of an octave, in which features are found
constexpr int kLevels = kLayers + 3;  // of blur
constexpr int kDifferences = kLevels - 1;
constexpr double kSigma = 1.6;       // pixels, of the first level of an octave
constexpr double kPhotoSigma = 0.5;  // pixels, the blur that a photo is assumed to have
constexpr float kContrast = 0.02f * 255 / kLayers;  // of a feature, in grey values
constexpr float kLeastDifference = kContrast / 2;   // of its pixel
constexpr double kEdge = 10;        // the largest ratio of the two principal curvatures
constexpr int kBorder = 5;          // pixels of an octave where no features are searched
constexpr int kSteps = 5;           // of a pixel, in the search for an extremum
constexpr int kReach = kSteps + 1;  // rows beside that of an extremum

constexpr int kBins = 36;       // of the histogram of orientations
constexpr float kPeak = 0.8f;   // of the largest bin: a further orientation
constexpr int kCells = 4;       // of a descriptor, along each side
constexpr int kDirections = 8;  // of a cell
constexpr int kValues = kCells * kCells * kDirections;
constexpr float kCellSize = 3;  // in scales of the feature
constexpr float kClamp = 0.2f;  // of the norm of a descriptor
constexpr float kNorm = 512;    // of a descriptor in bytes

constexpr int kMargin = 64;  // numbers beside a row that whole vectors may access
constexpr int kAlign = 64;   // bytes
constexpr double kPi = 3.14159265358979323846;

// A Gaussian of which the weights of −radius … radius are not negligible.
struct Blur {
  explicit Blur(double sigma) : radius((int(std::lround(8 * sigma + 1)) | 1) / 2) {
    double sum = 0;
    for (int i = -radius; i <= radius; i++) sum += std::exp(-i * i / (2 * sigma * sigma));
    for (int i = 0; i <= radius; i++)
      weight.push_back(float(std::exp(-i * i / (2 * sigma * sigma)) / sum));
  }
  int radius;
  std::vector<float> weight;
};

// The blur that leads from a standard deviation to a larger one.
Blur blur_between(double from, double to) { return Blur(std::sqrt(to * to - from * from)); }

int64_t padded(int64_t width) { return (width + kMargin - 1) / kMargin * kMargin; }

// Numbers that are not initialised, with a margin at both ends.
class Buffer {
 public:
  explicit Buffer(int64_t size) : memory_(new float[size + 2 * kMargin + kAlign / sizeof(float)]) {
    const auto start = reinterpret_cast<uintptr_t>(memory_.get() + kMargin);
    data_ = reinterpret_cast<float*>((start + kAlign - 1) / kAlign * kAlign);
  }
  float* data() const { return data_; }

 private:
  std::unique_ptr<float[]> memory_;
  float* data_;
};

// Rows of an image; of a ring of rows, the last ones.
class Level {
 public:
  Level(int64_t width, int64_t rows)
      : stride_(padded(width)), rows_(rows), buffer_(stride_ * rows) {}
  float* row(int64_t y) const { return buffer_.data() + y % rows_ * stride_; }

  int64_t done = 0;  // the number of rows that were computed

 private:
  int64_t stride_, rows_;
  Buffer buffer_;
};

// The pixel at i of an image of n pixels that is reflected about its first and its last pixel.
int64_t reflected(int64_t i, int64_t n) {
  while (i < 0 || i >= n) i = n == 1 ? 0 : i < 0 ? -i : 2 * (n - 1) - i;
  return i;
}

// The Gaussians of one octave, row by row.
template <class V>
class Octave {
 public:
  // `source` writes a row. It is blurred before it is the first level, unless `first` is null.
  Octave(int64_t width, int64_t height, std::function<void(int64_t, float*)> source,
         const Blur* first)
      : width(width), height(height), source_(std::move(source)), first_(first ? 1 : 0),
        column_(padded(width)) {
    blurs_.push_back(Blur(0));  // not used
    if (first) blurs_.push_back(*first);
    for (int i = 1; i < kLevels; i++)
      blurs_.push_back(blur_between(kSigma * std::exp2((i - 1.0) / kLayers),
                                    kSigma * std::exp2(double(i) / kLayers)));
    int64_t lead = 0;
    for (int i = int(blurs_.size()) - 1; i >= 0; i--) {
      const int level = i - first_;
      const bool kept = level >= 1 && level <= kLayers;
      const int64_t rows = lead + 2 * kReach + 2;  // also enough for the kernel of the next level
      levels_.emplace_back(width, kept ? height : std::min(height, rows));
      lead += i ? blurs_[i].radius : 0;
    }
    std::reverse(levels_.begin(), levels_.end());
  }

  // A row of a level; rows are computed in ascending order.
  const float* row(int level, int64_t y) const { return levels_[level + first_].row(y); }
  // Computes the rows of all levels up to y.
  void advance(int64_t y) { advance(int(levels_.size()) - 1, y); }
  // Frees the levels that are not kept.
  void keep() {
    for (int i = 0; i < int(levels_.size()); i++)
      if (i < 1 + first_ || i > kLayers + first_) levels_[i] = Level(0, 0);
  }

  const int64_t width, height;

 private:
  void advance(int i, int64_t until) {
    Level& to = levels_[i];
    until = std::min(until, height - 1);
    for (; to.done <= until; to.done++) {
      if (i == 0) {
        source_(to.done, to.row(to.done));
      } else {
        advance(i - 1, to.done + blurs_[i].radius);
        blur(blurs_[i], levels_[i - 1], to.done, to.row(to.done));
      }
    }
  }

  void blur(const Blur& kernel, const Level& from, int64_t y, float* to) {
    std::vector<const float*>& rows = rows_;
    rows.clear();
    for (int i = 1; i <= kernel.radius; i++) {
      rows.push_back(from.row(reflected(y - i, height)));
      rows.push_back(from.row(reflected(y + i, height)));
    }
    float* column = column_.data();
    convolve(kernel, from.row(y), column, [&](int i, int64_t x) {
      return V::load(rows[2 * i] + x) + V::load(rows[2 * i + 1] + x);
    });
    for (int i = 1; i <= kernel.radius; i++) {
      column[-i] = column[reflected(-i, width)];
      column[width - 1 + i] = column[reflected(width - 1 + i, width)];
    }
    convolve(kernel, column, to, [&](int i, int64_t x) {
      return V::load(column + x - i - 1) + V::load(column + x + i + 1);
    });
  }

  // `pair(i, x)`: the sum of the pixels at i + 1 on both sides of x.
  template <class Pair>
  SNOW_INLINE void convolve(const Blur& kernel, const float* middle, float* to, Pair pair) const {
    constexpr int kVectors = 4, W = V::width;
    static_assert(kMargin % (kVectors * W) == 0);
    for (int64_t x = 0; x < width; x += kVectors * W) {
      V sum[kVectors];
      for (int k = 0; k < kVectors; k++) sum[k] = V(kernel.weight[0]) * V::load(middle + x + k * W);
      for (int i = 0; i < kernel.radius; i++) {
        const V weight(kernel.weight[i + 1]);
        for (int k = 0; k < kVectors; k++) sum[k] += weight * pair(i, x + k * W);
      }
      for (int k = 0; k < kVectors; k++) sum[k].store(to + x + k * W);
    }
  }

  std::function<void(int64_t, float*)> source_;
  const int first_;  // number of the first level in `levels_`
  std::vector<Blur> blurs_;
  std::vector<Level> levels_;
  Buffer column_;
  std::vector<const float*> rows_;
};

// An extremum of the differences of Gaussians.
struct Extremum {
  float x, y;           // pixels of the photo, from the centre of the first pixel
  float size;           // standard deviation of the feature's Gaussian, in pixels of the photo
  float scale;          // the same in pixels of the octave
  int octave, layer;    // the Gaussian with the gradients of the feature
  int64_t column, row;  // its pixel there

  auto key() const { return std::make_tuple(-size, y, x, octave, layer, row, column); }
};

// Finds the extrema of one octave.
template <class V>
class Search {
  static constexpr int W = V::width;

 public:
  Search(Octave<V>& octave, int number, std::vector<Extremum>& found)
      : octave_(octave), number_(number), found_(found) {
    for (int i = 0; i < 3 * kDifferences; i++)
      for (auto* rows : {&middle_, &low_, &high_}) rows->emplace_back(padded(octave.width));
  }

  void run() {
    for (int64_t y = 0; y < octave_.height; y++) {
      octave_.advance(y + kReach);
      for (int i = 0; i < kDifferences; i++) subtract(i, y);
      if (y > kBorder && y <= octave_.height - kBorder) scan(y - 1);
    }
  }

 private:
  static int slot(int difference, int64_t y) { return 3 * difference + int(y % 3); }

  // A row of a difference, and the least and the largest of three pixels around each of its pixels.
  void subtract(int i, int64_t y) {
    const float *more = octave_.row(i + 1, y), *less = octave_.row(i, y);
    float* middle = middle_[slot(i, y)].data();
    for (int64_t x = 0; x < octave_.width; x += W)
      (V::load(more + x) - V::load(less + x)).store(middle + x);
    float *low = low_[slot(i, y)].data(), *high = high_[slot(i, y)].data();
    for (int64_t x = 0; x < octave_.width; x += W) {
      const V left = V::load(middle + x - 1), at = V::load(middle + x);
      const V right = V::load(middle + x + 1);
      min(min(left, right), at).store(low + x);
      max(max(left, right), at).store(high + x);
    }
  }

  void scan(int64_t y) {
    const int64_t end = octave_.width - kBorder;
    for (int64_t x = kBorder; x < end; x += W) {
      V low[kDifferences], high[kDifferences];
      for (int i = 0; i < kDifferences; i++) {
        const int a = 3 * i, b = a + 1, c = a + 2;
        low[i] = min(min(at(low_, a, x), at(low_, b, x)), at(low_, c, x));
        high[i] = max(max(at(high_, a, x), at(high_, b, x)), at(high_, c, x));
      }
      for (int layer = 1; layer <= kLayers; layer++) {
        const V value = at(middle_, slot(layer, y), x);
        const V top = max(max(high[layer - 1], high[layer]), high[layer + 1]);
        const V bottom = min(min(low[layer - 1], low[layer]), low[layer + 1]);
        const auto extreme = ((value >= top) & (value > V(kLeastDifference))) |
                             ((bottom >= value) & (V(-kLeastDifference) > value));
        uint32_t bits = V::bits(extreme & V::first(int(std::min<int64_t>(W, end - x))));
        for (; bits; bits &= bits - 1) refine(layer, y, x + __builtin_ctz(bits));
      }
    }
  }
  SNOW_INLINE static V at(const std::vector<Buffer>& rows, int slot, int64_t x) {
    return V::load(rows[slot].data() + x);
  }

  double difference(int i, int64_t y, int64_t x) const {
    return octave_.row(i + 1, y)[x] - octave_.row(i, y)[x];
  }

  // The extremum of a quadratic function through the pixels around the one that was found; see
  // Brown and Lowe, "Invariant features from interest point groups", BMVC 2002.
  void refine(int layer, int64_t y, int64_t x) {
    for (int step = 0; step < kSteps; step++) {
      double d[3][3][3];  // difference, row, column
      for (int i = 0; i < 27; i++)
        d[i / 9][i / 3 % 3][i % 3] =
            difference(layer - 1 + i / 9, y - 1 + i / 3 % 3, x - 1 + i % 3);
      const double middle = d[1][1][1];
      const double gx = (d[1][1][2] - d[1][1][0]) / 2, gy = (d[1][2][1] - d[1][0][1]) / 2;
      const double gs = (d[2][1][1] - d[0][1][1]) / 2;
      const double xx = d[1][1][2] + d[1][1][0] - 2 * middle;
      const double yy = d[1][2][1] + d[1][0][1] - 2 * middle;
      const double ss = d[2][1][1] + d[0][1][1] - 2 * middle;
      const double xy = (d[1][2][2] - d[1][2][0] - d[1][0][2] + d[1][0][0]) / 4;
      const double xs = (d[2][1][2] - d[2][1][0] - d[0][1][2] + d[0][1][0]) / 4;
      const double ys = (d[2][2][1] - d[2][0][1] - d[0][2][1] + d[0][0][1]) / 4;
      // The adjugate of the Hessian matrix.
      const double axx = yy * ss - ys * ys, ayy = xx * ss - xs * xs, ass = xx * yy - xy * xy;
      const double axy = xs * ys - xy * ss, axs = xy * ys - xs * yy, ays = xy * xs - xx * ys;
      const double determinant = xx * axx + xy * axy + xs * axs;
      if (determinant == 0) return;
      const double to_x = -(axx * gx + axy * gy + axs * gs) / determinant;
      const double to_y = -(axy * gx + ayy * gy + ays * gs) / determinant;
      const double to_s = -(axs * gx + ays * gy + ass * gs) / determinant;
      if (std::abs(to_x) < 0.5 && std::abs(to_y) < 0.5 && std::abs(to_s) < 0.5) {
        const double contrast = middle + (gx * to_x + gy * to_y + gs * to_s) / 2;
        if (std::abs(contrast) < kContrast) return;
        if (ass <= 0 || (xx + yy) * (xx + yy) * kEdge >= (kEdge + 1) * (kEdge + 1) * ass) return;
        const double pixel = std::ldexp(0.5, number_);  // of the octave, in pixels of the photo
        const double scale = kSigma * std::exp2((layer + to_s) / kLayers);
        found_.push_back({float((double(x) + to_x) * pixel), float((double(y) + to_y) * pixel),
                          float(scale * pixel), float(scale), number_, layer, x, y});
        return;
      }
      const auto step_of = [](double to) { return to >= 0.5 ? 1 : to <= -0.5 ? -1 : 0; };
      x += step_of(to_x), y += step_of(to_y), layer += step_of(to_s);
      if (layer < 1 || layer > kLayers || x < kBorder || x >= octave_.width - kBorder ||
          y < kBorder || y >= octave_.height - kBorder)
        return;
    }
  }

  Octave<V>& octave_;
  const int number_;
  std::vector<Extremum>& found_;
  std::vector<Buffer> middle_, low_, high_;  // of each difference, rows at their number modulo 3
};

// Orientations and descriptors of the extrema of an octave.
template <class V>
class Describer {
  static constexpr int W = V::width;
  static constexpr int kMaxRadius = 40;  // pixels; that of the largest descriptor is 38
  static constexpr int kMaxRow = 2 * kMaxRadius + 1 + W;
  static constexpr int kTwoCells = 2 * kDirections;
  static constexpr int kSide = kCells + 2;  // of the cells, with a border

 public:
  Describer() {
    for (int i = 0; i <= kDirections; i++)
      for (int k = 0; k < kTwoCells; k++) {
        const auto is = [&](int direction) {
          return float(direction % kDirections == k % kDirections);
        };
        direction_[i][k] = is(i), next_direction_[i][k] = is(i + 1) - is(i);
      }
    for (int k = 0; k < kTwoCells; k++) {
      cell_[k] = float(k < kDirections), next_cell_[k] = k < kDirections ? -1.f : 1.f;
    }
  }

  // Sets the extremum to which the other functions refer, and its octave.
  void look_at(const Octave<V>& octave, const Extremum& e) { octave_ = &octave, at_ = &e; }

  // The directions of the gradients around the extremum in turns, counterclockwise.
  std::vector<float> orientations() {
    const Extremum& e = *at_;
    const int radius = int(std::lrint(4.5f * e.scale));
    set_weights(1.5f * e.scale, radius);
    constexpr int kCopies = 4;  // of the histogram: additions to different copies can overlap
    float histograms[kCopies][kBins + 1] = {};
    float bins[kMaxRow], values[kMaxRow];
    for (int i = -radius; i <= radius; i++) {
      const Row row = row_of(i, -radius, radius);
      for (int k = 0; k < row.count; k += W) {
        const Gradient g = gradient(row, k);
        (g.turns * V(float(kBins)) + V(0.5f)).store(bins + k);
        (g.magnitude * V(weight_[i + kMaxRadius]) * V::load(weight_ + row.first + k + kMaxRadius))
            .store(values + k);
      }
      for (int k = 0; k < row.count; k++) histograms[k % kCopies][int(bins[k])] += values[k];
    }
    float sum[kBins] = {}, smooth[kBins];
    for (int i = 0; i <= kBins; i++)
      for (auto& histogram : histograms) sum[i % kBins] += histogram[i];
    const auto at = [](const float* h, int i) { return h[(i + kBins) % kBins]; };
    for (int i = 0; i < kBins; i++)
      smooth[i] = (at(sum, i - 2) + at(sum, i + 2)) * (1.f / 16) +
                  (at(sum, i - 1) + at(sum, i + 1)) * (4.f / 16) + sum[i] * (6.f / 16);
    const float least = kPeak * *std::max_element(smooth, smooth + kBins);
    std::vector<float> found;
    for (int i = 0; i < kBins; i++) {
      const float left = at(smooth, i - 1), middle = smooth[i], right = at(smooth, i + 1);
      if (middle > left && middle > right && middle >= least)
        found.push_back((float(i) + 0.5f * (left - right) / (left - 2 * middle + right)) / kBins);
    }
    return found;
  }

  // The descriptor of the extremum with this orientation in turns.
  void describe(float orientation, uint8_t* out) {
    const Extremum& e = *at_;
    const float cell = kCellSize * e.scale;
    const float angle = float(2 * kPi) * orientation;
    const float cos = std::cos(angle) / cell, sin = std::sin(angle) / cell;
    const int radius = int(std::lrint(cell * float(std::sqrt(2.0) * (kCells + 1) / 2)));
    set_weights(cell * (kCells / 2), radius);
    constexpr float half = (kCells + 1) / 2.f;  // cells from the middle to the end of the border
    float cells[2][kSide * kSide * kDirections] = {};  // of even and of odd pixels
    for (int i = -radius; i <= radius; i++) {
      // The part of the row inside of the square |j sin + i cos| < half, |j cos - i sin| < half.
      float begin = -float(radius), end = float(radius);
      limit(sin, float(i) * cos, half, begin, end);
      limit(cos, -float(i) * sin, half, begin, end);
      if (!(begin <= end)) continue;
      const Row row = row_of(i, int(std::floor(begin)), int(std::ceil(end)));
      for (int k = 0; k < row.count; k += W) {
        const V j = V::iota() + V(float(row.first + k));
        const V down = j * V(sin) + V(float(i) * cos + half);
        const V across = j * V(cos) + V(half - float(i) * sin);
        const auto inside = (down > V(0.f)) & (V(2 * half) > down) & (across > V(0.f)) &
                            (V(2 * half) > across);
        const Gradient g = gradient(row, k);
        V turns = g.turns - V(orientation);
        turns = turns - floor(turns);
        const V weight = V(weight_[i + kMaxRadius]) * V::load(weight_ + row.first + k + kMaxRadius);
        const V magnitude = zero_unless(inside, g.magnitude * weight);
        const V y = zero_unless(inside, down), x = zero_unless(inside, across);
        const V cell_y = floor(y), cell_x = floor(x);
        const V direction = turns * V(float(kDirections)), whole = floor(direction);
        const V lower = magnitude * (y - cell_y);
        (magnitude - lower).store(upper_ + k), lower.store(lower_ + k);
        (x - cell_x).store(right_ + k), (direction - whole).store(turned_ + k);
        ((cell_y * V(float(kSide)) + cell_x) * V(float(kDirections))).store(cell_index_ + k);
        whole.store(direction_index_ + k);
      }
      for (int k = 0; k < row.count; k++) add(k, cells[k % 2]);
    }
    write(cells, out);
  }

 private:
  // A row of pixels beside an extremum.
  struct Row {
    const float *above, *middle, *below;  // at the first pixel
    int first;                            // relative to the extremum
    int count;                            // at most 0: none
  };
  struct Gradient {
    V turns, magnitude;  // direction, counterclockwise, 0 to 1; length in grey values of two pixels
  };

  // Pixels `begin` to `end` of row i beside an extremum, as far as they have four neighbours.
  Row row_of(int i, int begin, int end) const {
    const Extremum& e = *at_;
    const int64_t y = e.row + i;
    if (y < 1 || y > octave_->height - 2) return {nullptr, nullptr, nullptr, 0, 0};
    const int first = int(std::max<int64_t>(begin, 1 - e.column));
    const int last = int(std::min<int64_t>(end, octave_->width - 2 - e.column));
    const int64_t x = e.column + first;
    const auto at = [&](int64_t row) { return octave_->row(e.layer, row) + x; };
    return {at(y - 1), at(y), at(y + 1), first, last - first + 1};
  }

  SNOW_INLINE static Gradient gradient(const Row& row, int k) {
    const V x = V::load(row.middle + k + 1) - V::load(row.middle + k - 1);
    const V y = V::load(row.above + k) - V::load(row.below + k);
    return {turns_of(y, x), sqrt(x * x + y * y)};
  }

  // The angle of (x, y) in turns, 0 to 1, with an error of 2e-6.
  SNOW_INLINE static V turns_of(V y, V x) {
    const V zero(0.f), ax = max(x, -x), ay = max(y, -y);
    const V t = min(ax, ay) / max(max(ax, ay), V(1e-30f)), t2 = t * t;
    V p = t2 * V(0.0033176001f) + V(-0.013553049f);
    p = p * t2 + V(0.028673239f);
    p = p * t2 + V(-0.052569638f);
    p = p * t2 + V(0.15913367f);
    V turns = p * t;
    turns = select(ay > ax, V(0.25f) - turns, turns);
    turns = select(zero > x, V(0.5f) - turns, turns);
    return select(zero > y, V(1.f) - turns, turns);
  }

  SNOW_INLINE static V floor(V x) {
    V fraction;
    typename V::IVec whole;
    V::split(x, fraction, whole);
    return x - fraction;
  }

  // Gaussian weights of the distances −radius … radius along one axis.
  void set_weights(float sigma, int radius) {
    const V scale(-0.5f / (sigma * sigma));
    for (int i = -radius; i <= radius; i += W) {
      const V distance = V::iota() + V(float(i));
      exp(distance * distance * scale).store(weight_ + i + kMaxRadius);
    }
  }

  // Limits j to |j slope + offset| <= half.
  static void limit(float slope, float offset, float half, float& begin, float& end) {
    if (std::abs(slope) < 1e-6f) {
      if (std::abs(offset) > half) end = begin - 1;
      return;
    }
    const float a = (-half - offset) / slope, b = (half - offset) / slope;
    begin = std::max(begin, std::min(a, b)), end = std::min(end, std::max(a, b));
  }

  // Adds a gradient to the two nearest directions of the four nearest cells.
  SNOW_INLINE void add(int k, float* cells) const {
    float* to = cells + int(cell_index_[k]);
    const int direction = int(direction_index_[k]);
    const V turned(turned_[k]), right(right_[k]), upper(upper_[k]), lower(lower_[k]);
    for (int i = 0; i < kTwoCells; i += W) {
      const V directions =
          V::load(direction_[direction] + i) + turned * V::load(next_direction_[direction] + i);
      const V value = directions * (V::load(cell_ + i) + right * V::load(next_cell_ + i));
      float* below = to + kSide * kDirections;
      (V::load(to + i) + value * upper).store(to + i);
      (V::load(below + i) + value * lower).store(below + i);
    }
  }

  // RootSIFT: the square roots of a histogram with the sum 1.
  static void write(const float (&cells)[2][kSide * kSide * kDirections], uint8_t* out) {
    float values[kValues];
    float squares = 0, sum = 0;
    for (int i = 0; i < kValues; i++) {
      const int cell = i / kDirections, row = cell / kCells + 1, column = cell % kCells + 1;
      const int at = (row * kSide + column) * kDirections + i % kDirections;
      values[i] = cells[0][at] + cells[1][at];
      squares += values[i] * values[i];
    }
    const float most = kClamp * std::sqrt(squares);
    for (float& value : values) sum += value = std::min(value, most);
    const float scale = sum > 0 ? kNorm * kNorm / sum : 0;
    for (int i = 0; i < kValues; i++)
      out[i] = uint8_t(std::min(std::sqrt(values[i] * scale) + 0.5f, 255.f));
  }

  const Octave<V>* octave_;
  const Extremum* at_;
  float weight_[kMaxRow];
  // Of the pixels of a row: the weights in the upper and the lower cells; the part of the cells to
  // the right, and of the next direction; the cell and the direction.
  float upper_[kMaxRow], lower_[kMaxRow], right_[kMaxRow], turned_[kMaxRow];
  float cell_index_[kMaxRow], direction_index_[kMaxRow];
  alignas(64) float direction_[kDirections + 1][kTwoCells];
  alignas(64) float next_direction_[kDirections + 1][kTwoCells];
  alignas(64) float cell_[kTwoCells];
  alignas(64) float next_cell_[kTwoCells];
};

// Row y of the photo at twice its size: pixel 2x is pixel x of the photo.
void doubled(const DetectSiftParams& p, int64_t y, float* to) {
  const uint8_t* upper = p.grey + y / 2 * p.width;
  const uint8_t* lower = p.grey + std::min((y + 1) / 2, p.height - 1) * p.width;
  const auto twice = [&](int64_t x) { return int(upper[x]) + int(lower[x]); };
  for (int64_t x = 0; x + 1 < p.width; x++) {
    to[2 * x] = 0.5f * float(twice(x));
    to[2 * x + 1] = 0.25f * float(twice(x) + twice(x + 1));
  }
  to[2 * p.width - 2] = to[2 * p.width - 1] = 0.5f * float(twice(p.width - 1));
}

template <class V>
int64_t detect(const DetectSiftParams& p) {
  const Blur first = blur_between(2 * kPhotoSigma, kSigma);
  std::vector<std::unique_ptr<Octave<V>>> octaves;
  std::vector<Extremum> found;
  int64_t width = 2 * p.width, height = 2 * p.height;
  for (int number = 0; std::min(width, height) > 2 * kBorder; number++) {
    const Octave<V>* larger = number ? octaves.back().get() : nullptr;
    const auto source = [&p, larger, width](int64_t y, float* to) {
      if (!larger) return doubled(p, y, to);
      const float* from = larger->row(kLayers, 2 * y);
      for (int64_t x = 0; x < width; x++) to[x] = from[2 * x];
    };
    octaves.push_back(
        std::make_unique<Octave<V>>(width, height, source, number ? nullptr : &first));
    Search<V>(*octaves.back(), number, found).run();
    octaves.back()->keep();
    width /= 2, height /= 2;
  }
  const auto masked = [&](const Extremum& e) {
    return p.allowed && !p.allowed[int64_t(e.y + 0.5f) * p.width + int64_t(e.x + 0.5f)];
  };
  found.erase(std::remove_if(found.begin(), found.end(), masked), found.end());
  // Several pixels may lead to the same extremum.
  std::sort(found.begin(), found.end(),
            [](const Extremum& a, const Extremum& b) { return a.key() < b.key(); });
  const auto same = [](const Extremum& a, const Extremum& b) { return a.key() == b.key(); };
  found.erase(std::unique(found.begin(), found.end(), same), found.end());
  Describer<V> describer;
  int64_t count = 0;
  for (const Extremum& e : found) {
    describer.look_at(*octaves[size_t(e.octave)], e);
    for (float orientation : describer.orientations()) {
      if (count == p.count) return count;
      describer.describe(orientation, p.descriptors + count * kValues);
      const float angle = float(-2 * kPi) * orientation;
      const float cos = e.size * std::cos(angle), sin = e.size * std::sin(angle);
      const float keypoint[6] = {e.x + 0.5f, e.y + 0.5f, cos, -sin, sin, cos};
      std::copy_n(keypoint, 6, p.keypoints + 6 * count++);
    }
  }
  return count;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(detect_sift, DetectSiftParams) {
  FlushDenormals flush;
  try {
    return detect<VecF>(p);
  } catch (const std::bad_alloc&) {
    return -1;
  }
}
