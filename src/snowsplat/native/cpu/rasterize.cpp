// Rasterization: composites the splats of each 16×16 tile front to back, and computes the gradient.
//
// Pixels are in SIMD lanes. A block is W adjacent pixels of one row (a whole row of the tile if
// W = 16). A tile has 256/W blocks, numbered by columns: block = (x / W) · 16 + y. For each pair of
// a tile and a splat, one vectorised test finds the blocks that the ellipse of the splat touches: a
// bit per block. The forward pass stores these bits for the backward pass.
//
// Forward   Chunks of 64 splats are processed block by block, so that the transmittance and the
//           colour of a block stay in registers during a chunk.
// Backward  The splats are processed one by one, front to back again. S is the dot product of
//           g = ∂L/∂C and the contribution of the splats behind the current one. At the start all
//           splats are behind, so S₀ = g·C is known. The derivative with respect to log α is
//           w·(g·c) − α S/(1 − α) for a splat with the weight w = α T and the colour c. This needs
//           no division by T, and for each pixel no index of the last splat that contributes to it.
//           The sums of a splat over its blocks stay in SIMD lanes. At the end, the lanes are added:
//           this is the gradient of the instance, which is written to its slot. After a band of
//           tiles, the slots are added to the rows of their splats. Each thread adds the slots of its
//           own splats, in the order of the tiles. No atomic operations are used, so the result
//           does not depend on the number of threads, and not on the size of the bands either.
#include <algorithm>
#include <memory>

#include "cpu/entry.h"
#include "cpu/pool.h"
#include "cpu/splat_record.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int kChunk = 64;
constexpr int64_t kBandSlots = 32768;  // slots of a band of tiles, for each thread

template <int W>
struct BlocksOf;
template <>
struct BlocksOf<16> {
  using Bits = uint16_t;
};
template <>
struct BlocksOf<8> {
  using Bits = uint32_t;
};
template <>
struct BlocksOf<4> {
  using Bits = uint64_t;
};

SNOW_INLINE int first_bit(uint64_t b) { return __builtin_ctzll(b); }

template <class V>
struct Tile {
  using T = typename V::Scalar;
  using Bits = typename BlocksOf<V::width>::Bits;
  static constexpr int W = V::width;
  static constexpr int kColumns = kTile / W;        // blocks side by side
  static constexpr int kBlocks = kTile * kColumns;  // blocks of a tile
  static constexpr int kRowVectors = kTile / W;     // vectors that hold one value per row

  int x, y, columns, rows;  // first pixel; size of the part inside the image

  Tile(int64_t index, int64_t tiles_x, int64_t width, int64_t height) {
    x = int(index % tiles_x) * kTile, y = int(index / tiles_x) * kTile;
    columns = width - x < kTile ? int(width - x) : kTile;
    rows = height - y < kTile ? int(height - y) : kTile;
  }
  // The number of lanes of a block that are inside the image.
  SNOW_INLINE int lanes(int block) const {
    const int n = columns - block / kTile * W;
    return block % kTile < rows ? (n < 0 ? 0 : n < W ? n : W) : 0;
  }
  SNOW_INLINE int64_t pixel(int block, int64_t width) const {
    return int64_t(y + block % kTile) * width + x + block / kTile * W;
  }
};

// The quadratic of a splat along each row of a tile: log₂α = (A X + p1[row]) X + p0[row] in column
// X of the tile. `touched_blocks` returns the bits of the blocks in which α may reach 1/255.
template <class V>
struct RowTerms {
  using T = typename V::Scalar;
  alignas(64) T p0[kTile], p1[kTile], dy[kTile];

