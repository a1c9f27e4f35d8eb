// Rasterization: composites the splats of each 16×16 tile front to back; and its gradient. One block
// per tile, one warp per 8×4 pixels, one thread per pixel.
//
// Culling   Instances are loaded into shared memory in batches. Each lane tests one of 32 against its
//           warp's rectangle, exactly, and the warp composites only those that touch it. A byte per
//           instance, one bit per warp, stores this for the backward pass.
// Forward   A pixel's transmittance and colour stay in the registers of its thread. A tile ends when
//           its last pixel is finished; tile_end stores the end of the visited instances.
// Backward  goes front to back again, with S = ∂L/∂C · (contribution of the splats behind), known
//           at the start: S₀ = ∂L/∂C · C, since all splats are behind. The derivative with respect to
//           log α is w·(g·c) − α S/(1 − α): no division by T, no last index per pixel, and no state
//           of the forward pass except the image.
//
// The gradient of a splat is a sum over pixels, and the most expensive part is adding numbers of different
// threads. This is done with one thread per splat, as in the bucketed backward pass of Mallick et al. 2024
// ("Taming 3DGS"), but within a tile:
//   1. One thread per pixel: w = T α and q = ∂L/∂(log α) of eight splats, into shared memory.
//   2. One thread per splat and row of the rectangle: reads w and q of the row's eight pixels, and
//      sums w·g, and q times the powers of d. Two exchanges add the four rows of a splat.
//   3. After 32 instances: the sums of the warps are added, in order. The result is one gradient per
//      splat and tile; it goes to its slot, or is added to the splat's row atomically.
//
// w and q are stored between the steps. Computing them again with one thread per splat, passing the
// states of pixels from lane to lane, would take some 50 instructions, two of them slow, for every
// pixel of the tile; step 2 takes 23 for the pixels of rectangles that the splat touches.
//
// Instructions per warp, counted in the code for sm_80 to sm_120 with three channels, not timed:
// forward 26 to 30 for a splat and its rectangle of 32 pixels; backward 38 to 42 for the same in
// step 1, 180 for eight of them in step 2, and 240 for 32 instances in step 3.
#include "cuda/device.h"
#include "rasterize.h"

namespace snow {
namespace {

constexpr int kRectWidth = 8, kRectHeight = 4, kRectsAcross = kTile / kRectWidth;
constexpr int kWarps = kTile * kTile / kWarp, kBlock = kTile * kTile;
constexpr int kForwardBatch = kBlock, kBackwardBatch = 64;

// Four numbers that are read at once (if they are float, by one instruction).
template <class T>
struct alignas(16) Four {
  T x, y, z, w;
};
template <class T>
struct alignas(2 * sizeof(T)) Two {
  T x, y;
};

// The pixel of a thread and the rectangle of its warp.
struct Seat {
  int left, top;  // of the rectangle
  int x, y;
  bool inside;
  int64_t plane, at;  // `plane`: number of pixels of the image; `at`: index of this pixel

