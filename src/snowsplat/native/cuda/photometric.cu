// photometric: L1 and SSIM between two images, and the gradient of their weighted sum.
//
// Images are planar, (channels, H, W). Each plane has fewer than 2³¹ pixels. A block processes a
// tile of one channel, 32 columns wide. It loads the tile with a margin of 5 pixels, filters the
// rows, and writes the result to shared memory. From there it filters the columns. The Gaussian
// window is separable and symmetric, and the image is padded with zeros. So the adjoint of the
// filter is the same filter, applied to the maps of derivatives.
//
//   photometric_similarity   SSIM per pixel, sums per block, the three derivatives of SSIM as maps
//   photometric_gradient     the gradient from the filtered maps, plus that of L1 and Huber
//   photometric_means        adds the sums of the blocks in order: bit-identical in every run
//
// The maps are written to global memory and read back. Without them, a block would have to load its
// tile with a margin of 10 pixels and filter all of it. This takes about 50% more arithmetic, and
// more than the 48 kB of shared memory that a block has by default. For large images,
// photometric.py limits the number of channels that are processed at a time: the maps of one
// channel of 1920×1080 pixels have 25 MB, which mostly fit into the caches of larger GPUs.
#include "cuda/device.h"
#include "ssim.h"

namespace snow {
namespace {

constexpr int kThreads = 192, kWarps = kThreads / kWarp;

constexpr int kColumns = kWarp;                           // of a tile: one lane per column
constexpr int kWideColumns = kColumns + 2 * kSsimRadius;  // with its margins
// The pitches are odd: the lanes of a warp, in 8 rows × every 8th column, use different banks.
constexpr int kWidePitch = kWideColumns + 1, kPitch = kColumns + 1;
constexpr int kRun = 8;  // neighbouring pixels of a row that a thread filters together
constexpr int kRuns = kColumns / kRun;

// A tile. The number of its rows is limited by shared memory: in float, two blocks per
// multiprocessor fit on the smallest GPUs; in double, the tile has as many rows as fit.
// photometric.py computes the number of blocks from the same tile size.
template <class T>
struct Tile {
  static constexpr int kOwnRows = sizeof(T) == 4 ? 4 : 2;  // of a thread, in the second pass
  static constexpr int kRows = kWarps * kOwnRows;
  static constexpr int kWideRows = kRows + 2 * kSsimRadius;
  static constexpr int kWideCount = kWideRows * kWidePitch, kCount = kWideRows * kPitch;