  SNOW_INLINE void set(const SplatTerms<T>& s, const Tile<V>& tile) {
    const T x0 = s.mean_x - (T(tile.x) + T(0.5)), y0 = s.mean_y - (T(tile.y) + T(0.5));
    const V A(s.A), B(s.B), C(s.C), u(x0), log2_opacity(s.log2_opacity);
    for (int k = 0; k < Tile<V>::kRowVectors; k++) {
      const V d = V::iota() + V(T(k * V::width) - y0);
      const V b = B * d, at_mean = C * d * d + log2_opacity;
      (b - V(2.f) * A * u).store(p1 + k * V::width);
      ((A * u - b) * u + at_mean).store(p0 + k * V::width);
      d.store(dy + k * V::width);
    }
  }
  SNOW_INLINE typename Tile<V>::Bits touched_blocks(const SplatTerms<T>& s,
                                                    const Tile<V>& tile) const {
    const T x0 = s.mean_x - (T(tile.x) + T(0.5));
    const V threshold(kLog2MinAlpha - kCullSlack);
    typename Tile<V>::Bits bits = 0;
    for (int k = 0; k < Tile<V>::kRowVectors; k++) {
      const V d = V::load(dy + k * V::width), b = V(s.B) * d;
      const V at_mean = V(s.C) * d * d + V(s.log2_opacity);
      for (int c = 0; c < Tile<V>::kColumns; c++) {
        const T left = T(c * V::width) - x0;
        const V x = min(max(V(s.slope_x) * d, V(left)), V(left + T(V::width - 1)));
        const V peak = (V(s.A) * x + b) * x + at_mean;
        bits |= typename Tile<V>::Bits(V::bits(peak >= threshold)) << (c * kTile + k * V::width);
      }
    }
    return bits;
  }
};

// `add` receives, for each splat of a chunk, the bits of the blocks that it touches. After
// `finish`, `list` contains, for each block, the bits of the splats that touch it. So this
// transposes a matrix of bits.
template <class V>
struct BlockLists {
  uint64_t list[Tile<V>::kBlocks] = {};
  SNOW_INLINE void add(int splat, uint64_t blocks) {
    for (; blocks; blocks &= blocks - 1) list[first_bit(blocks)] |= uint64_t(1) << splat;
  }
  SNOW_INLINE void finish() {}
};
#if defined(__AVX2__)
template <>
struct BlockLists<Simd<float, 8>> {
  uint64_t list[32];
  alignas(32) uint8_t plane[4][kChunk] = {};  // byte p of `blocks` of each splat
  SNOW_INLINE void add(int splat, uint64_t blocks) {
    for (int p = 0; p < 4; p++) plane[p][splat] = uint8_t(blocks >> (8 * p));
  }
  SNOW_INLINE void finish() {
    for (int p = 0; p < 4; p++) {
      __m256i low = _mm256_load_si256((const __m256i*)plane[p]);
      __m256i high = _mm256_load_si256((const __m256i*)(plane[p] + 32));
      for (int bit = 7; bit >= 0; bit--) {  // the top bit of each byte, then shift
        list[8 * p + bit] = uint64_t(uint32_t(_mm256_movemask_epi8(low))) |
                            uint64_t(uint32_t(_mm256_movemask_epi8(high))) << 32;
        low = _mm256_add_epi8(low, low), high = _mm256_add_epi8(high, high);
      }
    }
  }
};
#endif
#if defined(__AVX512F__) && defined(__AVX512DQ__)
template <>
struct BlockLists<Simd<float, 16>> {
  alignas(64) uint32_t low[16], high[16];
  uint64_t list[16];
  __m512i lo = _mm512_setzero_si512(), hi = lo;
  SNOW_INLINE void add(int splat, uint64_t blocks) {
    const __mmask16 m = __mmask16(blocks);
    const __m512i bit = _mm512_set1_epi32(int(1u << (splat & 31)));
    if (splat < 32)
      lo = _mm512_mask_or_epi32(lo, m, lo, bit);
    else
      hi = _mm512_mask_or_epi32(hi, m, hi, bit);
  }
  SNOW_INLINE void finish() {
    _mm512_store_si512(low, lo), _mm512_store_si512(high, hi);
    for (int b = 0; b < 16; b++) list[b] = low[b] | uint64_t(high[b]) << 32;
  }
};
#endif