  SNOW_INLINE Seat(int width, int height) {
    const int tiles_x = (width + kTile - 1) / kTile, tile = int(blockIdx.x);
    left = tile % tiles_x * kTile + warp_id() % kRectsAcross * kRectWidth;
    top = tile / tiles_x * kTile + warp_id() / kRectsAcross * kRectHeight;
    x = left + lane_id() % kRectWidth, y = top + lane_id() / kRectWidth;
    inside = x < width && y < height;
    plane = int64_t(width) * height, at = int64_t(y) * width + x;
  }
};

template <class T>
SNOW_INLINE T centre(int pixel) {
  return T(pixel) + T(0.5);
}

template <class T, int kSize>
struct Batch {
  Four<T> shape[kSize];   // mean_x, mean_y, A, B
  Four<T> look[kSize];    // C, log2_opacity, colours 0 and 1
  Two<T> look_on[kSize];  // colours 2 and 3
};

// Loads the splat of an instance into entry `place` of the batch.
template <int C, int kSize, class T>
SNOW_INLINE SplatTerms<T> load(const FrameParams<T>& f, uint32_t instance, Batch<T, kSize>& batch,
                               int place) {
  const T* row = f.packed + f.instance_splat[instance] * f.stride;
  const Four<T> first = *reinterpret_cast<const Four<T>*>(row);
  const Four<T> second = *reinterpret_cast<const Four<T>*>(row + 4);
  T color[kGroupChannels] = {};
#pragma unroll
  for (int k = 0; k < C; k++) {
    const int column = int(f.columns[k]);
    if (column >= 0) color[k] = row[column];
  }
  const T conic[3] = {first.z, first.w, second.x};
  const SplatTerms<T> s = splat_terms(first.x, first.y, conic, second.y);
  batch.shape[place] = {s.mean_x, s.mean_y, s.A, s.B};
  batch.look[place] = {s.C, s.log2_opacity, color[0], color[1]};
  batch.look_on[place] = {color[2], color[3]};
  return s;
}

// The batch indices of the instances that touch a warp's rectangle, in order.
using Touching = uint8_t[kWarp];

// Lists the batch indices of the lanes whose splat touches the rectangle, and returns their number.
// The warp has to synchronize before it is called again.
SNOW_INLINE int list_touching(Touching& list, unsigned lanes, int place) {
  const int lane = lane_id();
  if (lanes >> lane & 1) list[__popc(lanes & ((1u << lane) - 1))] = uint8_t(place);
  __syncwarp();
  return __popc(lanes);
}

// −|a|: one instruction on a GPU.
SNOW_INLINE float negative(float a) { return ::fminf(a, -a); }
SNOW_INLINE double negative(double a) { return ::fmin(a, -a); }

template <class T>
struct Pixel {
  T x, y;
  T rest;  // the transmittance; its negative if the pixel is finished or outside of the image

  SNOW_INLINE explicit Pixel(const Seat& seat)
      : x(centre<T>(seat.x)), y(centre<T>(seat.y)), rest(seat.inside ? T(1) : T(-1)) {}

  SNOW_INLINE bool unfinished() const { return rest > T(0); }
  SNOW_INLINE T transmittance() const { return max(rest, -rest); }

