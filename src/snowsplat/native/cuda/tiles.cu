// From splats to a depth-sorted list of splats for each 16×16 tile, and back:
//   splats_prepare   depth keys; ops/cuda/tiling.py then sorts the splats by them
//   tiles_count      the tiles that each splat touches, in the order of depth
//   tiles_fill       the instances (pairs of a splat and a tile) in this order; ops/cuda/tiling.py
//                    then sorts them by tile
//   tiles_start      the first instance of each tile
//   splats_reduce    sums the gradients of a splat's tiles in a fixed order
// The tiles that a splat touches are the same as on the CPU (native/cpu/tiles.cpp), except that the
// image is extended to a multiple of the tile size. If a splat may touch many tiles, a whole warp
// tests them.
#include "cuda/device.h"
#include "cuda/scan.h"
#include "rasterize.h"

namespace snow {
namespace {

constexpr int kThreads = 256, kWarps = kThreads / kWarp;
constexpr int kSmall = 32;               // tiles of a rectangle that one thread tests, one bit each
constexpr int kColumns = kPackedHeader;  // of a packed row: mean, conic, opacity, depth, radius
constexpr int kRow = kColumns + 1;       // stride of the rows in shared memory: odd

// tiles_count: for each splat, in the order of depth:
//   corners, sizes   its rectangle of tiles, as pairs of 16 bits
//   counts           the number of tiles that it touches
//   tiles            these tiles, as bits; for a rectangle of more than 32 tiles, the number again
template <class T>
struct TilesCountKernelParams {
  int64_t n;                                   // splats
  const uint32_t* order;                       // (n,)
  const T* packed;                             // (n, stride)
  int64_t stride;                              // columns
  int64_t tiles_x, tiles_y;                    // tiles of the image
  uint32_t *corners, *sizes, *tiles, *counts;  // out, (n,) each
  SNOW_FIELDS(n, order, packed, stride, tiles_x, tiles_y, corners, sizes, tiles, counts)
};

// tiles_fill: the tile and the splat of each instance. One of tiles_16 and tiles_32 is null.
template <class T>
struct TilesFillKernelParams {
  int64_t n;                                // splats
  const uint32_t* order;                    // (n,)
  const T* packed;                          // (n, stride)
  int64_t stride;                           // columns
  int64_t tiles_x, tiles_y;                 // tiles of the image
  const uint32_t *corners, *sizes, *tiles;  // (n,) each, from tiles_count
  const uint32_t* first_slots;              // (n,) sums of the counts of the splats before
  uint16_t* tiles_16;                       // out, (capacity,)
  uint32_t* tiles_32;                       // out, (capacity,)
  uint32_t* splats;                         // out, (capacity,)
  int64_t capacity;                         // instances that memory is allocated for
  uint32_t* slot_range;                     // out, (n, 2), or null
  SNOW_FIELDS(n, order, packed, stride, tiles_x, tiles_y, corners, sizes, tiles, first_slots,
              tiles_16, tiles_32, splats, capacity, slot_range)
};

// tiles_start: the first instance of each tile. keys: the sorted tiles of the instances.
template <class Key>
struct TilesStartParams {
  int64_t n;                // tiles + 1
  const Key* keys;          // (capacity,)
  const int64_t* required;  // (1,) instances
  int64_t capacity;         // instances that memory is allocated for
  uint32_t* tile_start;     // out, (n,)
  SNOW_FIELDS(n, keys, required, capacity, tile_start)
};

// tiles_gather: instance_splat[i] = slot_splat[instance_slot[i]] for the valid instances.
struct TilesGatherParams {
  int64_t n;                      // instances that memory is allocated for
  const uint32_t* slot_splat;     // (n,)
  const uint32_t* instance_slot;  // (n,)
  const int64_t* required;        // (1,) instances
  uint32_t* instance_splat;       // out, (n,)
  SNOW_FIELDS(n, slot_splat, instance_slot, required, instance_splat)
};

// Copies the first kColumns columns of a row for each lane of the warp to shared memory, by 8 lanes
// per row. Returns the row of this lane. row < 0: no row for this lane.
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

// Columns x0 … x0 + width − 1 and rows y0 … y0 + height − 1 of tiles; empty: both sizes are 0.
struct TileRectangle {
  int x0, y0, width, height;
};

// The rectangle of the ellipse in which α ≥ 1/255, within the tiles of the image.
template <class T>
SNOW_INLINE TileRectangle tile_rectangle(const T* row, int tiles_x, int tiles_y) {
  const T right = T(tiles_x * kTile - 1), bottom = T(tiles_y * kTile - 1);
  const PixelExtent<T> extent(row[0], row[1], row + 2, row[5], right, bottom);
  if (!extent.visible || !is_finite(row[0]) || !is_finite(row[1])) return {0, 0, 0, 0};
  const int first_x = int(extent.x0) / kTile, first_y = int(extent.y0) / kTile;
  return {first_x, first_y, int(extent.x1) / kTile - first_x + 1,
          int(extent.y1) / kTile - first_y + 1};
}

// Whether α of a splat reaches 1/255 somewhere in the rectangle of the pixel centres of a tile.
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

// A warp visits the tiles of a rectangle row by row, 32 at a time. Each lane calls f(touched, x,
// y):
// whether the splat touches its tile, and the position of the tile. All lanes call f equally often.
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

// The splat, in the order of depth, of a thread of this block. The warps of a block test the tiles of
// its large splats together. The nearest splats are the largest, so each warp of a block has splats
// of another depth: 32 that are neighbours.
SNOW_INLINE int64_t depth_index(int thread) {
  return (int64_t(thread / kWarp) * gridDim.x + blockIdx.x) * kWarp + thread % kWarp;
}

SNOW_INLINE uint32_t pair_of_16_bits(int low, int high) {
  return uint32_t(low) | uint32_t(high) << 16;
}

SNOW_INLINE int tiles_along(int64_t pixels) { return int((pixels + kTile - 1) / kTile); }

template <class T>
SNOW_INLINE void prepare(const SplatsPrepareParams<T>& p) {
  SNOW_SHARED(T, stage, kThreads * kRow);
  const int64_t i = thread_index();
  const T* row =
      stage_rows(p.packed, p.stride, i < p.n ? int(i) : -1, stage + warp_id() * kWarp * kRow);
  if (i >= p.n) return;
  // Splats that are not visible are sorted behind all others.
  const bool visible = tile_rectangle(row, tiles_along(p.width), tiles_along(p.height)).width > 0;
  p.keys[i] = visible ? ordered_bits(row[6]) : ~DepthKey<T>(0);
}

template <class T>
SNOW_INLINE void count_tiles(const TilesCountKernelParams<T>& out) {
  const int64_t m = out.n;
  const int tiles_x = int(out.tiles_x), tiles_y = int(out.tiles_y);
  SNOW_SHARED(T, stage, kThreads * kRow);
  SNOW_SHARED(int, large, kThreads);  // the threads whose splats have to be tested by a warp
  SNOW_SHARED(int, large_count, 1);
  if (threadIdx.x == 0) *large_count = 0;
  __syncthreads();

  const int64_t i = depth_index(int(threadIdx.x));
  const T* row = stage_rows(out.packed, out.stride, i < m ? int(out.order[i]) : -1,
                            stage + warp_id() * kWarp * kRow);
  if (i < m) {
    const TileRectangle r = tile_rectangle(row, tiles_x, tiles_y);
    const int area = r.width * r.height;
    out.corners[i] = pair_of_16_bits(r.x0, r.y0);
    out.sizes[i] = pair_of_16_bits(r.width, r.height);
    if (area > kSmall) {
      large[atomicAdd(large_count, 1)] = int(threadIdx.x);
    } else {
      uint32_t tiles = uint32_t(area);  // a single tile needs no test
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
      const int64_t at = depth_index(large[e]);
      out.tiles[at] = out.counts[at] = count;
    }
  }
}

// Writes an instance if it is within the capacity.
template <class T>
SNOW_INLINE void set_instance(const TilesFillKernelParams<T>& p, int64_t at, int tile,
                              uint32_t splat) {
  if (at >= p.capacity) return;
  if (p.tiles_16)
    p.tiles_16[at] = uint16_t(tile);
  else
    p.tiles_32[at] = uint32_t(tile);
  p.splats[at] = splat;
}

SNOW_INLINE uint32_t clamped(int64_t slot, int64_t capacity) {
  return uint32_t(slot < capacity ? slot : capacity);
}

// Writes exactly the counted number of instances of a splat.
template <class T>
SNOW_INLINE void fill_tiles(const TilesFillKernelParams<T>& p) {
  const int tiles_x = int(p.tiles_x), tiles_y = int(p.tiles_y);
  SNOW_SHARED(int, large, kThreads);
  SNOW_SHARED(int, large_count, 1);
  if (threadIdx.x == 0) *large_count = 0;
  __syncthreads();

  // First, each thread reads one splat. Then each lane writes one tile of the small splats of its
  // warp, so that neighbouring lanes write to neighbouring addresses.
  const int64_t i = depth_index(int(threadIdx.x));
  uint32_t splat = 0, corner = 0, tiles = 0, first_slot = 0;
  int width = 1, area = 0;
  if (i < p.n) {
    const uint32_t size = p.sizes[i];
    splat = p.order[i], corner = p.corners[i], tiles = p.tiles[i];
    first_slot = p.first_slots[i];
    width = int(size & 0xffff), area = width * int(size >> 16);
    const bool is_large = area > kSmall;
    if (p.slot_range) {
      const int64_t slots = is_large ? tiles : uint32_t(__popc(tiles));
      p.slot_range[2 * int64_t(splat)] = clamped(first_slot, p.capacity);
      p.slot_range[2 * int64_t(splat) + 1] = clamped(first_slot + slots, p.capacity);
    }
    if (is_large) {
      large[atomicAdd(large_count, 1)] = int(threadIdx.x);
      area = 0;
    }
  }
  const int end = warp_inclusive_scan(area), all = __shfl_sync(kAllLanes, end, kWarp - 1);
  for (int first = 0; first < all; first += kWarp) {
    const int item = first + lane_id();
    int owner = 0;  // the lane whose splat the item belongs to: the first with item < end
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
      set_instance(p, int64_t(its_slot) + before, y * tiles_x + x, its_splat);
    }
  }
  __syncthreads();

