// photometric: L1 and SSIM between two images and the gradient of their weighted sum, in one pass.
//
// Images are planar, (channels, H, W). A task is one channel of a strip of columns and a segment of
// rows. It processes the rows from top to bottom. Ring buffers contain the last 11 horizontally
// filtered rows of the window means, and those of the derivatives. Only the images and the gradient
// are read from or written to main memory. The division into tasks depends only on the image size,
// and partial sums are added in order, so the result does not depend on the number of threads.
#include <cstring>
#include <utility>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"
#include "simd.h"
#include "ssim.h"

namespace snow {
namespace {

constexpr int kStrip = 256;  // maximum number of columns of a task
constexpr int kMargin = 16;  // columns computed on each side for the second filter
constexpr int kPad = 32;     // columns of buffer on each side
constexpr int kRow = kStrip + 2 * kPad;
constexpr int kSegment = 540;  // rows of a task, approximately

int64_t strip_count(int64_t width) { return (width + kStrip - 1) / kStrip; }

// Loads n ≤ W pixels of an image of either type.
template <class V>
SNOW_INLINE V load_pixels(const typename V::Scalar* p, int64_t n) {
  return n >= V::width ? V::load(p) : V::load_first(p, int(n));
}
template <class V>
SNOW_INLINE V load_pixels(const uint8_t* p, int64_t n) {
  uint8_t bytes[V::width] = {};
  if (n < V::width) std::memcpy(bytes, p, size_t(n));
  return V::load_bytes(n >= V::width ? p : bytes) * V(1.0 / 255.0);
}

// shifted<k>() is the vector at row[x + k − 5], for k = 0 … 10 and x a multiple of W. This takes
// eleven loads, most of which cross a cache line. With 16 lanes, three aligned loads and shifts
// between registers are used instead.
template <class V>
struct Neighbourhood {
  const typename V::Scalar* at;
  SNOW_INLINE Neighbourhood(const typename V::Scalar* row, int x) : at(row + x - kSsimRadius) {}
  template <int k>
  SNOW_INLINE V shifted() const {
    return V::load(at + k);
  }
};
#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <>
struct Neighbourhood<Simd<float, 16>> {
  __m512i before, here, after;
  SNOW_INLINE Neighbourhood(const float* row, int x)
      : before(_mm512_load_si512(row + x - 16)), here(_mm512_load_si512(row + x)),
        after(_mm512_load_si512(row + x + 16)) {}
  template <int k>
  SNOW_INLINE Simd<float, 16> shifted() const {
    if constexpr (k < kSsimRadius)
      return _mm512_castsi512_ps(_mm512_alignr_epi32(here, before, 16 + k - kSsimRadius));
    else if constexpr (k == kSsimRadius)
      return _mm512_castsi512_ps(here);
    else
      return _mm512_castsi512_ps(_mm512_alignr_epi32(after, here, k - kSsimRadius));
  }
};
#endif

template <class V>
struct Filter {
  using T = typename V::Scalar;
  V tap[kSsimTaps];
  Filter() {
    for (int k = 0; k < kSsimTaps; k++) tap[k] = V(ssim_tap(k));
  }
  SNOW_INLINE V along(const T* row, int x) const {
    return along(Neighbourhood<V>(row, x), std::make_integer_sequence<int, kSsimTaps>());
  }
  template <int... k>
  SNOW_INLINE V along(const Neighbourhood<V>& n, std::integer_sequence<int, k...>) const {
    V sum(0.f);
    ((sum += tap[k] * n.template shifted<k>()), ...);
    return sum;
  }
  SNOW_INLINE V across(const T* const* rows, int offset) const {
    V sum(0.f);
#pragma GCC unroll 11
    for (int k = 0; k < kSsimTaps; k++) sum += tap[k] * V::load(rows[k] + offset);
    return sum;
  }
};

template <class V>
struct Scratch {
  using T = typename V::Scalar;
  alignas(64) T a[kRow], b[kRow], squares[kRow], product[kRow];
  alignas(64) T means[kSsimTaps][4][kRow];  // of a, b, a² + b², ab
  alignas(64) T derivatives[3][kRow];       // d.mean_a, d.mean_aa, d.mean_ab
  alignas(64) T filtered[kSsimTaps][3][kRow];
};

template <class V, class Target>
struct Photometric {
  using T = typename V::Scalar;
  int64_t width, height;
  const T* image;
  const Target* target;
  double l1_weight, ssim_weight;  // already divided by the number of values
  T* grad;                        // null: values only