  // Composites a splat; returns whether it contributes, its weight (0 if not), and α before and
  // after the limit 0.99. Both passes must make the same decisions, so every rounding is explicit
  // (fma). In a finished pixel `next` is negative, so nothing more is composited.
  SNOW_INLINE bool blend(const Four<T>& shape, const Four<T>& look, T& uncapped, T& alpha,
                         T& weight) {
    const T dx = x - shape.x, dy = y - shape.y;
    const T power = fma(fma(shape.z, dx, shape.w * dy), dx, fma(look.x * dy, dy, look.y));
    uncapped = exp2_blend(power), alpha = capped_alpha(uncapped);
    const T next = fma(-alpha, rest, rest);
    const bool visible = is_blended(power), open = is_open(next);
    const bool blended = visible && open;
    weight = blended ? alpha * rest : T(0);
    if (blended) rest = next;
    if (visible && !open) rest = negative(rest);
    return blended;
  }
};

template <class T>
struct ForwardMemory {
  Batch<T, kForwardBatch> batch;
  Two<T> slopes[kForwardBatch];
  Touching list[kWarps];
  uint32_t touched[kForwardBatch / kWarp]
                  [kWarps];  // by rectangle: one bit for each of 32 instances
  uint32_t ends[kWarps];
};

// With `kCount`, the image is the number of splats that were composited.
template <int C, bool kCount, class T>
SNOW_INLINE void forward(const FrameParams<T>& f, int channels, const T* background, T* image,
                         T* alpha, ForwardMemory<T>& memory) {
  uint8_t* const instance_blocks = static_cast<uint8_t*>(f.instance_blocks);
  const Seat seat(int(f.width), int(f.height));
  const int thread = int(threadIdx.x), warp = warp_id(), lane = lane_id();
  Pixel<T> pixel(seat);
  T color[C] = {};
  const uint32_t end = f.tile_start[blockIdx.x + 1];
  uint32_t base = f.tile_start[blockIdx.x], looked_at = base;
  bool warp_unfinished = __any_sync(kAllLanes, pixel.unfinished());
  for (; base < end; base += kForwardBatch) {
    // Also waits until all threads have finished the last batch.
    if (!__syncthreads_or(pixel.unfinished())) break;
    const int count = end - base < kForwardBatch ? int(end - base) : kForwardBatch;
    if (thread < count) {
      const SplatTerms<T> s = load<C>(f, base + uint32_t(thread), memory.batch, thread);
      memory.slopes[thread] = {s.slope_x, s.slope_y};
    }
    __syncthreads();
    for (int first = 0; first < count; first += kWarp) {
      bool touches = false;
      const int own = first + lane;
      if (warp_unfinished && own < count) {
        const Four<T> shape = memory.batch.shape[own], look = memory.batch.look[own];
        const Two<T> slope = memory.slopes[own];
        const SplatTerms<T> s = {shape.x, shape.y, shape.z, shape.w,
                                 look.x,  look.y,  slope.x, slope.y};
        const T x = centre<T>(seat.left) - s.mean_x, y = centre<T>(seat.top) - s.mean_y;
        const T peak = peak_over_rectangle(s, x, y, x + T(kRectWidth - 1), y + T(kRectHeight - 1));
        touches = peak + s.log2_opacity >= T(kLog2MinAlpha - kCullSlack);
      }
      const unsigned lanes = __ballot_sync(kAllLanes, touches);
      if (lane == 0) memory.touched[first / kWarp][warp] = lanes;
      if (warp_unfinished)
        looked_at = base + uint32_t(first + kWarp < count ? first + kWarp : count);
      const int listed = list_touching(memory.list[warp], lanes, own);
      for (int j = 0; j < listed; j++) {
        const int i = memory.list[warp][j];
        const Four<T> look = memory.batch.look[i];
        T uncapped, a, weight;
        const bool blended = pixel.blend(memory.batch.shape[i], look, uncapped, a, weight);
        if constexpr (kCount) {
          color[0] += blended ? T(1) : T(0);
        } else {
          const Two<T> look_on = memory.batch.look_on[i];
          const T splat[kGroupChannels] = {look.z, look.w, look_on.x, look_on.y};
#pragma unroll
          for (int k = 0; k < C; k++) color[k] += weight * splat[k];
        }
      }
      warp_unfinished = __any_sync(kAllLanes, pixel.unfinished());
      __syncwarp();
    }
    __syncthreads();
    if (thread < count) {
      unsigned bits = 0;
#pragma unroll
      for (int w = 0; w < kWarps; w++) bits |= (memory.touched[warp][w] >> lane & 1) << w;
      instance_blocks[base + uint32_t(thread)] = uint8_t(bits);
    }
  }
  if (lane == 0) memory.ends[warp] = looked_at;
  __syncthreads();
  if (thread == 0) {
    for (int w = 1; w < kWarps; w++)
      if (memory.ends[w] > looked_at) looked_at = memory.ends[w];
    f.tile_end[blockIdx.x] = looked_at;
  }
  if (!seat.inside) return;
  const T rest = pixel.transmittance();
#pragma unroll
  for (int k = 0; k < C; k++)
    if (k < channels)
      image[k * seat.plane + seat.at] = kCount ? color[k] : color[k] + rest * background[k];
  if (alpha) alpha[seat.at] = T(1) - rest;
}

constexpr int kGroup = kWarp / kRectHeight;  // splats that a warp processes at a time
constexpr int kSums = kGroupChannels + 6;
// Strides chosen so that the numbers of one column are in different banks.
constexpr int kPairStride = kWarp + 2, kSumStride = kSums + 1;

// Scratch of a warp, reused: steps 1 and 2, then step 3.
template <class T>
union WarpScratch {
  Two<T> pairs[kGroup * kPairStride];       // steps 1 and 2: w and q, of each splat and pixel
  Four<T> quads[kGroup * kPairStride / 2];  // the same, of two pixels at a time
  T sums[kWarp][kSumStride];                // step 3: the sums of each of 32 instances
};

// ∂L/∂C of each pixel, in the order of threads; read four at a time.
template <class T>
union PixelGrads {
  T one[kGroupChannels][kBlock];
  Four<T> quads[kGroupChannels * kBlock / 4];
};

template <class T>
struct BackwardMemory {
  Batch<T, kBackwardBatch> batch;
  PixelGrads<T> grads;
  WarpScratch<T> scratch[kWarps];
  Touching list[kWarps];
  uint8_t touched[kBackwardBatch];  // the byte of the forward pass of each instance
};

// Sums of a splat over pixels: of C colours, then the moments.
template <int C, class T>
struct Sums {
  static constexpr int kHalf = (C + 7) / 2;
  T value[2 * kHalf] = {};