  for (int e = warp_id(); e < *large_count; e += kWarps) {
    const int64_t at = depth_index(large[e]);
    const uint32_t its_corner = p.corners[at], its_size = p.sizes[at];
    const uint32_t its_splat = p.order[at], count = p.tiles[at];
    const int64_t its_slot = p.first_slots[at];
    const TileRectangle r = {int(its_corner & 0xffff), int(its_corner >> 16),
                             int(its_size & 0xffff), int(its_size >> 16)};
    uint32_t done = 0;
    for_each_32_tiles(r, TileTest<T>(p.packed + its_splat * p.stride),
                      [&](bool touched, int x, int y) {
                        const uint32_t votes = __ballot_sync(kAllLanes, touched);
                        const uint32_t k = done + uint32_t(__popc(votes & lanes_below()));
                        if (touched && k < count)
                          set_instance(p, its_slot + k, y * tiles_x + x, its_splat);
                        done += uint32_t(__popc(votes));
                      });
    // Because of rounding, the test may find fewer tiles than in tiles_count; the splat is not
    // visible in the missing ones. The remaining instances get a tile index after the last tile, and
    // their slots, which no block writes, do not belong to the splat.
    if (p.slot_range && done < count && lane_id() == 0)
      p.slot_range[2 * int64_t(its_splat) + 1] = clamped(its_slot + done, p.capacity);
    for (uint32_t k = done + uint32_t(lane_id()); k < count; k += kWarp)
      set_instance(p, its_slot + k, tiles_x * tiles_y, its_splat);
  }
}

template <class Key>
SNOW_INLINE void start_tiles(const TilesStartParams<Key>& p) {
  const int64_t tile = thread_index();
  if (tile >= p.n) return;
  int64_t low = 0, high = *p.required < p.capacity ? *p.required : p.capacity;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (p.keys[middle] < uint32_t(tile))
      low = middle + 1;
    else
      high = middle;
  }
  p.tile_start[tile] = uint32_t(low);
}

