// From splats to a depth-sorted list of splats for each 16×16 tile:
//   splats_prepare   records, tile rectangles and depth keys
//   splats_sort      a stable radix sort by depth key: splats of equal depth stay in row order
//   tiles_count      the exact set of tiles that each splat touches; the number of splats per tile
//   tiles_fill       the instances, sorted by tile; within a tile, they stay in depth order
// No result depends on the number of threads.
#include <cstring>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"
#include "cpu/splat_record.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int64_t kBlock = 2048;
constexpr int64_t kSerialBelow = 8000;  // splats; below this, one part is faster than several

int64_t part_count(int64_t m) { return m < kSerialBelow ? 1 : pool_size(); }

template <class T>
SNOW_INLINE void set_colors(SplatRecord<T>& r, const T* row, const int64_t* columns) {
  for (int k = 0; k < kGroupChannels; k++) r.color[k] = columns[k] < 0 ? T(0) : row[columns[k]];
}

template <class V, class T = typename V::Scalar>
int64_t prepare(const SplatsPrepareParams<T>& p) {
  constexpr int W = V::width;
  const int64_t n = p.n, stride = p.stride;
  const T* packed = p.packed;
  SplatRecord<T>* records = p.records;
  parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
    const int64_t begin = block * kBlock, end = begin + kBlock < n ? begin + kBlock : n;
    for (int64_t i = begin; i < end; i += W) {
      const int count = end - i < W ? int(end - i) : W;
      int64_t row[W];
      for (int l = 0; l < W; l++) row[l] = i + (l < count ? l : count - 1);
      V c[8];
      gather_rows(packed, stride, row, 7, c);
      c[7] = V(0.f);
      const PixelExtent<V> extent(c[0], c[1], c + 2, c[5], V(double(p.width - 1)),
                                  V(double(p.height - 1)));
      const uint32_t visible = V::bits(extent.visible);
      const SplatTerms<V> t = splat_terms(c[0], c[1], c + 2, c[5]);
      V terms[8] = {t.mean_x, t.mean_y, t.A, t.B, t.C, t.log2_opacity, t.slope_x, t.slope_y};
      constexpr int64_t record = sizeof(SplatRecord<T>) / sizeof(T);
      scatter_rows((T*)records, record, row, count, 8, terms);
      alignas(64) T rect[4][W];
      extent.x0.store(rect[0]), extent.y0.store(rect[1]);
      extent.x1.store(rect[2]), extent.y1.store(rect[3]);
      for (int l = 0; l < count; l++) {
        SplatRecord<T>& r = records[i + l];
        set_colors(r, packed + (i + l) * stride, p.columns);
        r.opacity = packed[(i + l) * stride + 5];
        const bool on = visible >> l & 1;
        r.tile_x0 = on ? uint16_t(int(rect[0][l]) / kTile) : 1;
        r.tile_y0 = on ? uint16_t(int(rect[1][l]) / kTile) : 1;
        r.tile_x1 = on ? uint16_t(int(rect[2][l]) / kTile) : 0;
        r.tile_y1 = on ? uint16_t(int(rect[3][l]) / kTile) : 0;
        p.keys[i + l] = ordered_bits(packed[(i + l) * stride + 6]);
      }
    }
  });
  return 0;
}