  int channel, x, y;  // of the first pixel
  SNOW_INLINE Tile(int width, int height) {
    const int across = (width + kColumns - 1) / kColumns, down = (height + kRows - 1) / kRows;
    const int row = int(blockIdx.x) / across;
    channel = row / down;
    x = (int(blockIdx.x) - row * across) * kColumns, y = (row - channel * down) * kRows;
  }
};

template <class T, class Target>
struct PhotometricSimilarityParams {
  int64_t n;              // channels
  int64_t width, height;  // pixels
  const T* image;         // (n, height, width)
  const Target* target;   // (n, height, width)
  T* maps;       // out, (n, 3, height, width), or null: the derivatives of SSIM with respect
                 // to the windowed means of a, of a² + b² and of ab
  double* sums;  // out, (blocks, 3) of |a − b|, of SSIM and of the Huber function
  SNOW_FIELDS(n, width, height, image, target, maps, sums)
};

template <class T, class Target>
struct PhotometricGradientParams {
  int64_t n;                                    // channels
  int64_t width, height;                        // pixels
  const T* image;                               // (n, height, width)
  const Target* target;                         // (n, height, width)
  const T* maps;                                // (n, 3, height, width)
  double l1_weight, ssim_weight, huber_weight;  // divided by the number of values
  T* grad;                                      // out, (n, height, width)
  SNOW_FIELDS(n, width, height, image, target, maps, l1_weight, ssim_weight, huber_weight, grad)
};

struct PhotometricMeansParams {
  int64_t n;           // blocks
  const double* sums;  // (n, 3)
  int64_t values;      // of the images
  double* means;       // out, (3,)
  SNOW_FIELDS(n, sums, values, means)
};

template <class T>
SNOW_INLINE T pixel(const T* p, int at) {
  return p[at];
}
template <class T>
SNOW_INLINE T pixel(const uint8_t* p, int at) {
  return T(p[at]) * T(1.0 / 255.0);
}

// Calls load(index in a wide tile, index in the plane or −1) for every pixel of the wide tile.
template <class T, class Load>
SNOW_INLINE void load_tile(const Tile<T>& tile, int width, int height, Load load) {
  constexpr int kPixels = Tile<T>::kWideRows * kWideColumns;
#pragma unroll
  for (int i = 0; i < (kPixels + kThreads - 1) / kThreads; i++) {
    const int at = i * kThreads + int(threadIdx.x);
    if (at >= kPixels) break;
    const int row = at / kWideColumns, column = at - row * kWideColumns;
    const int x = tile.x + column - kSsimRadius, y = tile.y + row - kSsimRadius;
    const bool inside = x >= 0 && x < width && y >= 0 && y < height;
    load(row * kWidePitch + column, inside ? y * width + x : -1);
  }
}

// Filters the rows of kMaps wide tiles and writes the result to `rows`. values(index, value) reads
// the values of all maps at an index in the wide tile.
template <int kMaps, class T, class Values>
SNOW_INLINE void filter_rows(T* rows, Values values) {
  static_assert(Tile<T>::kWideRows * kRuns <= kThreads, "at most one run per thread");
  const int run = int(threadIdx.x);
  if (run < Tile<T>::kWideRows * kRuns) {
    const int row = run / kRuns, x = run % kRuns * kRun;
    T sums[kMaps][kRun] = {};
#pragma unroll
    for (int j = 0; j < kRun + 2 * kSsimRadius; j++) {
      T value[kMaps];
      values(row * kWidePitch + x + j, value);
#pragma unroll
      for (int i = 0; i < kRun; i++) {
        const int k = j - i;
        if (k < 0 || k >= kSsimTaps) continue;
#pragma unroll
        for (int m = 0; m < kMaps; m++) sums[m][i] += T(ssim_tap(k)) * value[m];
      }
    }
#pragma unroll
    for (int m = 0; m < kMaps; m++)
#pragma unroll
      for (int i = 0; i < kRun; i++) rows[m * Tile<T>::kCount + row * kPitch + x + i] = sums[m][i];
  }
}

// Filters a column of `rows`, for the pixels of this thread: from row `first` of the tile on.
template <int kMaps, class T>
SNOW_INLINE void filter_column(const T* rows, int first, T (&sums)[kMaps][Tile<T>::kOwnRows]) {
#pragma unroll
  for (int m = 0; m < kMaps; m++) {
#pragma unroll
    for (int i = 0; i < Tile<T>::kOwnRows; i++) sums[m][i] = T(0);
#pragma unroll
    for (int j = 0; j < Tile<T>::kOwnRows + 2 * kSsimRadius; j++) {
      const T value = rows[m * Tile<T>::kCount + (first + j) * kPitch + lane_id()];
#pragma unroll
      for (int i = 0; i < Tile<T>::kOwnRows; i++)
        if (j - i >= 0 && j - i < kSsimTaps) sums[m][i] += T(ssim_tap(j - i)) * value;
    }
  }
}

// The sum over the lanes of a warp; all lanes receive it.
template <class T>
SNOW_INLINE T warp_sum(T value) {
#pragma unroll
  for (int bits = kWarp / 2; bits > 0; bits /= 2) value += __shfl_xor_sync(kAllLanes, value, bits);
  return value;
}

template <class T, class Target>
SNOW_INLINE void similarity(int width, int height, const T* __restrict__ image,
                            const Target* __restrict__ target, T* __restrict__ maps,
                            double* __restrict__ sums) {
  SNOW_SHARED(T, a, Tile<T>::kWideCount);
  SNOW_SHARED(T, b, Tile<T>::kWideCount);
  SNOW_SHARED(T, rows, 4 * Tile<T>::kCount);
  SNOW_SHARED(T, warp_sums, 3 * kWarps);
  const Tile<T> tile(width, height);
  const int64_t plane = int64_t(width) * height;
  image += tile.channel * plane, target += tile.channel * plane;

  load_tile(tile, width, height, [&](int index, int at) {
    a[index] = at >= 0 ? pixel<T>(image, at) : T(0);
    b[index] = at >= 0 ? pixel<T>(target, at) : T(0);
  });
  __syncthreads();
  filter_rows<4>(rows, [&](int index, T(&value)[4]) {
    const T p = a[index], q = b[index];
    value[0] = p, value[1] = q, value[2] = p * p + q * q, value[3] = p * q;
  });
  __syncthreads();

  const int first = warp_id() * Tile<T>::kOwnRows;
  const int x = tile.x + lane_id();
  T means[4][Tile<T>::kOwnRows];
  filter_column<4>(rows, first, means);
  const T delta = T(kHuberDelta);
  T differences = T(0), similarities = T(0), huber = T(0);
#pragma unroll
  for (int i = 0; i < Tile<T>::kOwnRows; i++) {
    const int y = tile.y + first + i;
    if (x >= width || y >= height) continue;
    const int index = (first + i + kSsimRadius) * kWidePitch + lane_id() + kSsimRadius;
    const T difference = a[index] - b[index];
    SsimDerivatives<T> d;
    similarities += ssim_pixel(means[0][i], means[1][i], means[2][i], means[3][i], d);
    const T size = max(difference, -difference), near = min(size, delta);
    differences += size, huber += near * (T(2) * size - near);
    if (maps) {
      T* const map = maps + 3 * tile.channel * plane + (y * width + x);
      map[0] = d.mean_a, map[plane] = d.mean_aa, map[2 * plane] = d.mean_ab;
    }
  }
  differences = warp_sum(differences), similarities = warp_sum(similarities);
  huber = warp_sum(huber);
  if (lane_id() == 0) {
    warp_sums[warp_id()] = differences, warp_sums[kWarps + warp_id()] = similarities;
    warp_sums[2 * kWarps + warp_id()] = huber;
  }
  __syncthreads();
  if (threadIdx.x < 3) {
    T sum = T(0);
    for (int w = 0; w < kWarps; w++) sum += warp_sums[int(threadIdx.x) * kWarps + w];
    sums[3 * int64_t(blockIdx.x) + threadIdx.x] = double(sum);
  }
}

template <class T, class Target>
SNOW_INLINE void gradient(int width, int height, const T* __restrict__ image,
                          const Target* __restrict__ target, const T* __restrict__ maps,
                          double l1_weight, double ssim_weight, double huber_weight,
                          T* __restrict__ grad) {
  SNOW_SHARED(T, derivatives, 3 * Tile<T>::kWideCount);
  SNOW_SHARED(T, rows, 3 * Tile<T>::kCount);
  // Converted once per block: consumer GPUs are slow at double.
  SNOW_SHARED(T, weights, 3);
  if (threadIdx.x == 0)
    weights[0] = T(l1_weight), weights[1] = T(ssim_weight), weights[2] = T(2 * huber_weight);
  const Tile<T> tile(width, height);
  const int64_t plane = int64_t(width) * height;
  image += tile.channel * plane, target += tile.channel * plane, grad += tile.channel * plane;
  maps += 3 * tile.channel * plane;
  const T* const map[3] = {maps, maps + plane, maps + 2 * plane};

  // Windows are centred only on pixels of the image: outside of it the derivatives are 0.
  load_tile(tile, width, height, [&](int index, int at) {
#pragma unroll
    for (int m = 0; m < 3; m++)
      derivatives[m * Tile<T>::kWideCount + index] = at >= 0 ? map[m][at] : T(0);
  });
  __syncthreads();
  filter_rows<3>(rows, [&](int index, T(&value)[3]) {
#pragma unroll
    for (int m = 0; m < 3; m++) value[m] = derivatives[m * Tile<T>::kWideCount + index];
  });
  __syncthreads();

  const int first = warp_id() * Tile<T>::kOwnRows;
  const int x = tile.x + lane_id();
  T filtered[3][Tile<T>::kOwnRows];
  filter_column<3>(rows, first, filtered);
#pragma unroll
  for (int i = 0; i < Tile<T>::kOwnRows; i++) {
    const int y = tile.y + first + i;
    if (x >= width || y >= height) continue;
    const int at = y * width + x;
    const T p = pixel<T>(image, at), q = pixel<T>(target, at);
    const T near = min(max(p - q, q - p), T(kHuberDelta)), away = weights[0] + weights[2] * near;
    const T sign = p > q ? away : q > p ? -away : T(0);
    grad[at] =
        sign + weights[1] * (filtered[0][i] + T(2) * p * filtered[1][i] + q * filtered[2][i]);
  }
}

}  // namespace
}  // namespace snow