template <class V>
struct Frame {
  using T = typename V::Scalar;
  int64_t width, height, tiles_x;
  const SplatRecord<T>* records;
  const uint32_t *tile_start, *instance_splat;
  uint32_t* tile_end;
  typename Tile<V>::Bits* instance_blocks;

  explicit Frame(const FrameParams<T>& p)
      : width(p.width), height(p.height), tiles_x((p.width + kTile - 1) / kTile),
        records(p.records), tile_start(p.tile_start), instance_splat(p.instance_splat),
        tile_end(p.tile_end),
        instance_blocks(static_cast<typename Tile<V>::Bits*>(p.instance_blocks)) {}
};

// The gradient of an instance. The columns are those of a packed row with three or four colours.
template <class T>
struct alignas(64) Slot {
  T column[kPackedStride];

  // From the sums of the colours and of q = ∂L/∂(log α) over the pixels.
  template <int C>
  SNOW_INLINE void set(const SplatRecord<T>& r, const T* sums) {
    const T* q = sums + C;
    const T conic[3] = {T(-2 * kLn2) * r.terms.A, T(-kLn2) * r.terms.B, T(-2 * kLn2) * r.terms.C};
    splat_terms_vjp<T>(conic, r.opacity, {q[0], q[1], q[2], q[3], q[4], q[5]}, column, column + 2,
                       column[5]);
    column[6] = column[7] = T(0);
    for (int k = 0; k < kPackedStride - kPackedHeader; k++)
      column[kPackedHeader + k] = k < C ? sums[k] : T(0);
  }
};

// kCount: the value of a pixel is the number of splats that are composited. kMedian: the values are
// those of the splat at which the transmittance falls below 1/2, and after them, those of
// kFrontToBack without a background.
enum class Blend { kFrontToBack, kAdditive, kCount, kMedian };

