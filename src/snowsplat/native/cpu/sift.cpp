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
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

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
constexpr double kEdge = 10;  // the largest ratio of the two principal curvatures
constexpr int kBorder = 5;    // pixels of an octave where no features are searched
constexpr int kSteps = 5;     // in the search for an extremum
constexpr int kFurthest = 2;  // pixels of a step
constexpr int kReach = kFurthest * (kSteps - 1) + 2;  // rows beside that of an extremum

constexpr int kBins = 36;       // of the histogram of orientations
constexpr float kPeak = 0.8f;   // of the largest bin: a further orientation
constexpr int kCells = 4;       // of a descriptor, along each side
constexpr int kDirections = 8;  // of a cell
constexpr int kValues = kCells * kCells * kDirections;
constexpr float kCellSize = 3;  // in scales of the feature
constexpr float kClamp = 0.2f;  // of the norm of a descriptor
constexpr float kNorm = 512;    // of a descriptor in bytes

constexpr int kMargin = 64;             // numbers beside a row that whole vectors may access
constexpr size_t kAlign = 64;           // bytes
constexpr size_t kLargePage = 1 << 21;  // bytes
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

// Numbers that are not initialised, with a margin at both ends; in large pages, where the system has
// them. With small pages, their first use takes a seventh of the time of `detect_sift`.
class Buffer {
 public:
  explicit Buffer(int64_t size) {
    const size_t bytes = size_t(size + 2 * kMargin) * sizeof(float);
    const auto align = std::align_val_t(bytes < kLargePage ? kAlign : kLargePage);
    memory_ = Memory(static_cast<float*>(::operator new(bytes, align)), Delete{align});
#if defined(__linux__)
    if (bytes >= kLargePage) madvise(memory_.get(), bytes, MADV_HUGEPAGE);  // may be refused
#endif
  }
  float* data() const { return memory_.get() + kMargin; }

 private:
  struct Delete {
    std::align_val_t align;
    void operator()(float* p) const { ::operator delete(p, align); }
  };
  using Memory = std::unique_ptr<float, Delete>;
  Memory memory_{nullptr, {}};
};

// Rows of an image; of a ring of rows, the last ones.
struct Level {
  float* data;
  int64_t stride, mask;  // row y is at y & mask
  int64_t done = 0;      // the number of rows that were computed

  float* row(int64_t y) const { return data + (y & mask) * stride; }
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
  // `source` writes a row. It is blurred before it is the first level, unless `first` is null. `kept`
  // is memory for `kept_size` numbers.
  Octave(int64_t width, int64_t height, float* kept, std::function<void(int64_t, float*)> source,
         const Blur* first)
      : width(width), height(height), source_(std::move(source)), first_(first ? 1 : 0),
        column_(padded(width)) {
    if (first) blurs_.push_back(*first);
    for (int i = 1; i < kLevels; i++)
      blurs_.push_back(blur_between(kSigma * std::exp2((i - 1.0) / kLayers),
                                    kSigma * std::exp2(double(i) / kLayers)));
    const int64_t stride = padded(width);
    int64_t lead = 0, rows = 0;  // of a level before the last one; of all rings
    for (int i = int(blurs_.size()); i >= 0; i--) {
      if (is_kept(i - first_)) {
        levels_.push_back({kept, stride, -1});
        kept += height * stride;
      } else {
        // The search needs rows around the present one; a row of the next level, those under its
        // kernel, which are fewer.
        const int64_t needed = i < first_ ? 2 * blurs_[i].radius + 1 : lead + 2 * kReach + 2;
        int64_t ring = 1;
        while (ring < needed) ring *= 2;
        levels_.push_back({nullptr, stride, ring - 1});
        rows += ring;
      }
      lead += i ? blurs_[i - 1].radius : 0;
    }
    std::reverse(levels_.begin(), levels_.end());
    rings_ = std::make_unique<Buffer>(rows * stride);
    float* ring = rings_->data();
    for (Level& level : levels_)
      if (!level.data) level.data = ring, ring += (level.mask + 1) * stride;
  }