// Sorts by digits of 11 bits, the least significant first. The number of passes depends on the
// number of bits of (largest key − smallest key).
template <class T>
int64_t radix_sort(const SplatsSortParams<T>& p) {
  using Key = DepthKey<T>;
  constexpr int kBits = 11, kBins = 1 << kBits;
  const int64_t m = p.n;
  Key *keys = p.keys, *keys2 = p.keys2;
  uint32_t *order = p.order, *order2 = p.order2;
  const int64_t parts = part_count(m);
  std::vector<Key> lows(static_cast<size_t>(parts), ~Key(0)), highs(static_cast<size_t>(parts), 0);
  parallel_for(parts, [&](int64_t part) {
    const Range r = split_range(m, parts, part);
    Key low = ~Key(0), high = 0;
    for (int64_t i = r.begin; i < r.end; i++) {
      low = keys[i] < low ? keys[i] : low;
      high = keys[i] > high ? keys[i] : high;
    }
    lows[size_t(part)] = low, highs[size_t(part)] = high;
  });
  Key low = ~Key(0), high = 0;
  for (int64_t p = 0; p < parts; p++) {
    low = lows[size_t(p)] < low ? lows[size_t(p)] : low;
    high = highs[size_t(p)] > high ? highs[size_t(p)] : high;
  }
  int passes = 0;
  for (Key span = m > 0 ? high - low : 0; span;
       span = passes * kBits < int(8 * sizeof(Key)) ? Key(high - low) >> (passes * kBits) : 0)
    passes++;
  if (passes == 0) {
    for (int64_t i = 0; i < m; i++) order[i] = uint32_t(i);
    return 0;
  }
  std::vector<uint32_t> histogram(size_t(parts * kBins));
  for (int pass = 0; pass < passes; pass++) {
    const int shift = pass * kBits;
    const bool last = pass == passes - 1, to_order = (passes - 1 - pass) % 2 == 0;
    const Key* key_in = pass % 2 == 0 ? keys : keys2;
    Key* key_out = pass % 2 == 0 ? keys2 : keys;
    const uint32_t* in = to_order ? order2 : order;
    uint32_t* out = to_order ? order : order2;
    parallel_for(parts, [&](int64_t part) {
      uint32_t* h = &histogram[size_t(part * kBins)];
      std::memset(h, 0, sizeof(uint32_t) * kBins);
      const Range r = split_range(m, parts, part);
      for (int64_t i = r.begin; i < r.end; i++) h[(key_in[i] - low) >> shift & (kBins - 1)]++;
    });
    uint32_t sum = 0;
    for (int d = 0; d < kBins; d++)
      for (int64_t p = 0; p < parts; p++) {
        uint32_t& h = histogram[size_t(p * kBins + d)];
        const uint32_t c = h;
        h = sum, sum += c;
      }
    parallel_for(parts, [&](int64_t part) {
      uint32_t* h = &histogram[size_t(part * kBins)];
      const Range r = split_range(m, parts, part);
      for (int64_t i = r.begin; i < r.end; i++) {
        const Key k = key_in[i];
        const uint32_t at = h[(k - low) >> shift & (kBins - 1)]++;
        if (!last) key_out[at] = k;
        out[at] = pass == 0 ? uint32_t(i) : in[i];
      }
    });
  }
  return 0;
}

// The tiles of one splat. (x0, y0) is the first tile of its rectangle. For a rectangle of at most
// 16 tiles, `bits` marks the tiles that the splat touches, row by row, `width` tiles per row. A
// larger rectangle has the flag `large`; `fill_tiles` repeats the tests for it.
struct TileSpan {
  uint16_t x0, y0, bits;
  uint8_t width, large;
};
static_assert(sizeof(TileSpan) == 8, "layout of the scratch tensor");

// Tests 16 tiles at once: returns the bits of those that the splat touches. Tile k is
// (x + k % width, y + k / width).
template <class V, class T = typename V::Scalar>
struct TileTest {
  alignas(64) T column[kTile + 1][16], row[kTile + 1][16];
  TileTest() {
    for (int w = 1; w <= 16; w++)
      for (int k = 0; k < 16; k++) column[w][k] = T(k % w * kTile), row[w][k] = T(k / w * kTile);
  }
  SNOW_INLINE uint32_t operator()(const SplatTerms<T>& t, int width, int x, int y) const {
    const SplatTerms<V> s = {V(0.f), V(0.f), V(t.A),       V(t.B),
                             V(t.C), V(0.f), V(t.slope_x), V(t.slope_y)};
    const V threshold(kLog2MinAlpha - kCullSlack - t.log2_opacity);
    const V left(x * kTile + 0.5 - t.mean_x), top(y * kTile + 0.5 - t.mean_y);
    const V size(kTile - 1);
    uint32_t bits = 0;
    for (int k = 0; k < 16; k += V::width) {
      const V x0 = V::load(column[width] + k) + left, y0 = V::load(row[width] + k) + top;
      const V peak = peak_over_rectangle(s, x0, y0, x0 + size, y0 + size);
      bits |= V::bits(peak >= threshold) << k;
    }
    return bits;
  }
};

