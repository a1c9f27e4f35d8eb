// resample: the colours of a photo at positions between nodes, by Catmull-Rom splines (Keys, "Cubic
// convolution interpolation for digital image processing", 1981).
//
// The result is divided into tiles. For each tile, the part of the photo that its splines need is
// converted to floats, four channels per pixel, in a buffer that fits the cache of a core; so a
// spline is 16 products of vectors. If the part is too large, the tile is halved. The buffer repeats
// the border of the photo, so the splines need no branches.
//
// Photos are loaded in several threads, so a call uses only the thread of its caller.
#include <algorithm>
#include <cstdint>
#include <vector>

#include "cpu/entry.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int kColumns = 64, kRows = 16;  // of a tile
constexpr int kPhases = 256;              // positions within a pixel, along each axis
constexpr int kCapacity = 4096;           // pixels of the buffer; at least the 16 of one spline
constexpr int kTaps = 4;                  // pixels of a spline, along each axis
constexpr int kChannels = 4;              // of the buffer
constexpr int kSpline = kTaps * kChannels;
constexpr int kOverrun = 64;  // numbers behind the buffers that whole vectors may read or write

// For each phase the weights of the pixels −1, 0, 1, 2, each repeated for all channels.
struct Weights {
  alignas(64) float of[kPhases][kSpline];

  Weights() {
    for (int i = 0; i < kPhases; i++) {
      const float f = float(i) / kPhases;
      const float weight[kTaps] = {((-0.5f * f + 1.f) * f - 0.5f) * f,
                                   (1.5f * f - 2.5f) * f * f + 1.f,
                                   ((-1.5f * f + 2.f) * f + 0.5f) * f, (0.5f * f - 0.5f) * f * f};
      for (int j = 0; j < kSpline; j++) of[i][j] = weight[j / kChannels];
    }
  }
};
const Weights weights;

template <class V>
class Resampler {
  static constexpr int W = V::width;

 public:
  explicit Resampler(const ResampleParams& p)
      : p_(p), x_nodes_(kRows * p.columns), y_nodes_(kRows * p.columns),
        buffer_(kCapacity * kChannels + kOverrun), packed_(kCapacity + kOverrun) {}

  void run() {
    for (int64_t top = 0; top < p_.count; top += kRows) {
      const int rows = int(std::min<int64_t>(kRows, p_.count - top));
      for (int y = 0; y < rows; y++) interpolate_rows(top + y, y);
      for (int64_t left = 0; left < p_.width; left += kColumns) {
        const int columns = int(std::min<int64_t>(kColumns, p_.width - left));
        for (int y = 0; y < rows; y++) locate(left, columns, y);
        draw(0, 0, columns, rows);
        for (int y = 0; y < rows; y++) write(left, columns, top, y);
      }
    }
  }

 private:
  // The nodes of a row of the result.
  void interpolate_rows(int64_t row, int y) {
    const float* upper = p_.nodes + 2 * p_.columns * p_.row[row];
    const float* lower = upper + 2 * p_.columns;
    const float down = p_.down[row];
    float *x_nodes = &x_nodes_[y * p_.columns], *y_nodes = &y_nodes_[y * p_.columns];
    for (int64_t i = 0; i < p_.columns; i++) {
      x_nodes[i] = upper[2 * i] + down * (lower[2 * i] - upper[2 * i]);
      y_nodes[i] = upper[2 * i + 1] + down * (lower[2 * i + 1] - upper[2 * i + 1]);
    }
  }

  // The positions of a row of a tile.
  void locate(int64_t left, int columns, int y) {
    const float *x_nodes = &x_nodes_[y * p_.columns], *y_nodes = &y_nodes_[y * p_.columns];
    const float right = float(p_.source_width + 3), bottom = float(p_.source_height + 3);
    for (int x = 0; x < columns; x++) {
      const int32_t node = p_.column[left + x];
      const float across = p_.across[left + x];
      x_[y][x] = fixed_point(x_nodes[node] + across * (x_nodes[node + 1] - x_nodes[node]), right);
      y_[y][x] = fixed_point(y_nodes[node] + across * (y_nodes[node + 1] - y_nodes[node]), bottom);
    }
  }
  // In phases, from 2 pixels before the centre of the first pixel; limited to 2 pixels beside the
  // photo, where a spline has the same result as beyond. NaN becomes 0.
  SNOW_INLINE static int32_t fixed_point(float position, float most) {
    float from = position + 1.5f;
    from = from > 0.f ? from : 0.f;
    from = from < most ? from : most;
    return int32_t(from * kPhases + 0.5f);
  }