template <class V, int C, Blend kBlend, class T = typename V::Scalar>
void forward_tile(const Frame<V>& f, int64_t index, int channels, const T* background, T* image,
                  T* alpha) {
  using TileV = Tile<V>;
  using Bits = typename TileV::Bits;
  constexpr int B = TileV::kBlocks, K = kBlend == Blend::kMedian ? 2 * C : C;
  const TileV tile(index, f.tiles_x, f.width, f.height);
  struct Block {
    V transmittance, color[K], rest;  // rest: the transmittance of each lane when it was finished
  };
  alignas(64) Block block[B];
  Bits open_blocks = 0;  // the bits of the blocks with lanes that are not finished
  for (int b = 0; b < B; b++) {
    const int n = tile.lanes(b);
    block[b].transmittance = block[b].rest = zero_unless(V::first(n), V(1.f));
    for (int k = 0; k < K; k++) block[b].color[k] = V(0.f);
    if (n) open_blocks |= Bits(1) << b;
  }
  const uint32_t end = f.tile_start[index + 1];
  uint32_t i = f.tile_start[index];
  RowTerms<V> rows[kChunk];
  const SplatRecord<T>* splat[kChunk];
  for (; i < end && open_blocks; i += kChunk) {
    const int n = end - i < kChunk ? int(end - i) : kChunk;
    Bits* blocks_of = f.instance_blocks + i;
    BlockLists<V> lists;
    for (int j = 0; j < n; j++) {
      prefetch(&f.records[f.instance_splat[i + j + 16 < end ? i + j + 16 : end - 1]]);
      const SplatRecord<T>& r = f.records[f.instance_splat[i + j]];
      splat[j] = &r;
      rows[j].set(r.terms, tile);
      const Bits touched = rows[j].touched_blocks(r.terms, tile) & open_blocks;
      blocks_of[j] = touched;
      lists.add(j, touched);
    }
    lists.finish();
    for (Bits todo = open_blocks; todo; todo &= Bits(todo - 1)) {
      const int b = first_bit(todo), row = b % kTile;
      uint64_t list = lists.list[b];
      if (!list) continue;
      const V X = V::iota() + V(T(b / kTile * V::width));
      V transmittance = block[b].transmittance, rest = block[b].rest, color[K];
      for (int k = 0; k < K; k++) color[k] = block[b].color[k];
      while (list) {
        const int j = first_bit(list);
        list &= list - 1;
        const SplatRecord<T>& r = *splat[j];
        const V power = (V(r.terms.A) * X + V(rows[j].p1[row])) * X + V(rows[j].p0[row]);
        if constexpr (kBlend == Blend::kAdditive) {
          const V weight = zero_unless(is_blended(power), exp2_blend(power));
          for (int k = 0; k < C; k++) color[k] += weight * V(r.color[k]);
          continue;
        }
        const V a = zero_unless(is_blended(power), capped_alpha(exp2_blend(power)));
        const V front = transmittance;
        V weight = a * transmittance;
        const V next = transmittance - weight;
        // A lane is finished if this splat would reduce its transmittance below the minimum. The
        // transmittance of a finished lane decreases further, so the lane stays finished. There is
        // no branch for single lanes, because it would often be mispredicted.
        const auto open = is_open(next);
        weight = zero_unless(open, weight);
        rest = select(open, next, rest);
        transmittance = next;
        if (__builtin_expect(!V::bits(open), 0)) {
          open_blocks &= Bits(~(Bits(1) << b));
          for (; list; list &= list - 1) blocks_of[first_bit(list)] &= Bits(~(Bits(1) << b));
        }
        if constexpr (kBlend == Blend::kCount)
          color[0] += zero_unless(is_blended(power) & open, V(1.f));
        else if constexpr (kBlend == Blend::kMedian) {
          const auto chosen = is_blended(power) & open & (front >= V(0.5f));
          for (int k = 0; k < C; k++) {
            color[k] = select(chosen, V(r.color[k]), color[k]);
            color[C + k] += weight * V(r.color[k]);
          }
        } else
          for (int k = 0; k < C; k++) color[k] += weight * V(r.color[k]);
      }
      block[b].transmittance = transmittance, block[b].rest = rest;
      for (int k = 0; k < K; k++) block[b].color[k] = color[k];
    }
  }
  f.tile_end[index] = i < end ? i : end;
  const int64_t plane = f.width * f.height;
  for (int b = 0; b < B; b++) {
    const int n = tile.lanes(b);
    if (!n) continue;
    const int64_t at = tile.pixel(b, f.width);
    const V rest = block[b].rest;
#pragma GCC unroll 4
    for (int k = 0; k < C; k++)
      if (k < channels) {
        if constexpr (kBlend == Blend::kMedian) {
          block[b].color[k].store_first(image + k * plane + at, n);
          block[b].color[C + k].store_first(image + (channels + k) * plane + at, n);
        } else {
          (block[b].color[k] + rest * V(background[k])).store_first(image + k * plane + at, n);
        }
      }
    if (alpha) (V(1.f) - rest).store_first(alpha + at, n);
  }
}