  // Step 2: a splat and a row of a rectangle, whose first pixel is (dx, dy) from the mean; w and
  // q of its pixels are in `pairs`, ∂L/∂C in `grads`.
  SNOW_INLINE void add_row(const Four<T>* pairs, const Four<T>* grads, T dx, T dy) {
    T q0(0), qx(0), qxx(0);
#pragma unroll
    for (int x = 0; x < kRectWidth; x += 4) {
      const Four<T> a = pairs[x / 2], b = pairs[x / 2 + 1];
#pragma unroll
      for (int k = 0; k < C; k++) {
        const Four<T> g = grads[(k * kBlock + x) / 4];
        value[k] += a.x * g.x;
        value[k] += a.z * g.y;
        value[k] += b.x * g.z;
        value[k] += b.z * g.w;
      }
      const T q[4] = {a.y, a.w, b.y, b.w};
#pragma unroll
      for (int j = 0; j < 4; j++) {
        const T d = dx + T(x + j), qd = q[j] * d;
        q0 += q[j], qx += qd, qxx += qd * d;
      }
    }
    const T qy = q0 * dy;
    value[C] = q0, value[C + 1] = qx, value[C + 2] = qy;
    value[C + 3] = qxx, value[C + 4] = qx * dy, value[C + 5] = qy * dy;
  }
};

// The sums of up to 32 splats that a warp has processed. Each lane stores half of the sums of two
// splats; the upper half-warp stores the second half.
template <int C, class T>
struct KeptSums {
  static constexpr int kHalf = Sums<C, T>::kHalf, kWays = kWarp / kGroup / 2;
  T kept[kWays][kHalf] = {};

  // Adds the sums of the lanes of a splat, one row each; two of these lanes store the result.
  SNOW_INLINE void keep(const Sums<C, T>& rows, int group) {
    const bool upper = lane_id() >= kWarp / 2;
    const int odd = int(threadIdx.x / kGroup % 2);
#pragma unroll
    for (int k = 0; k < kHalf; k++) {
      const T low = rows.value[k], high = rows.value[kHalf + k];
      T sum = upper ? high : low;
      sum += __shfl_xor_sync(kAllLanes, upper ? low : high, kWarp / 2);
      sum += __shfl_xor_sync(kAllLanes, sum, kGroup);
#pragma unroll
      for (int way = 0; way < kWays; way++)
        if (group == 2 * way + odd) kept[way][k] = sum;
    }
  }
  // Writes them to the sums of 32 instances, the first of them at place `first` of the batch.
  SNOW_INLINE void store(const Touching& list, int listed, int first,
                         T (&sums)[kWarp][kSumStride]) const {
    const bool upper = lane_id() >= kWarp / 2;
#pragma unroll
    for (int way = 0; way < kWays; way++) {
      const int at = way * 2 * kGroup + int(threadIdx.x % (2 * kGroup));
      if (at >= listed) continue;
      T* const to = sums[list[at] - first] + (upper ? kHalf : 0);
#pragma unroll
      for (int k = 0; k < kHalf; k++) to[k] = kept[way][k];
    }
  }
};

// The gradient from the sums of an instance, one thread each, as in splat_terms_vjp: a multiple of
// the sum itself. The two gradients of the mean also depend on the other sum. All threads of a warp
// take part.
template <int C, class T>
SNOW_INLINE T gradient_of(T sum, int moment, const Four<T>& shape, const Four<T>& look) {
  const T other = __shfl_sync(kAllLanes, sum, moment == 1 ? C + 2 : C + 1, kSlotWidth);
  const bool of_mean = moment == 1 || moment == 2;
  // a, b and c from A, B and C.
  T factor = T(-2 * kLn2) * (moment == 1 ? shape.z : look.x);
  if (!of_mean) factor = moment == 4 ? T(-1) : T(-0.5);
  if (moment == 0) factor = exp2_blend(-look.y);
  if (moment < 0) factor = T(1);
  return factor * sum + (of_mean ? T(-kLn2) * shape.w * other : T(0));
}

// A pixel in the backward pass: the sum over the splats behind the current one, and its gradients.
template <int C, class T>
struct PixelGradient {
  Pixel<T> pixel;
  T behind, grad[C], grad_alpha;

