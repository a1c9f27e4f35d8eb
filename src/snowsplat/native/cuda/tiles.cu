// From splats to a depth-sorted list of splats for each 16×16 tile, and back:
//   splats_prepare   depth keys; ops/cuda/tiling.py has them sorted
//   tiles_count      which tiles each splat touches, in the order of depth
//   tiles_fill       the instances, pairs of a tile and a splat, in that order; then sorted by tile
//   tiles_start      where the instances of each tile begin
//   splats_reduce    sums the gradients of a splat's tiles in a fixed order
// A splat touches the same tiles as on the CPU (native/cpu/tiles.cpp), but that the image counts as
// whole tiles. Where it may touch many, a warp looks at them side by side.
#include "cuda/device.h"
// (the first, because it has the integer types)
#include "blend.h"
#include "cuda/scan.h"

namespace snow {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / kWarp;
constexpr int kSmall = 32;      // tiles of a rectangle that one thread looks at, a bit each
constexpr int kColumns = 8;     // of a packed row: mean, conic, opacity, depth, radius
constexpr int kRow = 9;         // what lies between two rows in shared memory: an odd number
constexpr int kSlotWidth = 16;  // scalars of one (tile, splat) gradient: ≤ 4 colours, 6 moments

SNOW_INLINE uint32_t ordered_bits(float x) {  // unsigned integers in the order of the floats
  const uint32_t b = __float_as_uint(x);
  return b >> 31 ? ~b : b | 0x80000000u;
}
SNOW_INLINE uint64_t ordered_bits(double x) {
  const uint64_t b = uint64_t(__double_as_longlong(x));
  return b >> 63 ? ~b : b | 0x8000000000000000ull;
}

// Brings the first columns of the rows of a warp's lanes (< 0: none) to shared memory, 8 lanes a
// row, and gives that of this lane.
template <class T>
SNOW_INLINE const T* stage_rows(const T* packed, int64_t stride, int row, T* stage) {
  const int column = lane_id() % kColumns;
#pragma unroll
  for (int k = 0; k < kColumns; k++) {
    const int lane = k * (kWarp / kColumns) + lane_id() / kColumns;
    const int from = __shfl_sync(kAllLanes, row, lane);
    if (from >= 0) stage[lane * kRow + column] = packed[from * stride + column];
  }
  __syncwarp();
  return stage + lane_id() * kRow;
}

// Tiles x0 … x0 + width − 1, and so on; none: both sizes are 0.
struct TileRectangle {
  int x0, y0, width, height;
};

// Of the ellipse in which α ≥ 1/255, within the image's tiles.
template <class T>
SNOW_INLINE TileRectangle tile_rectangle(const T* row, int tiles_x, int tiles_y) {
  const T right = T(tiles_x * kTile - 1), bottom = T(tiles_y * kTile - 1);
  const T x = row[0], y = row[1], a = row[2], b = row[3], c = row[4];
  const T zero(0), half(0.5);
  const T det = a * c - b * b;
  const T k2 = T(2 * kLn2) * (log2(row[5]) - T(kLog2MinAlpha));
  const T reach = max(k2, zero) / det;
  const T ex = sqrt(reach * c), ey = sqrt(reach * a);
  const T x0 = max(x - ex - half, zero), x1 = min(x + ex - half, right);
  const T y0 = max(y - ey - half, zero), y1 = min(y + ey - half, bottom);
  const bool finite = (x - x) + (y - y) == zero;
  if (!(finite && k2 >= zero && det > zero && a > zero && x1 >= x0 && y1 >= y0))
    return {0, 0, 0, 0};
  const int first_x = int(x0) / kTile, first_y = int(y0) / kTile;
  return {first_x, first_y, int(x1) / kTile - first_x + 1, int(y1) / kTile - first_y + 1};
}

// Whether a splat reaches 1/255 somewhere between the pixel centres at the corners of a tile.
template <class T>
struct TileTest {
  SplatTerms<T> terms;
  T threshold;