  static int64_t kept_size(int64_t width, int64_t height) {
    return kLayers * height * padded(width);
  }
  // A row of a level; rows are computed in ascending order.
  const float* row(int level, int64_t y) const { return levels_[level + first_].row(y); }
  // Computes the rows of all levels up to y.
  void advance(int64_t y) { advance(int(levels_.size()) - 1, y); }
  // Frees the levels that are not kept.
  void finish() { rings_.reset(); }

  const int64_t width, height;

 private:
  // Gradients are computed of the levels of the layers.
  static bool is_kept(int level) { return level >= 1 && level <= kLayers; }

  void advance(int i, int64_t until) {
    Level& to = levels_[i];
    until = std::min(until, height - 1);
    for (; to.done <= until; to.done++) {
      if (i == 0) {
        source_(to.done, to.row(to.done));
      } else {
        advance(i - 1, to.done + blurs_[i - 1].radius);
        blur(blurs_[i - 1], levels_[i - 1], to.done, to.row(to.done));
      }
    }
  }

  void blur(const Blur& kernel, const Level& from, int64_t y, float* to) {
    rows_.clear();
    for (int i = 1; i <= kernel.radius; i++) {
      rows_.push_back(from.row(reflected(y - i, height)));
      rows_.push_back(from.row(reflected(y + i, height)));
    }
    float* column = column_.data();
    convolve(kernel, from.row(y), column, [&](int i, int64_t x) {
      return V::load(rows_[2 * i] + x) + V::load(rows_[2 * i + 1] + x);
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
  const int first_;          // number of the first level in `levels_`
  std::vector<Blur> blurs_;  // from each level to the next one
  std::vector<Level> levels_;
  std::unique_ptr<Buffer> rings_;
  Buffer column_;                   // sums of columns
  std::vector<const float*> rows_;  // above and below a row that is blurred
};

// An extremum of the differences of Gaussians.
struct Extremum {
  float x, y;           // pixels of the photo, from the centre of the first pixel
  float size;           // standard deviation of the feature's Gaussian, in pixels of the photo
  float scale;          // the same in pixels of the octave
  int octave, layer;    // the Gaussian with the gradients of the feature
  int64_t column, row;  // its pixel there
};

// An extremum with one of its orientations.
struct Feature : Extremum {
  float orientation;  // turns, counterclockwise
  int64_t place;      // in the results
};

bool larger_first(const Extremum& a, const Extremum& b) {
  return std::tie(b.size, a.y, a.x, a.octave) < std::tie(a.size, b.y, b.x, b.octave);
}
bool neighbours_first(const Extremum& a, const Extremum& b) {
  return std::tie(a.octave, a.layer, a.row, a.column, a.size) <
         std::tie(b.octave, b.layer, b.row, b.column, b.size);
}

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

  // The extremum of a quadratic function through the pixels around the one that was found; see
  // Brown and Lowe, "Invariant features from interest point groups", BMVC 2002.
  void refine(int layer, int64_t y, int64_t x) {
    for (int step = 0; step < kSteps; step++) {
      double d[3][3][3];  // difference, row, column
      for (int i = 0; i < 9; i++) {
        const float* more = octave_.row(layer + i / 3, y - 1 + i % 3) + x - 1;
        const float* less = octave_.row(layer - 1 + i / 3, y - 1 + i % 3) + x - 1;
        for (int k = 0; k < 3; k++) d[i / 3][i % 3][k] = more[k] - less[k];
      }
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
      const double furthest = std::max({std::abs(to_x), std::abs(to_y), std::abs(to_s)});
      if (!(furthest < kFurthest + 0.5)) return;
      x += std::lrint(to_x), y += std::lrint(to_y), layer += int(std::lrint(to_s));
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
  static constexpr int kChunk = 512;     // pixels that are gathered, about
  static constexpr int kMost = kChunk + 2 * kMaxRadius + 1 + W;  // at most
  static constexpr int kPrefetched = 4;                          // rows
  static constexpr float kHalf = (kCells + 1) / 2.f;  // of a descriptor with a border, in cells
  static constexpr int kCopies = 4;  // of a histogram: additions to different copies can overlap
  using D = Simd<float, W == 4 ? 4 : 8>;    // of directions
  static constexpr int kSide = kCells + 2;  // of the cells, with a border

 public:
  Describer() {
    for (int i = 0; i <= kDirections; i++)
      for (int k = 0; k < kDirections; k++) {
        const auto is = [&](int direction) {
          return float(direction % kDirections == k % kDirections);
        };
        tents_[i][k] = is(i), tents_[i][kDirections + k] = is(i + 1) - is(i);
      }
  }

  // Sets the extremum to which the other functions refer, and its octave.
  void look_at(const Octave<V>& octave, const Extremum& e) { octave_ = &octave, at_ = &e; }

  // The directions of the gradients around the extremum in turns, counterclockwise; the largest angle
  // first, as in OpenCV.
  std::vector<float> orientations() {
    const Extremum& e = *at_;
    const int radius = int(std::lrint(4.5f * e.scale));
    set_window(1.5f * e.scale, radius);
    float histograms[kCopies][kBins + 1] = {};
    visit(radius, 0, 0, [&](int count) {
      for (int k = 0; k < count; k += W) {
        const Gradient g = gradient(k);
        (g.turns * V(float(kBins)) + V(0.5f)).store(turned_ + k);
        g.magnitude.store(weight_ + k);
      }
      for (int k = 0; k < count; k++) histograms[k % kCopies][int(turned_[k])] += weight_[k];
    });
    float sum[kBins] = {}, smooth[kBins];
    for (int i = 0; i <= kBins; i++)
      for (auto& histogram : histograms) sum[i % kBins] += histogram[i];
    const auto at = [](const float* h, int i) { return h[(i + kBins) % kBins]; };
    for (int i = 0; i < kBins; i++)
      smooth[i] = (at(sum, i - 2) + at(sum, i + 2)) * (1.f / 16) +
                  (at(sum, i - 1) + at(sum, i + 1)) * (4.f / 16) + sum[i] * (6.f / 16);
    const float least = kPeak * *std::max_element(smooth, smooth + kBins);
    std::vector<float> found;
    for (int i = kBins - 1; i >= 0; i--) {
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
    set_window(cell * (kCells / 2), radius);
    float cells[kCopies][kSide * kSide * kDirections] = {};
    visit(radius, sin, cos, [&](int count) {
      for (int k = 0; k < count; k += W) spread(k, orientation);
      for (int k = 0; k < count; k++) add(k, cells[k % kCopies]);
    });
    write(cells, out);
  }

 private:
  struct Gradient {
    V turns, magnitude;  // counterclockwise, 0 to 1; in grey values of two pixels, times the weight
  };

  // Gathers the pixels around the extremum that have four neighbours, within `radius` rows and
  // columns and inside of the square |j sin + i cos| < kHalf, |j cos − i sin| < kHalf of column j and
  // row i. Calls use(count) with as many as fit into the cache.
  template <class Use>
  SNOW_INLINE void visit(int radius, float sin, float cos, Use use) {
    const Extremum& e = *at_;
    int count = 0;
    const int top = int(std::max<int64_t>(-radius, 1 - e.row));
    const int bottom = int(std::min<int64_t>(radius, octave_->height - 2 - e.row));
    for (int i = top; i <= bottom; i++) {
      float begin = float(std::max<int64_t>(-radius, 1 - e.column));
      float end = float(std::min<int64_t>(radius, octave_->width - 2 - e.column));
      limit(sin, float(i) * cos, begin, end);
      limit(cos, -float(i) * sin, begin, end);
      const int first = int(std::ceil(begin)), last = int(std::floor(end));
      const auto row = [&](int j) { return octave_->row(e.layer, e.row + j) + e.column + first; };
      const float *above = row(i - 1), *middle = row(i), *below = row(i + 1);
      const float* soon = row(std::min(i + kPrefetched, bottom));
      const V weight(window_[i + kMaxRadius]), down(float(i) * cos + kHalf);
      const V across(kHalf - float(i) * sin);
      for (int j = first; j <= last; j += W, count += W) {
        const int k = j - first;
        prefetch(soon + k);
        (V::load(middle + k + 1) - V::load(middle + k - 1)).store(x_ + count);
        (V::load(above + k) - V::load(below + k)).store(y_ + count);
        (weight * V::load(window_ + j + kMaxRadius)).store(weight_ + count);
        const V column = V::iota() + V(float(j));
        (column * V(sin) + down).store(down_ + count);
        (column * V(cos) + across).store(across_ + count);
      }
      // The next row overwrites lanes beyond the last column.
      if (first <= last) count -= (W - (last - first + 1) % W) % W;
      if (count > kChunk) use(count), count = 0;
    }
    use(count);
  }

  SNOW_INLINE Gradient gradient(int k) const {
    const V x = V::load(x_ + k), y = V::load(y_ + k), squares = x * x + y * y;
    const V magnitude = squares * rsqrt(max(squares, V(1e-30f)));
    return {turns_of(y, x), magnitude * V::load(weight_ + k)};
  }

  // Prepares W gradients for `add`.
  SNOW_INLINE void spread(int k, float orientation) {
    const V down = V::load(down_ + k), across = V::load(across_ + k);
    const auto inside =
        (down > V(0.f)) & (V(2 * kHalf) > down) & (across > V(0.f)) & (V(2 * kHalf) > across);
    const Gradient g = gradient(k);
    V turns = g.turns - V(orientation);
    turns = turns - floor(turns);
    const V magnitude = zero_unless(inside, g.magnitude);
    const V y = zero_unless(inside, down), x = zero_unless(inside, across);
    const V cell_y = floor(y), cell_x = floor(x);
    const V direction = turns * V(float(kDirections)), whole = floor(direction);
    const V below = magnitude * (y - cell_y), above = magnitude - below;
    const V right = x - cell_x, above_right = above * right, below_right = below * right;
    (above - above_right).store(parts_[0] + k), above_right.store(parts_[1] + k);
    (below - below_right).store(parts_[2] + k), below_right.store(parts_[3] + k);
    (direction - whole).store(turned_ + k);
    const V cell = (cell_y * V(float(kSide)) + cell_x) * V(float(kDirections));
    for (int l = 0; l < W; l++) cell_[k + l] = int(cell.v[l]), direction_[k + l] = int(whole.v[l]);
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
  void set_window(float sigma, int radius) {
    const V scale(-0.5f / (sigma * sigma));
    for (int i = -radius; i <= radius; i += W) {
      const V distance = V::iota() + V(float(i));
      exp(distance * distance * scale).store(window_ + i + kMaxRadius);
    }
  }

  // Limits j to |j slope + offset| <= kHalf.
  static void limit(float slope, float offset, float& begin, float& end) {
    if (std::abs(slope) < 1e-6f) {
      if (std::abs(offset) > kHalf) end = begin - 1;
      return;
    }
    const float a = (-kHalf - offset) / slope, b = (kHalf - offset) / slope;
    begin = std::max(begin, std::min(a, b)), end = std::min(end, std::max(a, b));
  }

  // Adds a gradient to the two nearest directions of the four nearest cells.
  SNOW_INLINE void add(int k, float* cells) const {
    float* to = cells + cell_[k];
    const float *nearest = tents_[direction_[k]], *next = nearest + kDirections;
    const D turned(turned_[k]);
    for (int i = 0; i < kDirections; i += D::width) {
      const D value = D::load(nearest + i) + turned * D::load(next + i);
      for (int cell = 0; cell < 4; cell++) {
        float* at = to + (cell / 2 * kSide + cell % 2) * kDirections + i;
        (D::load(at) + value * D(parts_[cell][k])).store(at);
      }
    }
  }

  // RootSIFT: the square roots of a histogram with the sum 1. The histogram is rounded first, which
  // removes the noise of small values; their roots are not small.
  static void write(const float (&cells)[kCopies][kSide * kSide * kDirections], uint8_t* out) {
    float values[kValues];
    float squares = 0, sum = 0;
    for (int i = 0; i < kValues; i++) {
      const int cell = i / kDirections, row = cell / kCells + 1, column = cell % kCells + 1;
      const int at = (row * kSide + column) * kDirections + i % kDirections;
      values[i] = cells[0][at] + cells[1][at] + cells[2][at] + cells[3][at];
      squares += values[i] * values[i];
    }
    const float most = kClamp * std::sqrt(squares);
    squares = 0;
    for (float& value : values) value = std::min(value, most), squares += value * value;
    const float scale = squares > 0 ? kNorm / std::sqrt(squares) : 0;
    for (float& value : values) sum += value = std::min(std::rint(value * scale), 255.f);
    for (int i = 0; i < kValues; i++)
      out[i] = uint8_t(std::min(kNorm * std::sqrt(values[i] / std::max(sum, 1.f)) + 0.5f, 255.f));
  }

  const Octave<V>* octave_;
  const Extremum* at_;
  float window_[2 * kMaxRadius + 1 + W];  // Gaussian weights along an axis
  // Of the pixels that `visit` gathers: gradient, weight, position in cells of the descriptor.
  float x_[kMost], y_[kMost], weight_[kMost], down_[kMost], across_[kMost];
  // Of these pixels: the number of the upper left cell and the parts of the magnitude in the four
  // cells; a direction, and the part that belongs to the next direction.
  int32_t cell_[kMost], direction_[kMost];
  float parts_[4][kMost], turned_[kMost];
  // Of each direction: 1 for itself; the difference of the next direction and this one.
  alignas(64) float tents_[kDirections + 1][2 * kDirections];
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
  std::vector<std::pair<int64_t, int64_t>> sizes;  // of the octaves
  int64_t kept_size = 0;
  for (int64_t w = 2 * p.width, h = 2 * p.height; std::min(w, h) > 2 * kBorder; w /= 2, h /= 2) {
    sizes.emplace_back(w, h);
    kept_size += Octave<V>::kept_size(w, h);
  }
  const Buffer memory(kept_size);
  float* kept = memory.data();
  std::vector<std::unique_ptr<Octave<V>>> octaves;
  std::vector<Extremum> found;
  for (const auto& [w, h] : sizes) {
    const int64_t width = w, height = h;
    const Octave<V>* larger = octaves.empty() ? nullptr : octaves.back().get();
    const auto source = [&p, larger, width](int64_t y, float* to) {
      if (!larger) return doubled(p, y, to);
      const float* from = larger->row(kLayers, 2 * y);
      for (int64_t x = 0; x < width; x++) to[x] = from[2 * x];
    };
    const int number = int(octaves.size());
    octaves.push_back(
        std::make_unique<Octave<V>>(width, height, kept, source, larger ? nullptr : &first));
    kept += Octave<V>::kept_size(width, height);
    Search<V>(*octaves.back(), number, found).run();
    octaves.back()->finish();
  }
  const auto masked = [&](const Extremum& e) {
    return p.allowed && !p.allowed[int64_t(e.y + 0.5f) * p.width + int64_t(e.x + 0.5f)];
  };
  found.erase(std::remove_if(found.begin(), found.end(), masked), found.end());
  // Several pixels may lead to the same extremum.
  std::sort(found.begin(), found.end(), larger_first);
  const auto same = [](const Extremum& a, const Extremum& b) {
    return !larger_first(a, b) && !larger_first(b, a);
  };
  found.erase(std::unique(found.begin(), found.end(), same), found.end());

  // Neighbours are processed one after the other, so many of their pixels are in the cache.
  Describer<V> describer;
  std::vector<Feature> features;
  const size_t wanted = size_t(p.count);
  for (size_t done = 0; done < found.size() && features.size() < wanted;) {
    const auto begin = found.begin() + done;
    const auto end = begin + std::min(found.size() - done, wanted - features.size());
    std::sort(begin, end, neighbours_first);
    for (auto e = begin; e != end; e++) {
      describer.look_at(*octaves[size_t(e->octave)], *e);
      for (float orientation : describer.orientations()) features.push_back({*e, orientation, 0});
    }
    done = size_t(end - found.begin());
  }
  std::stable_sort(features.begin(), features.end(), larger_first);
  if (features.size() > wanted) features.resize(wanted);
  for (size_t i = 0; i < features.size(); i++) features[i].place = int64_t(i);
  std::sort(features.begin(), features.end(), neighbours_first);
  for (const Feature& f : features) {
    describer.look_at(*octaves[size_t(f.octave)], f);
    describer.describe(f.orientation, p.descriptors + kValues * f.place);
    const float angle = float(-2 * kPi) * f.orientation;
    const float cos = f.size * std::cos(angle), sin = f.size * std::sin(angle);
    const float keypoint[6] = {f.x + 0.5f, f.y + 0.5f, cos, -sin, sin, cos};
    std::copy_n(keypoint, 6, p.keypoints + 6 * f.place);
  }
  return int64_t(features.size());
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
