// neighbours: the exact distances from each point to its k nearest others.
//
//   neighbours_codes    the index of each point on a Morton curve (Morton 1966), 21 bits per axis
//   (a sort by code)    consecutive points are then near each other
//   neighbours_chunks   the points in that order; the bounding box of each chunk of 32 points
//   neighbours_groups   the bounding box of each group of 32 chunks
//   neighbours_of_*     the search: one warp per chunk of queries, one lane per query
//
// A warp begins with its own chunk and the two adjacent chunks on the curve. This gives each of its
// queries an upper bound on the k-th distance. The warp then goes through all groups, and visits
// each chunk whose box is nearer to one of its queries than the k-th best distance so far. The
// order only affects the time. The result is exact, even if all points are in one cell of the
// curve.
#include "cuda/device.h"

namespace snow {
namespace {

constexpr int kThreads = 128, kWarps = kThreads / kWarp;
constexpr int kAxisBits = 21;

template <class T>
struct alignas(16) Point {
  T x, y, z, unused;
};

// An axis-aligned box; it is empty if low > high.
template <class T>
struct alignas(16) Box {
  Point<T> low, high;
};

template <class T>
struct NeighboursCodesParams {
  int64_t n;        // points
  const T* points;  // (n, 3)
  const T* low;     // (3,) corner of the box of all points
  const T* high;    // (3,)
  uint64_t* codes;  // out, (n,)
  SNOW_FIELDS(n, points, low, high, codes)
};

template <class T>
struct NeighboursChunksParams {
  int64_t n;             // points
  const T* points;       // (n, 3)
  const int32_t* order;  // (n,) indices of the points, sorted by code
  T* ordered;            // out, (n, 3) points in that order
  Box<T>* boxes;         // out, one per chunk of 32
  SNOW_FIELDS(n, points, order, ordered, boxes)
};

template <class T>
struct NeighboursGroupsParams {
  int64_t n;                  // chunks
  const Box<T>* chunk_boxes;  // (n,)
  Box<T>* boxes;              // out, one per group of 32
  SNOW_FIELDS(n, chunk_boxes, boxes)
};

template <class T>
struct NeighboursSearchParams {
  int64_t n;                  // points
  const T* points;            // (n, 3) in the order of their codes
  const int32_t* order;       // (n,)
  const Box<T>* chunk_boxes;  // one per chunk
  const Box<T>* group_boxes;  // one per group
  int64_t k;                  // neighbours of each point
  T* distances;               // out, (n, k)
  SNOW_FIELDS(n, points, order, chunk_boxes, group_boxes, k, distances)
};

template <class T>
SNOW_INLINE T gap(T below, T above) {
  return max(max(below, above), T(0));
}
template <class T>
SNOW_INLINE T squared(T x, T y, T z) {
  return x * x + y * y + z * z;
}
// Squared distances. All use the same operations, so that after rounding no point is nearer than
// its bounding box.
template <class T>
SNOW_INLINE T away(const Point<T>& a, const Point<T>& b) {
  return squared(a.x - b.x, a.y - b.y, a.z - b.z);
}
template <class T>
SNOW_INLINE T away(const Point<T>& p, const Box<T>& b) {
  return squared(gap(b.low.x - p.x, p.x - b.high.x), gap(b.low.y - p.y, p.y - b.high.y),
                 gap(b.low.z - p.z, p.z - b.high.z));
}
template <class T>
SNOW_INLINE T away(const Box<T>& a, const Box<T>& b) {
  return squared(gap(b.low.x - a.high.x, a.low.x - b.high.x),
                 gap(b.low.y - a.high.y, a.low.y - b.high.y),
                 gap(b.low.z - a.high.z, a.low.z - b.high.z));
}

template <class T>
SNOW_INLINE T warp_min(T value) {
#pragma unroll
  for (int bits = kWarp / 2; bits > 0; bits /= 2)
    value = min(value, __shfl_xor_sync(kAllLanes, value, bits));
  return value;
}
template <class T>
SNOW_INLINE T warp_max(T value) {
  return -warp_min(-value);
}
// The bounding box of the boxes of all lanes.
template <class T>
SNOW_INLINE Box<T> warp_box(const Box<T>& b) {
  return {{warp_min(b.low.x), warp_min(b.low.y), warp_min(b.low.z), T(0)},
          {warp_max(b.high.x), warp_max(b.high.y), warp_max(b.high.z), T(0)}};
}

// Moves bit i of the lower 21 bits to bit 3i.
SNOW_INLINE uint64_t spread(uint64_t x) {
  x = (x | x << 32) & 0x001f00000000ffffull;
  x = (x | x << 16) & 0x001f0000ff0000ffull;
  x = (x | x << 8) & 0x100f00f00f00f00full;
  x = (x | x << 4) & 0x10c30c30c30c30c3ull;
  x = (x | x << 2) & 0x1249249249249249ull;
  return x;
}

// Cells are cubes. low and high are the corners of the bounding box of all points. Coordinates are
// halved, so that differences do not overflow.
template <class T>
SNOW_INLINE void codes(int n, const T* points, const T* low, const T* high, uint64_t* out) {
  const int64_t i = thread_index();
  if (i >= n) return;
  T extent = T(0);
#pragma unroll
  for (int axis = 0; axis < 3; axis++)
    extent = max(extent, high[axis] * T(0.5) - low[axis] * T(0.5));
  uint64_t code = 0;
#pragma unroll
  for (int axis = 0; axis < 3; axis++) {
    const T offset = points[3 * i + axis] * T(0.5) - low[axis] * T(0.5);
    const T along = extent > T(0) ? min(offset / extent, T(1)) : T(0);
    code |= spread(uint32_t(along * T((1 << kAxisBits) - 1))) << axis;
  }
  out[i] = code;
}

// One warp per chunk. order: the indices of the points, sorted by code.
template <class T>
SNOW_INLINE void chunks(int n, const T* points, const int32_t* order, T* ordered, Box<T>* boxes) {
  const int64_t i = thread_index();
  const T inf = infinity<T>();
  Box<T> box = {{inf, inf, inf, T(0)}, {-inf, -inf, -inf, T(0)}};
  if (i < n) {
    const T* const p = points + 3 * int64_t(order[i]);
    box.low = box.high = {p[0], p[1], p[2], T(0)};
    ordered[3 * i] = p[0], ordered[3 * i + 1] = p[1], ordered[3 * i + 2] = p[2];
  }
  box = warp_box(box);
  if (lane_id() == 0 && i < n) boxes[i / kWarp] = box;
}

// One warp per group.
template <class T>
SNOW_INLINE void groups(int chunk_count, const Box<T>* chunk_boxes, Box<T>* boxes) {
  const int64_t i = thread_index();
  const T inf = infinity<T>();
  Box<T> box = {{inf, inf, inf, T(0)}, {-inf, -inf, -inf, T(0)}};
  if (i < chunk_count) box = chunk_boxes[i];
  box = warp_box(box);
  if (lane_id() == 0 && i < chunk_count) boxes[i / kWarp] = box;
}

// The kBest smallest squared distances so far, ascending. For k < kBest, the first kBest − k
// entries are initialised with −1, which is below all distances. In a lane without a query, all
// entries are.
template <class T, int kBest>
struct Best {
  T distances[kBest];
  SNOW_INLINE explicit Best(int k) {
#pragma unroll
    for (int i = 0; i < kBest; i++) distances[i] = i < kBest - k ? T(-1) : infinity<T>();
  }
  SNOW_INLINE T worst() const { return distances[kBest - 1]; }
  SNOW_INLINE void offer(T distance) {
    if (!(distance < worst())) return;
#pragma unroll
    for (int i = kBest - 1; i > 0; i--)
      distances[i] = min(distances[i], max(distances[i - 1], distance));
    distances[0] = min(distances[0], distance);
  }
};

template <int kBest, class T>
SNOW_INLINE void search(int n, const T* __restrict__ points, const int32_t* __restrict__ order,
                        const Box<T>* __restrict__ chunk_boxes,
                        const Box<T>* __restrict__ group_boxes, int k, T* __restrict__ distances) {
  SNOW_SHARED(Point<T>, shared, kThreads);
  Point<T>* const chunk_points = shared + warp_id() * kWarp;
  const int chunk_count = (n + kWarp - 1) / kWarp;
  const int group_count = (chunk_count + kWarp - 1) / kWarp;
  const int own = int(blockIdx.x) * kWarps + warp_id();
  if (own >= chunk_count) return;  // the complete warp; no barrier of the block follows
  const T inf = infinity<T>();

  // Indices after the last point: a point that is infinitely far from every query.
  const auto load = [&](int i) -> Point<T> {
    if (i >= n) return {inf, inf, inf, T(0)};
    const T* const p = points + 3 * int64_t(i);
    return {p[0], p[1], p[2], T(0)};
  };
  const int self = own * kWarp + lane_id();
  const Box<T> own_box = chunk_boxes[own];
  const Point<T> query = self < n ? load(self) : own_box.low;
  Best<T, kBest> best(self < n ? k : 0);

  const auto visit = [&](int chunk) {
    __syncwarp();
    chunk_points[lane_id()] = load(chunk * kWarp + lane_id());
    __syncwarp();
    const int skip = self - chunk * kWarp;
#pragma unroll(kBest > 8 ? 1 : 4)
    for (int j = 0; j < kWarp; j++) {
      const T distance = away(query, chunk_points[j]);
      best.offer(j == skip ? inf : distance);
    }
  };
  for (int chunk = own > 0 ? own - 1 : 0; chunk <= own + 1; chunk++)
    if (chunk < chunk_count) visit(chunk);

  for (int first = 0; first < group_count; first += kWarp) {
    const int group = first + lane_id();
    T worst = warp_max(best.worst());
    unsigned near_groups =
        __ballot_sync(kAllLanes, group < group_count && away(own_box, group_boxes[group]) < worst);
    for (; near_groups; near_groups &= near_groups - 1) {
      const int first_chunk = (first + __ffs(int(near_groups)) - 1) * kWarp;
      const int chunk = first_chunk + lane_id();
      worst = warp_max(best.worst());
      unsigned near_chunks =
          __ballot_sync(kAllLanes, chunk < chunk_count && (chunk < own - 1 || chunk > own + 1) &&
                                       away(own_box, chunk_boxes[chunk]) < worst);
      for (; near_chunks; near_chunks &= near_chunks - 1) {
        const int candidate = first_chunk + __ffs(int(near_chunks)) - 1;
        if (__any_sync(kAllLanes, away(query, chunk_boxes[candidate]) < best.worst()))
          visit(candidate);
      }
    }
  }

  if (self >= n) return;
  T* const row = distances + int64_t(order[self]) * k;
#pragma unroll
  for (int i = 0; i < kBest; i++)
    if (i >= kBest - k) row[i - (kBest - k)] = sqrt(best.distances[i]);
}

}  // namespace
}  // namespace snow