  SNOW_INLINE explicit TileTest(const T* row)
      : terms(splat_terms(row[0], row[1], row + 2, row[5])),
        threshold(T(kLog2MinAlpha - kCullSlack) - terms.log2_opacity) {}
  SNOW_INLINE bool operator()(int tile_x, int tile_y) const {
    const T x = T(tile_x * kTile) + T(0.5) - terms.mean_x;
    const T y = T(tile_y * kTile) + T(0.5) - terms.mean_y;
    const T size(kTile - 1);
    return peak_over_rectangle(terms, x, y, x + size, y + size) >= threshold;
  }
};

// A warp goes row by row through the tiles of a rectangle, 32 at a time, and calls f(whether this
// lane's tile is touched, x, y). All lanes come to each call.
template <class T, class F>
SNOW_INLINE void for_each_32_tiles(const TileRectangle& r, const TileTest<T>& touches, F&& f) {
  const int area = r.width * r.height;
  const int step_x = kWarp % r.width, step_y = kWarp / r.width;
  int x = lane_id() % r.width, y = lane_id() / r.width;
  for (int first = 0; first < area; first += kWarp) {
    f(first + lane_id() < area && touches(r.x0 + x, r.y0 + y), r.x0 + x, r.y0 + y);
    x += step_x, y += step_y;
    if (x >= r.width) x -= r.width, y++;
  }
}

SNOW_INLINE uint32_t lanes_below() { return (1u << lane_id()) - 1; }

SNOW_INLINE uint32_t pair_of_16_bits(int low, int high) {
  return uint32_t(low) | uint32_t(high) << 16;
}

template <class T, class Key>
SNOW_INLINE void prepare(int64_t m, const T* packed, int64_t stride, int tiles_x, int tiles_y,
                         Key* keys) {
  SNOW_SHARED(T, stage, kThreads * kRow);
  const int64_t i = thread_index();
  const T* row = stage_rows(packed, stride, i < m ? int(i) : -1, stage + warp_id() * kWarp * kRow);
  if (i >= m) return;
  // What is nowhere comes last, out of the way of what is.
  const bool seen = tile_rectangle(row, tiles_x, tiles_y).width > 0;
  keys[i] = seen ? ordered_bits(row[6]) : ~Key(0);
}

// What tiles_count finds, for each splat in the order of depth: its rectangle, as pairs of 16 bits,
// how many of the tiles in there it touches, and which (of up to 32; else their number again).
struct Footprints {
  uint32_t *corners, *sizes, *tiles, *counts;
};

template <class T>
SNOW_INLINE void count_tiles(int64_t m, const uint32_t* order, const T* packed, int64_t stride,
                             int tiles_x, int tiles_y, const Footprints& out) {
  SNOW_SHARED(T, stage, kThreads * kRow);
  SNOW_SHARED(int, large, kThreads);  // the threads whose splats wait for a warp
  SNOW_SHARED(int, large_count, 1);
  if (threadIdx.x == 0) *large_count = 0;
  __syncthreads();

  const int64_t i = thread_index();
  const T* row =
      stage_rows(packed, stride, i < m ? int(order[i]) : -1, stage + warp_id() * kWarp * kRow);
  if (i < m) {
    const TileRectangle r = tile_rectangle(row, tiles_x, tiles_y);
    const int area = r.width * r.height;
    out.corners[i] = pair_of_16_bits(r.x0, r.y0);
    out.sizes[i] = pair_of_16_bits(r.width, r.height);
    if (area > kSmall) {
      large[atomicAdd(large_count, 1)] = int(threadIdx.x);
    } else {
      uint32_t tiles = uint32_t(area);  // of a single tile nothing is asked
      if (area > 1) {
        const TileTest<T> touches(row);
        tiles = 0;
        for (int k = 0, x = 0, y = 0; k < area; k++) {
          tiles |= uint32_t(touches(r.x0 + x, r.y0 + y)) << k;
          if (++x == r.width) x = 0, y++;
        }
      }
      out.tiles[i] = tiles;
      out.counts[i] = uint32_t(__popc(tiles));
    }
  }
  __syncthreads();

  for (int e = warp_id(); e < *large_count; e += kWarps) {
    const T* large_row = stage + large[e] * kRow;
    uint32_t count = 0;
    for_each_32_tiles(tile_rectangle(large_row, tiles_x, tiles_y), TileTest<T>(large_row),
                      [&](bool touched, int, int) {
                        count += uint32_t(__popc(__ballot_sync(kAllLanes, touched)));
                      });
    if (lane_id() == 0) {
      const int64_t at = int64_t(blockIdx.x) * kThreads + large[e];
      out.tiles[at] = out.counts[at] = count;
    }
  }
}

// Where instances go: their tiles into one of two arrays, the other is null.
struct Instances {
  uint16_t* tiles_16;
  uint32_t* tiles_32;
  uint32_t* splats;
  int64_t capacity;

