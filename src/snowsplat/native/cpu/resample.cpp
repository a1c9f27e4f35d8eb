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
constexpr int kLine = 64;     // bytes of the cache
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
      : p_(p), x_(kRows * p.width), y_(kRows * p.width), buffer_(kCapacity * kChannels + kOverrun),
        packed_(kCapacity + kOverrun) {
    for (Line& line : lines_) line.x.resize(p.width), line.y.resize(p.width);
  }

  void run() {
    for (int64_t top = 0; top < p_.count; top += kRows) {
      const int rows = int(std::min<int64_t>(kRows, p_.count - top));
      for (int y = 0; y < rows; y++) locate(top + y, y);
      for (int64_t left = 0; left < p_.width; left += kColumns) {
        const int columns = int(std::min<int64_t>(kColumns, p_.width - left));
        draw(left, left, columns, 0, rows);
        for (int y = 0; y < rows; y++) write(left, columns, top, y);
      }
    }
  }

 private:
  // Positions of all columns in a row of nodes.
  struct Line {
    int64_t row = -1;
    std::vector<float> x, y;
  };

  const Line& line_of(int64_t row) {
    Line& line = lines_[row % 2];
    if (line.row == row) return line;
    line.row = row;
    const float* nodes = p_.nodes + 2 * p_.columns * row;
    for (int64_t i = 0; i < p_.width; i++) {
      const float *node = nodes + 2 * p_.column[i], across = p_.across[i];
      line.x[i] = node[0] + across * (node[2] - node[0]);
      line.y[i] = node[1] + across * (node[3] - node[1]);
    }
    return line;
  }

  // The positions of a row of the result.
  void locate(int64_t row, int y) {
    const Line &upper = line_of(p_.row[row]), &lower = line_of(p_.row[row] + 1);
    const float down = p_.down[row];
    const float right = float((p_.wraps ? 3 : 1) * p_.source_width + 3);
    const float bottom = float(p_.source_height + 3);
    int32_t *to_x = &x_[y * p_.width], *to_y = &y_[y * p_.width];
    const float *x0 = upper.x.data(), *x1 = lower.x.data();
    const float *y0 = upper.y.data(), *y1 = lower.y.data();
    for (int64_t i = 0; i < p_.width; i++) {
      to_x[i] = fixed_point(x0[i] + down * (x1[i] - x0[i]), right);
      to_y[i] = fixed_point(y0[i] + down * (y1[i] - y0[i]), bottom);
    }
  }
  // In phases, from 2 pixels before the centre of the first pixel; limited to 2 pixels beside the
  // photo, where a spline has the same result as beyond; if the photo wraps, to its third turn. NaN
  // becomes 0.
  SNOW_INLINE static int32_t fixed_point(float position, float most) {
    float from = position + 1.5f;
    from = from > 0.f ? from : 0.f;
    from = from < most ? from : most;
    return int32_t(from * kPhases + 0.5f);
  }

  // A part of the tile that begins at column `tile`.
  void draw(int64_t tile, int64_t begin, int columns, int first, int rows) {
    int32_t left = INT32_MAX, top = INT32_MAX, right = 0, bottom = 0;
    for (int y = first; y < first + rows; y++) {
      const int32_t *x_row = &x_[y * p_.width + begin], *y_row = &y_[y * p_.width + begin];
      for (int x = 0; x < columns; x++) {
        left = std::min(left, x_row[x]), right = std::max(right, x_row[x]);
        top = std::min(top, y_row[x]), bottom = std::max(bottom, y_row[x]);
      }
    }
    left /= kPhases, top /= kPhases, right /= kPhases, bottom /= kPhases;
    const int64_t width = right - left + kTaps, height = bottom - top + kTaps;
    if (width * height > kCapacity) {
      if (columns > rows) {
        draw(tile, begin, columns / 2, first, rows);
        draw(tile, begin + columns / 2, columns - columns / 2, first, rows);
      } else {
        draw(tile, begin, columns, first, rows / 2);
        draw(tile, begin, columns, first + rows / 2, rows - rows / 2);
      }
      return;
    }
    // The first pixel of a spline is the one before its position.
    for (int64_t y = 0; y < height; y++) fill(y * width, left - 3, top - 3 + y, int(width));
    const int stride = int(width) * kChannels;
    for (int y = first; y < first + rows; y++) {
      const int32_t *x_row = &x_[y * p_.width + begin], *y_row = &y_[y * p_.width + begin];
      for (int i = 0; i < columns; i++) {
        const uint32_t x = x_row[i], y_position = y_row[i];
        const int across = int(x / kPhases) - left, down = int(y_position / kPhases) - top;
        spline(&buffer_[down * stride + across * kChannels], stride, weights.of[x % kPhases],
               weights.of[y_position % kPhases])
            .store(colours_[y][begin - tile + i]);
      }
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
    if (p_.wraps) left = (left % width + width) % width;
    const uint8_t* channel[kChannels];
    for (int c = 0; c < kChannels; c++)
      channel[c] = p_.source + std::min<int64_t>(c, p_.channels - 1) * plane + row * width;
    // The next tile begins here. Its part of a row is too short for the prefetcher of the processor.
    for (int c = 0; c < p_.channels; c++)
      for (int i = 0; i <= kColumns; i += kLine) __builtin_prefetch(channel[c] + left + count + i);
    const auto pixel = [&](int64_t x) {
      return uint32_t(channel[0][x]) | uint32_t(channel[1][x]) << 8 |
             uint32_t(channel[2][x]) << 16 | uint32_t(channel[3][x]) << 24;
    };
    const int begin = int(std::clamp<int64_t>(-left, 0, count));
    const int end = int(std::clamp<int64_t>(width - left, begin, count));
    for (int i = begin; i < end; i++) packed_[i] = pixel(left + i);
    const auto outside = [&](int64_t x) {
      return p_.wraps ? x % width : std::clamp<int64_t>(x, 0, width - 1);
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
  Line lines_[2];               // of the nodes above and below a row, at their number modulo 2
  std::vector<int32_t> x_, y_;  // (kRows, width): positions of the rows of the tiles
  std::vector<float> buffer_;
  std::vector<uint32_t> packed_;  // a row of the buffer in bytes
  alignas(64) float colours_[kRows][kColumns][kChannels] = {};
};

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(resample, ResampleParams) {
  Resampler<VecF>(p).run();
  return 0;
}