// grad_alpha may be null. image and grad_image contain only the channels of this pass (at most
// kGroupChannels).
// The slot of instance i is slots[i].
template <class V, int C, Blend kBlend, class T = typename V::Scalar>
void backward_tile(const Frame<V>& f, int64_t index, int channels, const T* image,
                   const T* grad_image, const T* alpha, const T* grad_alpha, Slot<T>* slots) {
  using TileV = Tile<V>;
  using Bits = typename TileV::Bits;
  constexpr int B = TileV::kBlocks;
  const TileV tile(index, f.tiles_x, f.width, f.height);
  const int64_t plane = f.width * f.height;
  struct Block {
    V transmittance, behind, grad[C], grad_alpha;
  };
  alignas(64) Block block[B];
  for (int b = 0; b < B; b++) {
    const int n = tile.lanes(b);
    const int64_t at = n ? tile.pixel(b, f.width) : 0;
    block[b].transmittance = zero_unless(V::first(n), V(1.f));
    V behind(0.f);
#pragma GCC unroll 4
    for (int k = 0; k < C; k++) {
      V g(0.f);
      if (k < channels) {
        g = V::load_first(grad_image + k * plane + at, n);
        behind += g * V::load_first(image + k * plane + at, n);
      }
      block[b].grad[k] = g;
    }
    block[b].grad_alpha = V(0.f);
    if (grad_alpha) {
      block[b].grad_alpha = V::load_first(grad_alpha + at, n);
      behind += block[b].grad_alpha * V::load_first(alpha + at, n);
    }
    block[b].behind = behind;
  }
  const V max_alpha(kMaxAlpha);
  const uint32_t end = f.tile_end[index];
  uint32_t i = f.tile_start[index];
  RowTerms<V> rows;
  for (; i < end; i++) {
    if (i + 12 < end) prefetch(&f.records[f.instance_splat[i + 12]]);
    const Bits touched = f.instance_blocks[i];
    if (!touched) continue;
    const SplatRecord<T>& r = f.records[f.instance_splat[i]];
    rows.set(r.terms, tile);
    const T x0 = r.terms.mean_x - (T(tile.x) + T(0.5));
    const V A(r.terms.A);
    V color[C], sums[C + 6];
    for (int k = 0; k < C; k++) color[k] = V(r.color[k]);
    for (int k = 0; k < C + 6; k++) sums[k] = V(0.f);
    for (int column = 0; column < TileV::kColumns; column++) {
      const V X = V::iota() + V(T(column * V::width));
      V q0(0.f), qy(0.f), qyy(0.f);
      uint32_t rows_left = uint32_t(touched >> (column * kTile)) & 0xffff;
      if (TileV::kColumns > 1 && !rows_left) continue;
      for (; rows_left; rows_left &= rows_left - 1) {
        const int row = __builtin_ctz(rows_left), b = column * kTile + row;
        Block& s = block[b];
        const V power = (A * X + V(rows.p1[row])) * X + V(rows.p0[row]);
        const V e = exp2_blend(power);
        V weight, q, grad_dot_color = s.grad_alpha;
        for (int k = 0; k < C; k++) grad_dot_color += color[k] * s.grad[k];
        if constexpr (kBlend == Blend::kAdditive) {
          weight = zero_unless(is_blended(power), e);
          q = weight * grad_dot_color;
        } else {
          const V a = zero_unless(is_blended(power), capped_alpha(e));
          weight = a * s.transmittance;
          const V next = s.transmittance - weight;
          const auto open = is_open(next);
          weight = zero_unless(open, weight);
          s.transmittance = next;
          const V weighted_dot = weight * grad_dot_color, behind = s.behind - weighted_dot;
          s.behind = behind;
          q = zero_unless(open & (e < max_alpha), log_alpha_gradient(weighted_dot, a, behind));
        }
        for (int k = 0; k < C; k++) sums[k] += weight * s.grad[k];
        const V dy(rows.dy[row]);
        q0 += q;
        qy += q * dy;
        qyy += q * (dy * dy);
      }
      const V dx = X - V(x0), qx = q0 * dx;
      sums[C] += q0, sums[C + 1] += qx, sums[C + 2] += qy;
      sums[C + 3] += qx * dx, sums[C + 4] += qy * dx, sums[C + 5] += qyy;
    }
    alignas(64) T total[16];
    sum_lanes<C + 6>(sums, total);
    slots[i].template set<C>(r, total);
  }
}

