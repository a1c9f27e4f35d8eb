// photometric: L1, the Huber function and SSIM between two images, and the gradient of their weighted
// sum, in one pass.
//
// Images are planar, (channels, H, W). A task is one channel of a strip of columns and a segment of
// rows. It processes the rows from top to bottom, kBatch at a time. Ring buffers contain the last
// horizontally filtered rows of the window means, and those of the derivatives. They do not fit into
// the fastest cache, so the vertical filter uses each row that it loads for all rows of a batch. Only
// the images and the gradient are read from or written to main memory. The division into tasks depends only on the image size,
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
constexpr int kSegment = 540;                   // rows of a task, approximately
constexpr int kBatch = 4;                       // rows that are processed at once
constexpr int kReach = kSsimTaps + kBatch - 1;  // rows under the windows of a batch
constexpr int kRing = 16;                       // rows of a ring buffer, at least kReach

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
  // sum[r] is the filtered value of row r of a batch; `rows` are the rows under its windows.
  SNOW_INLINE void across(const T* const* rows, int offset, V* sum) const {
    for (int r = 0; r < kBatch; r++) sum[r] = V(0.f);
#pragma GCC unroll 14
    for (int k = 0; k < kReach; k++) {
      const V value = V::load(rows[k] + offset);
#pragma GCC unroll 4
      for (int r = 0; r < kBatch; r++)
        if (k >= r && k - r < kSsimTaps) sum[r] += tap[k - r] * value;
    }
  }
};

template <class V>
struct Scratch {
  using T = typename V::Scalar;
  alignas(64) T a[kRow], b[kRow], squares[kRow], product[kRow];
  alignas(64) T means[kRing][4][kRow];         // of a, b, a² + b², ab
  alignas(64) T derivatives[kBatch][3][kRow];  // d.mean_a, d.mean_aa, d.mean_ab
  alignas(64) T filtered[kRing][3][kRow];
};

// Row y of a ring buffer; y ≥ −kRing.
SNOW_INLINE size_t ring(int64_t y) { return size_t(y + kRing) % kRing; }

template <class V, class Target>
struct Photometric {
  using T = typename V::Scalar;
  int64_t width, height;
  const T* image;
  const Target* target;
  double l1_weight, ssim_weight, huber_weight;  // already divided by the number of values
  T* grad;                                      // null: values only

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