  // Reads the gradients of the thread's pixel, and stores those of its colours for step 2.
  SNOW_INLINE PixelGradient(const Seat& seat, const RasterizeBackwardParams<T>& p,
                            PixelGrads<T>& grads)
      : pixel(seat), behind(0), grad_alpha(0) {
#pragma unroll
    for (int k = 0; k < C; k++) {
      grad[k] = T(0);
      if (seat.inside && k < int(p.channels)) {
        grad[k] = p.grad_image[k * seat.plane + seat.at];
        behind += grad[k] * p.image[k * seat.plane + seat.at];
      }
      grads.one[k][threadIdx.x] = grad[k];
    }
    if (seat.inside && p.grad_alpha) {
      grad_alpha = p.grad_alpha[seat.at];
      behind += grad_alpha * p.alpha[seat.at];
    }
  }

  // Step 1: composites a splat of the batch; returns w and q.
  SNOW_INLINE Two<T> add(const Batch<T, kBackwardBatch>& batch, int i) {
    const Four<T> look = batch.look[i];
    const Two<T> look_on = batch.look_on[i];
    T uncapped, alpha, weight, seen = grad_alpha;
    const bool blended = pixel.blend(batch.shape[i], look, uncapped, alpha, weight);
    const T splat[kGroupChannels] = {look.z, look.w, look_on.x, look_on.y};
#pragma unroll
    for (int k = 0; k < C; k++) seen += splat[k] * grad[k];
    const T ahead = weight * seen;
    behind -= ahead;
    const T q = log_alpha_gradient(ahead, alpha, behind);
    return {weight, blended && uncapped < T(kMaxAlpha) ? q : T(0)};
  }
};

// Steps 1 and 2 for the 32 instances from place `first` of the batch on: composites those that touch
// the warp's rectangle and stores the sums over its pixels in the warp's scratch.
template <int C, class T>
SNOW_INLINE void sum_over_pixels(const Seat& seat, PixelGradient<C, T>& own, int count, int first,
                                 BackwardMemory<T>& memory) {
  const int warp = warp_id(), lane = lane_id();
  // In step 2: the thread's splat within the group, and its row of the rectangle.
  const int slot = lane % kGroup, row = lane / kGroup;
  WarpScratch<T>& scratch = memory.scratch[warp];
  const Four<T>* const row_pairs = scratch.quads + (slot * kPairStride + row * kRectWidth) / 2;
  const Four<T>* const row_grads = memory.grads.quads + (warp * kWarp + row * kRectWidth) / 4;

  const bool touches = first + lane < count && memory.touched[first + lane] >> warp & 1;
  const unsigned lanes = __ballot_sync(kAllLanes, touches);
  const Touching& list = memory.list[warp];
  const int listed = list_touching(memory.list[warp], lanes, first + lane);
  KeptSums<C, T> sums;
  for (int done = 0; done < listed; done += kGroup) {
    if (!__any_sync(kAllLanes, own.pixel.unfinished())) break;
    const int group = listed - done < kGroup ? listed - done : kGroup;
    Two<T>* pair = scratch.pairs + lane;
    for (int j = 0; j < group; j++, pair += kPairStride)
      *pair = own.add(memory.batch, list[done + j]);
    __syncwarp();
    Sums<C, T> rows;
    if (slot < group) {
      const Four<T> shape = memory.batch.shape[list[done + slot]];
      rows.add_row(row_pairs, row_grads, centre<T>(seat.left) - shape.x,
                   centre<T>(seat.top + row) - shape.y);
    }
    sums.keep(rows, done / kGroup);
    __syncwarp();
  }
  sums.store(list, listed, first, scratch.sums);
}

// Step 3 uses 16 threads per instance, one per sum.
struct SumSeat {
  int place, column;  // the instance of 16, the number within it
  int to;             // the column of the packed gradient that the number belongs to