// Adds the slots of a band of tiles to the rows of those splats whose part is `part`. The number of
// parts is a power of two.
template <class V, class T = typename V::Scalar>
void add_slots(const RasterizeBackwardParams<T>& p, int64_t begin, int64_t end, uint32_t parts,
               uint32_t part, const Slot<T>* slots) {
  constexpr int kSplatsOfPart = 64;  // adjacent rows
  const Frame<V> f(p.frame);
  const int64_t stride = p.frame.stride, *columns = p.frame.columns;
  const int channels = int(p.channels);
  bool in_place = true;  // whether the colours of the slots are in the columns of the rows
  for (int k = 0; k < channels; k++) in_place &= columns[k] == kPackedHeader + k;
  for (int64_t tile = begin; tile < end; tile++) {
    const uint32_t last = f.tile_end[tile];
    for (uint32_t i = f.tile_start[tile]; i < last; i++) {
      if (i + 16 < last) prefetch_to_write(p.grad_packed + f.instance_splat[i + 16] * stride);
      const int64_t splat = f.instance_splat[i];
      if ((uint32_t(splat) / kSplatsOfPart & (parts - 1)) != part || !f.instance_blocks[i])
        continue;
      const T* slot = slots[i].column;
      T* row = p.grad_packed + splat * stride;
      if (in_place) {
        for (int k = 0; k < kPackedStride; k += V::width)
          (V::load(row + k) + V::load(slot + k)).store(row + k);
      } else {
        for (int k = 0; k < kPackedHeader - 2; k++) row[k] += slot[k];
        for (int k = 0; k < channels; k++) row[columns[k]] += slot[kPackedHeader + k];
      }
      if (p.abs_grad)
        for (int k = 0; k < 2; k++) p.abs_grad[2 * splat + k] += abs(slot[k]);
    }
  }
}

// The gradient of the background, per row: the sum over pixels of grad_image · (1 − alpha).
template <class T>
int64_t background_rows(const BackgroundBackwardParams<T>& p) {
  parallel_for(p.n, [&](int64_t y) {
    const T* alpha = p.alpha + y * p.width;
    for (int64_t k = 0; k < p.channels; k++) {
      const T* grad = p.grad_image + (k * p.n + y) * p.width;
      double sum = 0;
      for (int64_t x = 0; x < p.width; x++) sum += double(grad[x]) * (1.0 - double(alpha[x]));
      p.rows[y * p.channels + k] = sum;
    }
  });
  return 0;
}

template <class F>
void for_tiles(int64_t begin, int64_t end, F&& body) {
  constexpr int64_t kTilesPerTask = 4;  // adjacent tiles share splats in the cache
  parallel_for((end - begin + kTilesPerTask - 1) / kTilesPerTask, [&](int64_t task) {
    const int64_t first = begin + task * kTilesPerTask;
    for (int64_t t = first; t < end && t < first + kTilesPerTask; t++) body(t);
  });
}

template <class V, class T = typename V::Scalar>
int64_t forward(const RasterizeForwardParams<T>& p) {
  const Frame<V> f(p.frame);
  auto* const tile = p.frame.additive ? (p.channels <= 3 ? forward_tile<V, 3, Blend::kAdditive>
                                                         : forward_tile<V, 4, Blend::kAdditive>)
                                      : (p.channels <= 3 ? forward_tile<V, 3, Blend::kFrontToBack>
                                                         : forward_tile<V, 4, Blend::kFrontToBack>);
  for_tiles(0, p.n,
            [&](int64_t t) { tile(f, t, int(p.channels), p.background, p.image, p.alpha); });
  return 0;
}

template <class V, class T = typename V::Scalar>
int64_t median(const RasterizeForwardParams<T>& p) {
  const Frame<V> f(p.frame);
  const auto tile =
      p.channels <= 3 ? forward_tile<V, 3, Blend::kMedian> : forward_tile<V, 4, Blend::kMedian>;
  for_tiles(0, p.n, [&](int64_t t) { tile(f, t, int(p.channels), nullptr, p.image, p.alpha); });
  return 0;
}