  SNOW_INLINE void set(int64_t at, int tile, uint32_t splat) const {
    if (at >= capacity) return;
    if (tiles_16)
      tiles_16[at] = uint16_t(tile);
    else
      tiles_32[at] = uint32_t(tile);
    splats[at] = splat;
  }
};

SNOW_INLINE uint32_t clamped(int64_t slot, int64_t capacity) {
  return uint32_t(slot < capacity ? slot : capacity);
}

// `first_slots` are the sums of the counts of the splats before. Writes as many instances of a
// splat as were counted, whatever else happens.
template <class T>
SNOW_INLINE void fill_tiles(int64_t m, const uint32_t* order, const T* packed, int64_t stride,
                            int tiles_x, int tiles_y, const Footprints& found,
                            const uint32_t* first_slots, const Instances& out,
                            uint32_t* slot_range) {
  SNOW_SHARED(int, large, kThreads);
  SNOW_SHARED(int, large_count, 1);
  if (threadIdx.x == 0) *large_count = 0;
  __syncthreads();

  // A thread a splat first, then a lane a tile of the warp's small splats, so that neighbouring
  // lanes write to neighbouring addresses.
  const int64_t i = thread_index();
  uint32_t splat = 0, corner = 0, tiles = 0, first_slot = 0;
  int width = 1, area = 0;
  if (i < m) {
    const uint32_t size = found.sizes[i];
    splat = order[i], corner = found.corners[i], tiles = found.tiles[i];
    first_slot = first_slots[i];
    width = int(size & 0xffff), area = width * int(size >> 16);
    const bool is_large = area > kSmall;
    if (slot_range) {
      const int64_t slots = is_large ? tiles : uint32_t(__popc(tiles));
      slot_range[2 * int64_t(splat)] = clamped(first_slot, out.capacity);
      slot_range[2 * int64_t(splat) + 1] = clamped(first_slot + slots, out.capacity);
    }
    if (is_large) {
      large[atomicAdd(large_count, 1)] = int(threadIdx.x);
      area = 0;
    }
  }
  const int end = warp_inclusive_scan(area), all = __shfl_sync(kAllLanes, end, kWarp - 1);
  for (int first = 0; first < all; first += kWarp) {
    const int item = first + lane_id();
    int owner = 0;  // the first lane whose end is beyond the item
#pragma unroll
    for (int step = kWarp / 2; step > 0; step /= 2)
      if (__shfl_sync(kAllLanes, end, owner + step - 1) <= item) owner += step;
    const int k = item - __shfl_sync(kAllLanes, end - area, owner);
    const int its_width = __shfl_sync(kAllLanes, width, owner);
    const uint32_t its_tiles = __shfl_sync(kAllLanes, tiles, owner);
    const uint32_t its_corner = __shfl_sync(kAllLanes, corner, owner);
    const uint32_t its_slot = __shfl_sync(kAllLanes, first_slot, owner);
    const uint32_t its_splat = __shfl_sync(kAllLanes, splat, owner);
    if (item < all && its_tiles >> k & 1) {
      const int x = int(its_corner & 0xffff) + k % its_width;
      const int y = int(its_corner >> 16) + k / its_width;
      const int before = __popc(its_tiles & ((1u << k) - 1));
      out.set(int64_t(its_slot) + before, y * tiles_x + x, its_splat);
    }
  }
  __syncthreads();

  for (int e = warp_id(); e < *large_count; e += kWarps) {
    const int64_t at = int64_t(blockIdx.x) * kThreads + large[e];
    const uint32_t its_corner = found.corners[at], its_size = found.sizes[at];
    const uint32_t its_splat = order[at], count = found.tiles[at];
    const int64_t its_slot = first_slots[at];
    const TileRectangle r = {int(its_corner & 0xffff), int(its_corner >> 16),
                             int(its_size & 0xffff), int(its_size >> 16)};
    uint32_t done = 0;
    for_each_32_tiles(r, TileTest<T>(packed + its_splat * stride), [&](bool touched, int x, int y) {
      const uint32_t votes = __ballot_sync(kAllLanes, touched);
      const uint32_t k = done + uint32_t(__popc(votes & lanes_below()));
      if (touched && k < count) out.set(its_slot + k, y * tiles_x + x, its_splat);
      done += uint32_t(__popc(votes));
    });
    // Should the test come out otherwise than in tiles_count, by rounding where nothing is to be
    // seen, then what is left over goes to no tile.
    for (uint32_t k = done + uint32_t(lane_id()); k < count; k += kWarp)
      out.set(its_slot + k, tiles_x * tiles_y, its_splat);
  }
}

// tile_start[tile]: how many of the sorted instances belong to tiles before. n: tiles + 1.
template <class Key>
SNOW_INLINE void start_tiles(int64_t n, const Key* keys, const int64_t* needed, int64_t capacity,
                             uint32_t* tile_start) {
  const int64_t tile = thread_index();
  if (tile >= n) return;
  int64_t low = 0, high = *needed < capacity ? *needed : capacity;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (keys[middle] < uint32_t(tile))
      low = middle + 1;
    else
      high = middle;
  }
  tile_start[tile] = uint32_t(low);
}