template <class V>
const TileTest<V>& tile_test() {
  static const TileTest<V> test;
  return test;
}

template <class V, class T, class F>
SNOW_INLINE void for_each_tile_of_large(const SplatRecord<T>& r, int64_t tiles_x, F&& f) {
  const int width = r.tile_x1 - r.tile_x0 + 1;
  for (int y = r.tile_y0; y <= r.tile_y1; y++)
    for (int x = 0; x < width; x += 16) {
      const int n = width - x < 16 ? width - x : 16;
      uint32_t bits = tile_test<V>()(r.terms, 16, r.tile_x0 + x, y) & ((1u << n) - 1);
      for (; bits; bits &= bits - 1) f(y * tiles_x + r.tile_x0 + x + __builtin_ctz(bits));
    }
}

// The data that tiles_count passes to tiles_fill, in one block of memory: the tiles of every splat,
// and for each part and tile a count.
struct TileWork {
  TileSpan* spans;
  uint32_t* counts;

  TileWork(void* memory, int64_t m)
      : spans(static_cast<TileSpan*>(memory)), counts((uint32_t*)(spans + m)) {}
  static int64_t bytes(int64_t m, int64_t tiles, int64_t parts) {
    return m * int64_t(sizeof(TileSpan)) + parts * tiles * int64_t(sizeof(uint32_t));
  }
};

// at[width][k]: in a TileSpan of this width, the index of the tile of bit k minus that of the first.
struct SmallOffsets {
  uint32_t at[17][16];
  explicit SmallOffsets(int64_t tiles_x) {
    for (int w = 1; w <= 16; w++)
      for (int k = 0; k < 16; k++) at[w][k] = uint32_t(k / w * tiles_x + k % w);
  }
};

// Returns the number of instances and stores it in *required. On the CPU, the caller allocates the
// memory for the instances after this call.
template <class V, class T = typename V::Scalar>
int64_t count_tiles(const TilesCountParams<T>& p) {
  const int64_t m = p.n, tiles_x = p.binning.tiles_x, parts = p.binning.parts;
  const int64_t tiles = tiles_x * p.binning.tiles_y;
  const uint32_t* order = p.binning.order;
  const SplatRecord<T>* records = p.binning.records;
  uint32_t* tile_start = p.binning.tile_start;
  const TileWork work(p.binning.workspace, m);
  TileSpan* spans = work.spans;
  uint32_t* counts = work.counts;
  const SmallOffsets offsets(tiles_x);
  parallel_for(parts, [&](int64_t part) {
    uint32_t* count = counts + part * tiles;
    std::memset(count, 0, sizeof(uint32_t) * size_t(tiles));
    const Range range = split_range(m, parts, part);
    for (int64_t i = range.begin; i < range.end; i++) {
      if (i + 12 < range.end) prefetch(&records[order[i + 12]]);
      const SplatRecord<T>& r = records[order[i]];
      TileSpan s = {r.tile_x0, r.tile_y0, 0, 0, 0};
      const int w = r.tile_x1 - r.tile_x0 + 1, h = r.tile_y1 - r.tile_y0 + 1;
      if (w > 0 && w * h <= 16) {
        s.width = uint8_t(w);
        s.bits = w * h == 1 ? 1
                            : uint16_t(tile_test<V>()(r.terms, w, r.tile_x0, r.tile_y0) &
                                       ((1u << (w * h)) - 1));
        const int64_t first = r.tile_y0 * tiles_x + r.tile_x0;
        for (uint32_t b = s.bits; b; b &= b - 1) count[first + offsets.at[w][__builtin_ctz(b)]]++;
      } else if (w > 0) {
        s.large = 1;
        for_each_tile_of_large<V>(r, tiles_x, [&](int64_t tile) { count[tile]++; });
      }
      spans[i] = s;
    }
  });
  uint32_t sum = 0;
  for (int64_t tile = 0; tile < tiles; tile++) {
    tile_start[tile] = sum;
    for (int64_t part = 0; part < parts; part++) {
      uint32_t& c = counts[part * tiles + tile];
      const uint32_t n = c;
      c = sum, sum += n;
    }
  }
  tile_start[tiles] = sum;
  return *p.required = sum;
}