  // A part of a tile.
  void draw(int x0, int y0, int columns, int rows) {
    int32_t left = INT32_MAX, top = INT32_MAX, right = 0, bottom = 0;
    for (int y = y0; y < y0 + rows; y++)
      for (int x = x0; x < x0 + columns; x++) {
        left = std::min(left, x_[y][x]), right = std::max(right, x_[y][x]);
        top = std::min(top, y_[y][x]), bottom = std::max(bottom, y_[y][x]);
      }
    left /= kPhases, top /= kPhases, right /= kPhases, bottom /= kPhases;
    const int64_t width = right - left + kTaps, height = bottom - top + kTaps;
    if (width * height > kCapacity) {
      const int first_columns = columns > rows ? columns / 2 : columns;
      const int first_rows = columns > rows ? rows : rows / 2;
      draw(x0, y0, first_columns, first_rows);
      if (first_columns < columns)
        draw(x0 + first_columns, y0, columns - first_columns, rows);
      else
        draw(x0, y0 + first_rows, columns, rows - first_rows);
      return;
    }
    // The first pixel of a spline is the one before its position.
    for (int64_t y = 0; y < height; y++) fill(y * width, left - 3, top - 3 + y, int(width));
    const int stride = int(width) * kChannels;
    for (int y = y0; y < y0 + rows; y++)
      for (int x = x0; x < x0 + columns; x++) {
        const int across = x_[y][x] / kPhases - left, down = y_[y][x] / kPhases - top;
        spline(&buffer_[down * stride + across * kChannels], stride, weights.of[x_[y][x] % kPhases],
               weights.of[y_[y][x] % kPhases])
            .store(colours_[y][x]);
      }
  }

  SNOW_INLINE static Simd<float, kChannels> spline(const float* at, int stride, const float* across,
                                                   const float* down) {
    V sum(0.f);
    for (int k = 0; k < kSpline; k += W) {
      V column(0.f);
      for (int j = 0; j < kTaps; j++)
        column += V::load(at + j * stride + k) * V(down[j * kChannels]);
      sum += column * V::load(across + k);
    }
    return sum.sum_of_quads();
  }

  // `count` pixels of a row of the photo from column `left` on, into the buffer.
  void fill(int64_t to, int64_t left, int64_t row, int count) {
    const int64_t width = p_.source_width, plane = width * p_.source_height;
    row = std::clamp<int64_t>(row, 0, p_.source_height - 1);
    const uint8_t* channel[kChannels];
    for (int c = 0; c < kChannels; c++)
      channel[c] = p_.source + std::min<int64_t>(c, p_.channels - 1) * plane + row * width;
    const auto pixel = [&](int64_t x) {
      return uint32_t(channel[0][x]) | uint32_t(channel[1][x]) << 8 |
             uint32_t(channel[2][x]) << 16 | uint32_t(channel[3][x]) << 24;
    };
    const int begin = int(std::clamp<int64_t>(-left, 0, count));
    const int end = int(std::clamp<int64_t>(width - left, begin, count));
    for (int i = begin; i < end; i++) packed_[i] = pixel(left + i);
    const auto outside = [&](int64_t x) {
      return p_.wraps ? (x % width + width) % width : std::clamp<int64_t>(x, 0, width - 1);
    };
    for (int i = 0; i < begin; i++) packed_[i] = pixel(outside(left + i));
    for (int i = end; i < count; i++) packed_[i] = pixel(outside(left + i));
    const auto* bytes = reinterpret_cast<const uint8_t*>(packed_.data());
    for (int i = 0; i < kChannels * count; i += W)
      V::load_bytes(bytes + i).store(&buffer_[to * kChannels + i]);
  }

  void write(int64_t left, int columns, int64_t top, int y) {
    const int64_t at = (p_.first + top + y) * p_.width + left;
    for (int c = 0; c < p_.channels; c++) {
      uint8_t row[kColumns];
      for (int x = 0; x < kColumns; x++)
        row[x] =
            uint8_t(std::clamp(int32_t(colours_[y][x][c] + 0.5f), 0, 255));  // splines overshoot
      std::copy_n(row, columns, p_.made + c * p_.width * p_.height + at);
    }
  }

  const ResampleParams& p_;
  std::vector<float> x_nodes_, y_nodes_;  // (kRows, columns), of the rows of a tile
  std::vector<float> buffer_;
  std::vector<uint32_t> packed_;  // a row of the buffer in bytes
  int32_t x_[kRows][kColumns], y_[kRows][kColumns];
  alignas(64) float colours_[kRows][kColumns][kChannels] = {};
};

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(resample, ResampleParams) {
  Resampler<VecF>(p).run();
  return 0;
}