// Sums each splat's slots in slot order, 16 lanes a splat, and writes (or, for further channel
// groups, adds) its row of the packed gradient. `channels` colours of the group went to `columns`.
template <class T>
SNOW_INLINE void reduce(int64_t m, const T* slots, const uint32_t* slot_range, const T* packed,
                        int64_t stride, int channels, const int64_t* columns, bool add, T* grad) {
  const int64_t i = thread_index() / kSlotWidth;
  const int lane = int(threadIdx.x) % kSlotWidth;
  uint32_t begin = 0, end = 0;
  if (i < m) begin = slot_range[2 * i], end = slot_range[2 * i + 1];
  T sum(0);
#pragma unroll 4
  for (uint32_t s = begin; s < end; s++) sum += slots[int64_t(s) * kSlotWidth + lane];

  T moment[6], color[4];
  const int base = channels <= 3 ? 3 : 4;
#pragma unroll
  for (int k = 0; k < 6; k++) moment[k] = __shfl_sync(kAllLanes, sum, base + k, kSlotWidth);
#pragma unroll
  for (int k = 0; k < 4; k++) color[k] = __shfl_sync(kAllLanes, sum, k, kSlotWidth);
  if (i >= m || (add && begin == end)) return;

  T d_mean[2] = {T(0), T(0)}, d_conic[3] = {T(0), T(0), T(0)}, d_opacity(0);
  if (begin < end) {
    const T* row = packed + i * stride;
    splat_terms_vjp<T>(row + 2, row[5],
                       {moment[0], moment[1], moment[2], moment[3], moment[4], moment[5]}, d_mean,
                       d_conic, d_opacity);
  }
  const T geometry[6] = {d_mean[0], d_mean[1], d_conic[0], d_conic[1], d_conic[2], d_opacity};
  T* g = grad + i * stride;
  for (int column = lane; column < int(stride); column += kSlotWidth) {
    T value = add ? g[column] : T(0);
#pragma unroll
    for (int k = 0; k < 6; k++)
      if (column == k) value += geometry[k];
#pragma unroll
    for (int k = 0; k < 4; k++)
      if (k < channels && column == int(columns[k])) value += color[k];
    g[column] = value;
  }
}

}  // namespace
}  // namespace snow