template <class V, class T = typename V::Scalar>
int64_t fill_tiles(const TilesFillParams<T>& p) {
  const int64_t m = p.n, tiles_x = p.binning.tiles_x, parts = p.binning.parts;
  const int64_t tiles = tiles_x * p.binning.tiles_y;
  const uint32_t* order = p.binning.order;
  const SplatRecord<T>* records = p.binning.records;
  uint32_t* instance_splat = p.instance_splat;
  const TileWork work(p.binning.workspace, m);
  TileSpan* spans = work.spans;
  uint32_t* counts = work.counts;
  const SmallOffsets offsets(tiles_x);
  parallel_for(parts, [&](int64_t part) {
    uint32_t* next = counts + part * tiles;
    const Range range = split_range(m, parts, part);
    for (int64_t i = range.begin; i < range.end; i++) {
      const uint32_t splat = order[i];
      const TileSpan s = spans[i];
      if (!s.large) {
        const int64_t first = s.y0 * tiles_x + s.x0;
        for (uint32_t b = s.bits; b; b &= b - 1)
          instance_splat[next[first + offsets.at[s.width][__builtin_ctz(b)]]++] = splat;
      } else {
        for_each_tile_of_large<V>(records[splat], tiles_x,
                                  [&](int64_t tile) { instance_splat[next[tile]++] = splat; });
      }
    }
  });
  return 0;
}

template <class T>
int64_t recolor(const SplatsRecolorParams<T>& p) {
  for (int64_t i = 0; i < p.n; i++) set_colors(p.records[i], p.packed + i * p.stride, p.columns);
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(splats_prepare, SplatsPrepareParams<float>) { return prepare<VecF>(p); }
SNOW_ENTRY(splats_prepare_f64, SplatsPrepareParams<double>) { return prepare<VecD>(p); }
SNOW_ENTRY(splats_recolor, SplatsRecolorParams<float>) { return recolor(p); }
SNOW_ENTRY(splats_recolor_f64, SplatsRecolorParams<double>) { return recolor(p); }
SNOW_ENTRY(splats_sort, SplatsSortParams<float>) { return radix_sort(p); }
SNOW_ENTRY(splats_sort_f64, SplatsSortParams<double>) { return radix_sort(p); }
SNOW_ENTRY(tiles_count, TilesCountParams<float>) { return count_tiles<VecF>(p); }
SNOW_ENTRY(tiles_count_f64, TilesCountParams<double>) { return count_tiles<VecD>(p); }
SNOW_ENTRY(tiles_fill, TilesFillParams<float>) { return fill_tiles<VecF>(p); }
SNOW_ENTRY(tiles_fill_f64, TilesFillParams<double>) { return fill_tiles<VecD>(p); }

// Bytes of a record.
SNOW_ENTRY(splat_record_bytes, SizeQueryParams) { return (void)p, sizeof(SplatRecord<float>); }
SNOW_ENTRY(splat_record_bytes_f64, SizeQueryParams) { return (void)p, sizeof(SplatRecord<double>); }
// The number of parts into which tiles_count and tiles_fill divide n splats.
SNOW_ENTRY(tiles_parts, SizeQueryParams) { return part_count(p.n); }
// Bytes of the workspace of tiles_count and tiles_fill.
SNOW_ENTRY(tiles_workspace_bytes, SizeQueryParams) {
  return TileWork::bytes(p.n, p.tiles, p.parts);
}