// Sums the slots of each splat in slot order, with 16 lanes per splat. Writes the sum to the
// splat's row of the packed gradient; for further groups of channels, adds it to this row.
template <class T>
SNOW_INLINE void reduce(const SplatsReduceParams<T>& p) {
  const int channels = int(p.channels);
  const bool add = p.add != 0;
  const int64_t i = thread_index() / kSlotWidth;
  const int lane = int(threadIdx.x) % kSlotWidth;
  uint32_t begin = 0, end = 0;
  if (i < p.n) begin = p.slot_range[2 * i], end = p.slot_range[2 * i + 1];
  T sum(0);
#pragma unroll 4
  for (uint32_t s = begin; s < end; s++) sum += p.slots[int64_t(s) * kSlotWidth + lane];

  T moment[6], color[4];
  const int base = channels <= 3 ? 3 : 4;
#pragma unroll
  for (int k = 0; k < 6; k++) moment[k] = __shfl_sync(kAllLanes, sum, base + k, kSlotWidth);
#pragma unroll
  for (int k = 0; k < 4; k++) color[k] = __shfl_sync(kAllLanes, sum, k, kSlotWidth);
  if (i >= p.n || (add && begin == end)) return;
  if (p.abs_grad && lane < 2) {  // as in mean_vjp: x in lane 0, y in lane 1
    const T* moments = p.slots + base;
    const T a = p.packed[i * p.stride + 2 + lane], b = p.packed[i * p.stride + 3 + lane];
    T abs_sum(0);
    for (uint32_t s = begin; s < end; s++) {
      const T* q = moments + int64_t(s) * kSlotWidth;
      abs_sum += abs(a * q[1] + b * q[2]);
    }
    p.abs_grad[2 * i + lane] += abs_sum;
  }

  T d_mean[2] = {T(0), T(0)}, d_conic[3] = {T(0), T(0), T(0)}, d_opacity(0);
  if (begin < end) {
    const T* row = p.packed + i * p.stride;
    splat_terms_vjp<T>(row + 2, row[5],
                       {moment[0], moment[1], moment[2], moment[3], moment[4], moment[5]}, d_mean,
                       d_conic, d_opacity);
  }
  const T geometry[6] = {d_mean[0], d_mean[1], d_conic[0], d_conic[1], d_conic[2], d_opacity};
  T* g = p.grad_packed + i * p.stride;
  for (int column = lane; column < int(p.stride); column += kSlotWidth) {
    T value = add ? g[column] : T(0);
#pragma unroll
    for (int k = 0; k < 6; k++)
      if (column == k) value += geometry[k];
#pragma unroll
    for (int k = 0; k < 4; k++)
      if (k < channels && column == int(p.columns[k])) value += color[k];
    g[column] = value;
  }
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(splats_prepare, kThreads, SplatsPrepareParams<float>) { prepare(p); }
SNOW_KERNEL(splats_prepare_f64, kThreads, SplatsPrepareParams<double>) { prepare(p); }
SNOW_KERNEL(tiles_count, kThreads, TilesCountKernelParams<float>) { count_tiles(p); }
SNOW_KERNEL(tiles_count_f64, kThreads, TilesCountKernelParams<double>) { count_tiles(p); }
SNOW_KERNEL(tiles_fill, kThreads, TilesFillKernelParams<float>) { fill_tiles(p); }
SNOW_KERNEL(tiles_fill_f64, kThreads, TilesFillKernelParams<double>) { fill_tiles(p); }
SNOW_KERNEL(tiles_start_u16, kThreads, TilesStartParams<uint16_t>) { start_tiles(p); }
SNOW_KERNEL(tiles_start_u32, kThreads, TilesStartParams<uint32_t>) { start_tiles(p); }
SNOW_KERNEL(splats_reduce, kThreads, SplatsReduceParams<float>) { reduce(p); }
SNOW_KERNEL(splats_reduce_f64, kThreads, SplatsReduceParams<double>) { reduce(p); }

SNOW_KERNEL(tiles_gather, kThreads, TilesGatherParams) {
  const int64_t i = thread_index();
  if (i < p.n && i < *p.required) p.instance_splat[i] = p.slot_splat[p.instance_slot[i]];
}