template <class V, class T = typename V::Scalar>
int64_t count(const RasterizeCountParams<T>& p) {
  const Frame<V> f(p.frame);
  const T nothing_behind = 0;
  for_tiles(0, p.n, [&](int64_t t) {
    forward_tile<V, 1, Blend::kCount, T>(f, t, 1, &nothing_behind, p.counts, nullptr);
  });
  return 0;
}

template <class V, class T = typename V::Scalar>
int64_t backward(const RasterizeBackwardParams<T>& p) {
  const Frame<V> f(p.frame);
  auto* const tile = p.frame.additive
                         ? (p.channels <= 3 ? backward_tile<V, 3, Blend::kAdditive>
                                            : backward_tile<V, 4, Blend::kAdditive>)
                         : (p.channels <= 3 ? backward_tile<V, 3, Blend::kFrontToBack>
                                            : backward_tile<V, 4, Blend::kFrontToBack>);
  int64_t largest = 0;  // number of instances of a tile
  for (int64_t t = 0; t < p.n; t++)
    largest = std::max(largest, int64_t(f.tile_start[t + 1]) - f.tile_start[t]);
  const int64_t capacity = std::max(largest, kBandSlots * pool_size());
  const int64_t count = std::min(capacity, int64_t(f.tile_start[p.n]));
  const std::unique_ptr<Slot<T>[]> memory(new Slot<T>[size_t(count)]);
  uint32_t parts = 1;
  while (int(parts) < pool_size()) parts *= 2;
  for (int64_t begin = 0, end; begin < p.n; begin = end) {
    const int64_t first = f.tile_start[begin];
    for (end = begin + 1; end < p.n && f.tile_start[end + 1] - first <= capacity;) end++;
    Slot<T>* slots = memory.get() - first;
    for_tiles(begin, end, [&](int64_t t) {
      tile(f, t, int(p.channels), p.image, p.grad_image, p.alpha, p.grad_alpha, slots);
    });
    parallel_for(parts,
                 [&](int64_t part) { add_slots<V>(p, begin, end, parts, uint32_t(part), slots); });
  }
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(rasterize_fwd, RasterizeForwardParams<float>) { return forward<VecF>(p); }
SNOW_ENTRY(rasterize_fwd_f64, RasterizeForwardParams<double>) { return forward<VecD>(p); }
SNOW_ENTRY(rasterize_median, RasterizeForwardParams<float>) { return median<VecF>(p); }
SNOW_ENTRY(rasterize_median_f64, RasterizeForwardParams<double>) { return median<VecD>(p); }
SNOW_ENTRY(rasterize_count, RasterizeCountParams<float>) { return count<VecF>(p); }
SNOW_ENTRY(rasterize_count_f64, RasterizeCountParams<double>) { return count<VecD>(p); }
SNOW_ENTRY(rasterize_bwd, RasterizeBackwardParams<float>) { return backward<VecF>(p); }
SNOW_ENTRY(rasterize_bwd_f64, RasterizeBackwardParams<double>) { return backward<VecD>(p); }
SNOW_ENTRY(background_bwd, BackgroundBackwardParams<float>) { return background_rows(p); }
SNOW_ENTRY(background_bwd_f64, BackgroundBackwardParams<double>) { return background_rows(p); }

// Bytes of instance_blocks per instance.
SNOW_ENTRY(rasterize_block_bytes, SizeQueryParams) { return (void)p, sizeof(Tile<VecF>::Bits); }
SNOW_ENTRY(rasterize_block_bytes_f64, SizeQueryParams) { return (void)p, sizeof(Tile<VecD>::Bits); }
// 1: the caller allocates slots for all instances; 0: rasterize_bwd adds to the rows of the splats.
SNOW_ENTRY(rasterize_has_slots, SizeQueryParams) { return (void)p, 0; }
// The places in a list of n instances at which the backward pass cuts tiles into segments, at most.
SNOW_ENTRY(rasterize_boundaries, SizeQueryParams) { return (void)p, 0; }