using namespace snow;

#define SNOW_TILE_KERNELS(SUFFIX, T, KEY)                                                          \
  SNOW_KERNEL(                                                                                     \
      splats_prepare##SUFFIX, 256,                                                                 \
      (int64_t m, const T* packed, int64_t stride, int64_t tiles_x, int64_t tiles_y, KEY* keys)) { \
    prepare(m, packed, stride, int(tiles_x), int(tiles_y), keys);                                  \
  }                                                                                                \
  SNOW_KERNEL(                                                                                     \
      tiles_count##SUFFIX, 256,                                                                    \
      (int64_t m, const uint32_t* order, const T* packed, int64_t stride, int64_t tiles_x,         \
       int64_t tiles_y, uint32_t* corners, uint32_t* sizes, uint32_t* tiles, uint32_t* counts)) {  \
    count_tiles(m, order, packed, stride, int(tiles_x), int(tiles_y),                              \
                {corners, sizes, tiles, counts});                                                  \
  }                                                                                                \
  SNOW_KERNEL(tiles_fill##SUFFIX, 256,                                                             \
              (int64_t m, const uint32_t* order, const T* packed, int64_t stride, int64_t tiles_x, \
               int64_t tiles_y, uint32_t* corners, uint32_t* sizes, uint32_t* tiles,               \
               const uint32_t* first_slots, uint16_t* tiles_16, uint32_t* tiles_32,                \
               uint32_t* splats, int64_t capacity, uint32_t* slot_range)) {                        \
    fill_tiles(m, order, packed, stride, int(tiles_x), int(tiles_y),                               \
               {corners, sizes, tiles, nullptr}, first_slots,                                      \
               {tiles_16, tiles_32, splats, capacity}, slot_range);                                \
  }                                                                                                \
  SNOW_KERNEL(splats_reduce##SUFFIX, 256,                                                          \
              (int64_t m, const T* slots, const uint32_t* slot_range, const T* packed,             \
               int64_t stride, int64_t channels, const int64_t* columns, int64_t add, T* grad)) {  \
    reduce(m, slots, slot_range, packed, stride, int(channels), columns, add != 0, grad);          \
  }

SNOW_TILE_KERNELS(, float, uint32_t)
SNOW_TILE_KERNELS(_f64, double, uint64_t)

SNOW_KERNEL(tiles_start_u16, 256,
            (int64_t n, const uint16_t* keys, const int64_t* needed, int64_t capacity,
             uint32_t* tile_start)) {
  start_tiles(n, keys, needed, capacity, tile_start);
}
SNOW_KERNEL(tiles_start_u32, 256,
            (int64_t n, const uint32_t* keys, const int64_t* needed, int64_t capacity,
             uint32_t* tile_start)) {
  start_tiles(n, keys, needed, capacity, tile_start);
}

// instance_splat[i] = slot_splat[instance_slot[i]], for as many as there are of n.
SNOW_KERNEL(tiles_gather, 256,
            (int64_t n, const uint32_t* slot_splat, const uint32_t* instance_slot,
             const int64_t* needed, uint32_t* instance_splat)) {
  const int64_t i = thread_index();
  if (i < n && i < *needed) instance_splat[i] = slot_splat[instance_slot[i]];
}