using namespace snow;

#define SNOW_NEIGHBOURS_SEARCH(BEST, SUFFIX, T)                                       \
  SNOW_KERNEL(neighbours_of_##BEST##SUFFIX, kThreads, NeighboursSearchParams<T>) {    \
    search<BEST>(int(p.n), p.points, p.order, p.chunk_boxes, p.group_boxes, int(p.k), \
                 p.distances);                                                        \
  }

#define SNOW_NEIGHBOURS_KERNELS(SUFFIX, T)                                      \
  SNOW_KERNEL(neighbours_codes##SUFFIX, kThreads, NeighboursCodesParams<T>) {   \
    codes(int(p.n), p.points, p.low, p.high, p.codes);                          \
  }                                                                             \
  SNOW_KERNEL(neighbours_chunks##SUFFIX, kThreads, NeighboursChunksParams<T>) { \
    chunks(int(p.n), p.points, p.order, p.ordered, p.boxes);                    \
  }                                                                             \
  SNOW_KERNEL(neighbours_groups##SUFFIX, kThreads, NeighboursGroupsParams<T>) { \
    groups(int(p.n), p.chunk_boxes, p.boxes);                                   \
  }                                                                             \
  SNOW_NEIGHBOURS_SEARCH(1, SUFFIX, T)                                          \
  SNOW_NEIGHBOURS_SEARCH(3, SUFFIX, T)                                          \
  SNOW_NEIGHBOURS_SEARCH(8, SUFFIX, T)                                          \
  SNOW_NEIGHBOURS_SEARCH(64, SUFFIX, T)

SNOW_NEIGHBOURS_KERNELS(, float)
SNOW_NEIGHBOURS_KERNELS(_f64, double)