  SNOW_INLINE SumSeat(int channels, const int64_t* columns)
      : place(int(threadIdx.x) / kSlotWidth), column(int(threadIdx.x) % kSlotWidth),
        to(column < channels    ? int(columns[column])
           : column == channels ? 5
                                : column - channels - 1) {}
};

// Step 3: adds the sums of the warps for the 32 instances from place `first` of the batch on, in order,
// and writes the gradient of each to its slot or adds it to the row of its splat. All threads of the
// block take part; it waits for all of them before and after.
template <int C, class T>
SNOW_INLINE void add_warps(const RasterizeBackwardParams<T>& p, const SumSeat& seat, uint32_t base,
                           int count, int first, BackwardMemory<T>& memory) {
  constexpr int kPlaces = kBlock / kSlotWidth, kRounds = kWarp / kPlaces;
  uint32_t target[kRounds] = {};  // loaded before the wait
#pragma unroll
  for (int h = 0; h < kRounds; h++) {
    const int i = first + seat.place + h * kPlaces;
    if (i < count)
      target[h] = (p.slots ? p.instance_slot : p.frame.instance_splat)[base + uint32_t(i)];
  }
  __syncthreads();
#pragma unroll
  for (int h = 0; h < kRounds; h++) {
    const int from = seat.place + h * kPlaces, i = first + from;
    const unsigned warps = i < count && seat.column < C + 6 ? memory.touched[i] : 0;
    T sum(0);
#pragma unroll
    for (int w = 0; w < kWarps; w++)
      if (warps >> w & 1) sum += memory.scratch[w].sums[from][seat.column];
    if (p.slots) {
      if (i < count) p.slots[int64_t(target[h]) * kSlotWidth + seat.column] = sum;
    } else {
      sum = gradient_of<C>(sum, seat.column - C, memory.batch.shape[i], memory.batch.look[i]);
      if (warps && seat.to >= 0 && sum != T(0))
        atomicAdd(p.grad_packed + target[h] * p.frame.stride + seat.to, sum);
    }
  }
  __syncthreads();
}

template <int C, class T>
SNOW_INLINE void backward(const RasterizeBackwardParams<T>& p, BackwardMemory<T>& memory) {
  const FrameParams<T>& f = p.frame;
  const uint8_t* const instance_blocks = static_cast<const uint8_t*>(f.instance_blocks);
  const Seat seat(int(f.width), int(f.height));
  const int thread = int(threadIdx.x);
  PixelGradient<C, T> own(seat, p, memory.grads);
  const SumSeat sum_seat(C, f.columns);

  const uint32_t end = f.tile_end[blockIdx.x];
  for (uint32_t base = f.tile_start[blockIdx.x]; base < end; base += kBackwardBatch) {
    const int count = end - base < kBackwardBatch ? int(end - base) : kBackwardBatch;
    if (thread < count) {
      load<C>(f, base + uint32_t(thread), memory.batch, thread);
      memory.touched[thread] = instance_blocks[base + uint32_t(thread)];
    }
    __syncthreads();
    for (int first = 0; first < count; first += kWarp) {
      sum_over_pixels<C>(seat, own, count, first, memory);
      add_warps<C>(p, sum_seat, base, count, first, memory);
    }
  }
  if (!p.slots) return;
  // The instances behind the last one that the forward pass visited.
  const uint32_t last = f.tile_start[blockIdx.x + 1];
  for (uint32_t i = end + uint32_t(thread / kSlotWidth); i < last; i += kBlock / kSlotWidth)
    p.slots[int64_t(p.instance_slot[i]) * kSlotWidth + thread % kSlotWidth] = T(0);
}

// Sum over pixels of grad_image · (1 − alpha): the gradient of the background. One block per row of
// pixels, one warp per channel.
template <class T>
SNOW_INLINE void background_row(const BackgroundBackwardParams<T>& p) {
  const int height = int(p.n), width = int(p.width), channels = int(p.channels);
  const int64_t y = blockIdx.x;
  for (int k = warp_id(); k < channels; k += int(blockDim.x) / kWarp) {
    const T* grad = p.grad_image + (int64_t(k) * height + y) * width;
    const T* covered = p.alpha + y * width;
    double sum = 0;
    for (int x = lane_id(); x < width; x += kWarp)
      sum += double(grad[x]) * (1.0 - double(covered[x]));
#pragma unroll
    for (int step = kWarp / 2; step; step /= 2) sum += __shfl_xor_sync(kAllLanes, sum, step);
    if (lane_id() == 0) p.rows[y * channels + k] = sum;
  }
}

}  // namespace
}  // namespace snow