  void run(int channel, int64_t strip, int64_t row_begin, int64_t row_end, double* sums) const {
    thread_local Scratch<V> s;
    constexpr int W = V::width;
    const Filter<V> filter;
    const int64_t plane = int64_t(channel) * width * height;
    const auto [x0, x1] = split_range(width, strip_count(width), strip, kMargin);
    const int64_t from = x0 - kMargin - kSsimRadius < 0 ? 0 : x0 - kMargin - kSsimRadius;
    const int64_t to = x1 + kMargin + kSsimRadius < width ? x1 + kMargin + kSsimRadius : width;
    std::memset(s.a, 0, sizeof s.a), std::memset(s.b, 0, sizeof s.b);
    std::memset(s.squares, 0, sizeof s.squares), std::memset(s.product, 0, sizeof s.product);
    const int end = kPad + int(x1 - x0 + kMargin - 1) / kMargin * kMargin;
    const int first = kPad - kMargin, last = end + kMargin;

    for (int64_t y = row_begin - 2 * kSsimRadius; y < row_end + 2 * kSsimRadius; y++) {
      auto& means = s.means[(y + 2 * kSsimTaps) % kSsimTaps];
      if (y >= 0 && y < height) {
        const int64_t row = plane + y * width;
        for (int64_t x = from; x < to; x += W) {
          const int64_t at = x - x0 + kPad;
          const V a = load_pixels<V>(image + row + x, to - x);
          const V b = load_pixels<V>(target + row + x, to - x);
          a.store(s.a + at), b.store(s.b + at);
          (a * a + b * b).store(s.squares + at), (a * b).store(s.product + at);
        }
        for (int x = first; x < last; x += W) {
          filter.along(s.a, x).store(means[0] + x), filter.along(s.b, x).store(means[1] + x);
          filter.along(s.squares, x).store(means[2] + x);
          filter.along(s.product, x).store(means[3] + x);
        }
      } else {
        std::memset(means, 0, sizeof means);
      }

      const int64_t ys = y - kSsimRadius;  // the row whose SSIM is complete now
      if (ys < row_begin - kSsimRadius) continue;
      auto& filtered = s.filtered[(ys + 2 * kSsimTaps) % kSsimTaps];
      if (ys >= 0 && ys < height) {
        const bool mine = ys >= row_begin && ys < row_end;
        const T* rows[kSsimTaps];
        for (int k = 0; k < kSsimTaps; k++)
          rows[k] = s.means[(ys - kSsimRadius + k + 2 * kSsimTaps) % kSsimTaps][0];
        V sum(0.f);
        for (int x = first; x < last; x += W) {
          SsimDerivatives<V> d;
          V value =
              ssim_pixel(filter.across(rows, x), filter.across(rows, kRow + x),
                         filter.across(rows, 2 * kRow + x), filter.across(rows, 3 * kRow + x), d);
          // Windows are centred on pixels of the image only.
          const int64_t column = x0 + x - kPad;
          if (column < 0 || column + W > width) {
            const V c = V::iota() + V(double(column));
            const auto inside = (c >= V(0.f)) & (V(double(width)) > c);
            value = zero_unless(inside, value), d.mean_a = zero_unless(inside, d.mean_a);
            d.mean_aa = zero_unless(inside, d.mean_aa), d.mean_ab = zero_unless(inside, d.mean_ab);
          }
          if (mine && x >= kPad && x < end) sum += value;
          d.mean_a.store(s.derivatives[0] + x), d.mean_aa.store(s.derivatives[1] + x);
          d.mean_ab.store(s.derivatives[2] + x);
        }
        for (int l = 0; l < W; l++) sums[1] += double(sum.v[l]);
        if (grad)
          for (int x = kPad; x < end; x += W)
            for (int k = 0; k < 3; k++) filter.along(s.derivatives[k], x).store(filtered[k] + x);
      } else {
        std::memset(filtered, 0, sizeof filtered);
      }

      const int64_t yo = ys - kSsimRadius;  // the row whose gradient is complete now
      if (yo < row_begin) continue;
      const T* rows[kSsimTaps];
      for (int k = 0; k < kSsimTaps; k++)
        rows[k] = s.filtered[(yo - kSsimRadius + k + 2 * kSsimTaps) % kSsimTaps][0];
      const V up(l1_weight), down(-l1_weight), weight(ssim_weight), zero(0.f);
      V sum(0.f);
      for (int64_t x = x0; x < x1; x += W) {
        const int64_t at = plane + yo * width + x;
        const int n = x1 - x < W ? int(x1 - x) : W;
        const V a = load_pixels<V>(image + at, x1 - x), b = load_pixels<V>(target + at, x1 - x);
        const V difference = a - b;
        sum += max(difference, -difference);
        if (!grad) continue;
        const int offset = int(x - x0) + kPad;
        const V sign = select(difference > zero, up, select(zero > difference, down, zero));
        const V g = sign + weight * (filter.across(rows, offset) +
                                     V(2.f) * a * filter.across(rows, kRow + offset) +
                                     b * filter.across(rows, 2 * kRow + offset));
        g.store_first(grad + at, n);
      }
      for (int l = 0; l < W; l++) sums[0] += double(sum.v[l]);
    }
  }
};

template <class V, class Target>
int64_t photometric(const PhotometricParams<typename V::Scalar, Target>& p) {
  const int64_t strips = strip_count(p.width);
  const int64_t segments = (p.height + kSegment - 1) / kSegment;
  const double count = double(p.n * p.width * p.height);
  const Photometric<V, Target> images = {
      p.width, p.height, p.image, p.target, p.l1_weight / count, p.ssim_weight / count, p.grad};
  const int64_t tasks = p.n * strips * segments;
  std::vector<double> sums(size_t(2 * tasks), 0.0);
  parallel_for(tasks, [&](int64_t task) {
    const int64_t segment = task % segments, strip = task / segments % strips;
    const Range rows = split_range(p.height, segments, segment);
    images.run(int(task / segments / strips), strip, rows.begin, rows.end, &sums[size_t(2 * task)]);
  });
  p.means[0] = p.means[1] = 0;
  for (int64_t t = 0; t < tasks; t++)
    p.means[0] += sums[size_t(2 * t)], p.means[1] += sums[size_t(2 * t + 1)];
  p.means[0] /= count, p.means[1] /= count;
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(photometric, PhotometricParams<float, float>) { return photometric<VecF>(p); }
SNOW_ENTRY(photometric_u8, PhotometricParams<float, uint8_t>) { return photometric<VecF>(p); }
SNOW_ENTRY(photometric_f64, PhotometricParams<double, double>) { return photometric<VecD>(p); }
SNOW_ENTRY(photometric_u8_f64, PhotometricParams<double, uint8_t>) { return photometric<VecD>(p); }