    for (int64_t y = row_begin - 2 * kSsimRadius; y < row_end + 2 * kSsimRadius; y += kBatch) {
      for (int64_t yb = y; yb < y + kBatch; yb++) {
        auto& means = s.means[ring(yb)];
        if (yb < 0 || yb >= height) {
          std::memset(means, 0, sizeof means);
          continue;
        }
        const int64_t row = plane + yb * width;
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
      }

      // The rows whose SSIM is complete now. The rows of the first batches that are not complete
      // are not used.
      const int64_t ys = y - kSsimRadius;
      if (ys + kBatch <= row_begin - kSsimRadius) continue;
      const T* rows[kReach];
      for (int k = 0; k < kReach; k++) rows[k] = s.means[ring(ys - kSsimRadius + k)][0];
      V similarity[kBatch];
      for (int r = 0; r < kBatch; r++) similarity[r] = V(0.f);
      for (int x = first; x < last; x += W) {
        V means[4][kBatch];
        for (int k = 0; k < 4; k++) filter.across(rows, k * kRow + x, means[k]);
        // Windows are centred on pixels of the image only.
        const V column = V::iota() + V(double(x0 + x - kPad));
        const auto inside = (column >= V(0.f)) & (V(double(width)) > column);
        for (int r = 0; r < kBatch; r++) {
          SsimDerivatives<V> d;
          const V value = ssim_pixel(means[0][r], means[1][r], means[2][r], means[3][r], d);
          if (x >= kPad && x < end) similarity[r] += zero_unless(inside, value);
          zero_unless(inside, d.mean_a).store(s.derivatives[r][0] + x);
          zero_unless(inside, d.mean_aa).store(s.derivatives[r][1] + x);
          zero_unless(inside, d.mean_ab).store(s.derivatives[r][2] + x);
        }
      }
      for (int r = 0; r < kBatch; r++) {
        if (ys + r >= row_begin && ys + r < row_end)
          for (int l = 0; l < W; l++) sums[1] += double(similarity[r].v[l]);
        auto& filtered = s.filtered[ring(ys + r)];
        if (ys + r < 0 || ys + r >= height)
          std::memset(filtered, 0, sizeof filtered);
        else if (grad)
          for (int x = kPad; x < end; x += W)
            for (int k = 0; k < 3; k++) filter.along(s.derivatives[r][k], x).store(filtered[k] + x);
      }

      const int64_t yo = ys - kSsimRadius;  // the rows whose gradient is complete now
      if (yo + kBatch <= row_begin) continue;
      for (int k = 0; k < kReach; k++) rows[k] = s.filtered[ring(yo - kSsimRadius + k)][0];
      const V up(l1_weight), weight(ssim_weight), zero(0.f);
      const V slope(2 * huber_weight), delta(kHuberDelta);
      V distance[kBatch], huber[kBatch];
      for (int r = 0; r < kBatch; r++) distance[r] = huber[r] = V(0.f);
      for (int64_t x = x0; x < x1; x += W) {
        const int n = x1 - x < W ? int(x1 - x) : W;
        V terms[3][kBatch];
        if (grad)
          for (int k = 0; k < 3; k++) filter.across(rows, k * kRow + int(x - x0) + kPad, terms[k]);
        for (int r = 0; r < kBatch; r++) {
          if (yo + r < row_begin || yo + r >= row_end) continue;
          const int64_t at = plane + (yo + r) * width + x;
          const V a = load_pixels<V>(image + at, x1 - x), b = load_pixels<V>(target + at, x1 - x);
          const V difference = a - b;
          const V size = max(difference, -difference), near = min(size, delta);
          distance[r] += size, huber[r] += near * (V(2.f) * size - near);
          if (!grad) continue;
          const V away = up + slope * near;
          const V sign = select(difference > zero, away, select(zero > difference, -away, zero));
          const V g = sign + weight * (terms[0][r] + V(2.f) * a * terms[1][r] + b * terms[2][r]);
          g.store_first(grad + at, n);
        }
      }
      for (int r = 0; r < kBatch; r++)
        for (int l = 0; l < W; l++)
          sums[0] += double(distance[r].v[l]), sums[2] += double(huber[r].v[l]);
    }
  }
};

template <class V, class Target>
int64_t photometric(const PhotometricParams<typename V::Scalar, Target>& p) {
  const int64_t strips = strip_count(p.width);
  const int64_t segments = (p.height + kSegment - 1) / kSegment;
  const double count = double(p.n * p.width * p.height);
  const Photometric<V, Target> images = {p.width,
                                         p.height,
                                         p.image,
                                         p.target,
                                         p.l1_weight / count,
                                         p.ssim_weight / count,
                                         p.huber_weight / count,
                                         p.grad};
  const int64_t tasks = p.n * strips * segments;
  std::vector<double> sums(size_t(3 * tasks), 0.0);
  parallel_for(tasks, [&](int64_t task) {
    const int64_t segment = task % segments, strip = task / segments % strips;
    const Range rows = split_range(p.height, segments, segment);
    images.run(int(task / segments / strips), strip, rows.begin, rows.end, &sums[size_t(3 * task)]);
  });
  for (int k = 0; k < 3; k++) {
    p.means[k] = 0;
    for (int64_t t = 0; t < tasks; t++) p.means[k] += sums[size_t(3 * t + k)];
    p.means[k] /= count;
  }
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(photometric, PhotometricParams<float, float>) { return photometric<VecF>(p); }
SNOW_ENTRY(photometric_u8, PhotometricParams<float, uint8_t>) { return photometric<VecF>(p); }
SNOW_ENTRY(photometric_f64, PhotometricParams<double, double>) { return photometric<VecD>(p); }
SNOW_ENTRY(photometric_u8_f64, PhotometricParams<double, uint8_t>) { return photometric<VecD>(p); }