using namespace snow;

#define SNOW_PHOTOMETRIC_KERNELS(SUFFIX, T, TARGET)                                               \
  SNOW_KERNEL(photometric_similarity##SUFFIX, kThreads, PhotometricSimilarityParams<T, TARGET>) { \
    similarity(int(p.width), int(p.height), p.image, p.target, p.maps, p.sums);                   \
  }                                                                                               \
  SNOW_KERNEL(photometric_gradient##SUFFIX, kThreads, PhotometricGradientParams<T, TARGET>) {     \
    gradient(int(p.width), int(p.height), p.image, p.target, p.maps, p.l1_weight, p.ssim_weight,  \
             p.huber_weight, p.grad);                                                             \
  }

SNOW_PHOTOMETRIC_KERNELS(, float, float)
SNOW_PHOTOMETRIC_KERNELS(_u8, float, uint8_t)
SNOW_PHOTOMETRIC_KERNELS(_f64, double, double)
SNOW_PHOTOMETRIC_KERNELS(_u8_f64, double, uint8_t)

// One block: means[0] = Σ |a − b| / values; means[1] and means[2] are those of SSIM and Huber.
SNOW_KERNEL(photometric_means, 256, PhotometricMeansParams) {
  SNOW_SHARED(double, partial, 256 * 3);
  const int t = int(threadIdx.x);
  for (int k = 0; k < 3; k++) {
    double sum = 0;
    for (int64_t i = t; i < p.n; i += 256) sum += p.sums[3 * i + k];
    partial[256 * k + t] = sum;
  }
  __syncthreads();
  for (int half = 128; half > 0; half /= 2) {
    if (t < half)
      for (int k = 0; k < 3; k++) partial[256 * k + t] += partial[256 * k + t + half];
    __syncthreads();
  }
  if (t < 3) p.means[t] = partial[256 * t] / double(p.values);
}