using namespace snow;

// Minimum number of blocks per multiprocessor, which limits the registers. Compute capability 7.5 has
// threads for at most four blocks of the forward pass; four blocks of the backward pass fit into
// 100 KiB of shared memory.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
#define SNOW_FORWARD_BLOCKS 4
#else
#define SNOW_FORWARD_BLOCKS 5
#endif
#define SNOW_BACKWARD_BLOCKS 4

#define SNOW_RASTERIZE_KERNELS(SUFFIX, T, FORWARD_BLOCKS, BACKWARD_BLOCKS)                     \
  SNOW_KERNEL_OF(rasterize_fwd##SUFFIX, kBlock, FORWARD_BLOCKS, RasterizeForwardParams<T>) {   \
    SNOW_SHARED(ForwardMemory<T>, memory, 1);                                                  \
    const int channels = int(p.channels);                                                      \
    if (channels <= 3)                                                                         \
      forward<3, false>(p.frame, channels, p.background, p.image, p.alpha, *memory);           \
    else                                                                                       \
      forward<4, false>(p.frame, channels, p.background, p.image, p.alpha, *memory);           \
  }                                                                                            \
  SNOW_KERNEL(rasterize_count##SUFFIX, kBlock, RasterizeCountParams<T>) {                      \
    SNOW_SHARED(ForwardMemory<T>, memory, 1);                                                  \
    forward<1, true, T>(p.frame, 1, nullptr, p.counts, nullptr, *memory);                      \
  }                                                                                            \
  SNOW_KERNEL_OF(rasterize_bwd##SUFFIX, kBlock, BACKWARD_BLOCKS, RasterizeBackwardParams<T>) { \
    SNOW_SHARED(BackwardMemory<T>, memory, 1);                                                 \
    if (p.channels <= 3)                                                                       \
      backward<3>(p, *memory);                                                                 \
    else                                                                                       \
      backward<4>(p, *memory);                                                                 \
  }                                                                                            \
  SNOW_KERNEL(background_bwd##SUFFIX, 128, BackgroundBackwardParams<T>) { background_row(p); }

SNOW_RASTERIZE_KERNELS(, float, SNOW_FORWARD_BLOCKS, SNOW_BACKWARD_BLOCKS)
SNOW_RASTERIZE_KERNELS(_f64, double, 1, 1)
