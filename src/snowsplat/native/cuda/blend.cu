// Blending: the splats of each 16×16 tile, front to back, and the gradient of that. A block a tile,
// a warp a rectangle of 8×4 pixels of it, a thread a pixel.
//
// Culling   Instances come in batches to shared memory. Of 32 at a time each lane tests one against
//           its warp's rectangle, exactly, and the warp blends those that touch it and no others. A
//           byte an instance, a bit a warp, keeps this for the backward pass.
// Forward   A pixel's transmittance and colour stay in the registers of its thread. The tile ends
//           with its last pixel, and tile_end says where.
// Backward  goes front to back again, with S = Σ of what lies behind (known at the start:
//           S₀ = ∂L/∂C · C, since the whole pixel lies behind). The derivative with respect to
//           log α is w·(g·c) − α S/(1 − α): no division by T, no last index a pixel, and no state
//           from the forward pass but the image.
//
// The gradient of a splat is a sum over pixels, and to sum numbers that lie in different threads is
// what costs most, so it is done with a thread a splat, as in the bucketed backward pass of Mallick
// et al. 2024 ("Taming 3DGS"), but inside of a tile. A warp takes eight of its splats at a time:
//   1. A thread a pixel: w = T α and q = ∂L/∂(log α) of each of the eight, into shared memory.
//   2. A thread a splat and row of the rectangle: it reads w and q of the row's eight pixels, and
//      sums w·g, and q times the powers of d. Two exchanges make the four rows of a splat one.
// After 32 instances the sums of the warps are added, in order. What remains is one gradient for
// each splat and tile: it goes to its slot, or is added to the splat's row atomically.
//
// w and q are kept between the steps. To find them again with a thread a splat, the states of
// pixels passing from lane to lane, would be some 50 instructions, two of them slow, for every
// pixel of the tile, where step 2 is 23 for the pixels of rectangles that the splat touches.
//
// Instructions of a warp, counted in the code for sm_80 to sm_120 with three channels, not timed:
// forward 26 to 30 for a splat and its rectangle, that is 32 pixels; backward 38 to 42 for the same
// in step 1, 180 for eight of them in step 2, and 240 for 32 instances in the end.
#include "blend.h"
#include "cuda/device.h"

namespace snow {
namespace {

constexpr int kRectWidth = 8, kRectHeight = 4, kRectsAcross = kTile / kRectWidth;
constexpr int kWarps = kTile * kTile / kWarp, kBlock = kTile * kTile;
constexpr int kForwardBatch = kBlock, kBackwardBatch = 64;

// Four numbers that are read at once (of float: by one instruction).
template <class T>
struct alignas(16) Four {
  T x, y, z, w;
};
template <class T>
struct alignas(2 * sizeof(T)) Two {
  T x, y;
};

template <class T>
struct Frame {
  int width, height;
  const T* packed;
  int64_t stride;
  const int64_t* columns;
  const uint32_t* tile_start;
  uint32_t* tile_end;
  const uint32_t* instance_splat;
  uint8_t* instance_blocks;
};

// The pixel of a thread and the rectangle of its warp.
struct Seat {
  int left, top;  // of the rectangle
  int x, y;
  bool inside;
  int64_t plane, at;  // pixels of the image, and which of them this is

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

// Brings the splat of an instance to a place of the batch.
template <int C, int kSize, class T>
SNOW_INLINE SplatTerms<T> load(const Frame<T>& f, uint32_t instance, Batch<T, kSize>& batch,
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

// The places in the batch of the instances that touch a warp's rectangle, in order.
using Touching = uint8_t[kWarp];

// Lists the places of the lanes that touch, and gives their number. Before it is called again, the
// warp has to meet.
SNOW_INLINE int list_touching(Touching& list, unsigned lanes, int place) {
  const int lane = lane_id();
  if (lanes >> lane & 1) list[__popc(lanes & ((1u << lane) - 1))] = uint8_t(place);
  __syncwarp();
  return __popc(lanes);
}

// −|a|, for a GPU one instruction.
SNOW_INLINE float negative(float a) { return ::fminf(a, -a); }
SNOW_INLINE double negative(double a) { return ::fmin(a, -a); }

template <class T>
struct Pixel {
  T x, y;
  T rest;  // the transmittance; its negative where the pixel is finished or none of the image

  SNOW_INLINE explicit Pixel(const Seat& seat)
      : x(centre<T>(seat.x)), y(centre<T>(seat.y)), rest(seat.inside ? T(1) : T(-1)) {}

  SNOW_INLINE bool unfinished() const { return rest > T(0); }
  SNOW_INLINE T transmittance() const { return max(rest, -rest); }

  // Puts a splat in front of what is left and gives its weight, 0 if it is not blended; and α,
  // before and after it is capped. Both passes decide by this what is too faint and where a pixel
  // is finished, so no rounding is left to the compiler. A finished pixel never has enough left.
  SNOW_INLINE bool blend(const Four<T>& shape, const Four<T>& look, T& uncapped, T& alpha,
                         T& weight) {
    const T dx = x - shape.x, dy = y - shape.y;
    const T power = fma(fma(shape.z, dx, shape.w * dy), dx, fma(look.x * dy, dy, look.y));
    uncapped = exp2_blend(power), alpha = min(uncapped, T(kMaxAlpha));
    const T next = fma(-alpha, rest, rest);
    const bool visible = power >= T(kLog2MinAlpha), enough = next >= T(kMinTransmittance);
    const bool blended = visible && enough;
    weight = blended ? alpha * rest : T(0);
    if (blended) rest = next;
    if (visible && !enough) rest = negative(rest);
    return blended;
  }
};

template <class T>
struct ForwardMemory {
  Batch<T, kForwardBatch> batch;
  Two<T> slopes[kForwardBatch];
  Touching list[kWarps];
  uint32_t touched[kForwardBatch / kWarp][kWarps];  // by rectangle, of 32 instances a bit each
  uint32_t ends[kWarps];
};

// With `kCount`, the image is the number of splats that were blended.
template <int C, bool kCount, class T>
SNOW_INLINE void forward(const Frame<T>& f, int channels, const T* background, T* image, T* alpha,
                         ForwardMemory<T>& memory) {
  const Seat seat(f.width, f.height);
  const int thread = int(threadIdx.x), warp = warp_id(), lane = lane_id();
  Pixel<T> pixel(seat);
  T color[C] = {};
  const uint32_t end = f.tile_start[blockIdx.x + 1];
  uint32_t base = f.tile_start[blockIdx.x], looked_at = base;
  bool warp_unfinished = __any_sync(kAllLanes, pixel.unfinished());
  for (; base < end; base += kForwardBatch) {
    // Waits, too, until nobody needs the last batch any more.
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
      f.instance_blocks[base + uint32_t(thread)] = uint8_t(bits);
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

constexpr int kGroup = kWarp / kRectHeight;  // splats that a warp takes at a time
constexpr int kSums = kGroupChannels + 6;
// Numbers from one splat to the next: such that a column of them is in different banks.
constexpr int kPairStride = kWarp + 2, kSumStride = kSums + 1;

template <class T>
struct BackwardMemory {
  Batch<T, kBackwardBatch> batch;
  Four<T> grads[kGroupChannels][kBlock / 4];  // ∂L/∂C of each pixel, in the order of threads
  // w and q of each splat of a group and pixel; after 32 instances, the sums of each.
  Four<T> pairs[kWarps][kGroup * kPairStride / 2];
  Touching list[kWarps];
  uint8_t touched[kBackwardBatch];  // what the forward pass kept of each instance
};

// Sums of a splat over pixels: of C colours, then the moments.
template <int C, class T>
struct Sums {
  static constexpr int kHalf = (C + 7) / 2;
  T value[2 * kHalf] = {};

  // Step 2: a splat and a row of a rectangle, whose first pixel is (dx, dy) from the mean.
  SNOW_INLINE void add_row(const Four<T>* pairs, const Four<T> (*grads)[kBlock / 4], T dx, T dy) {
    T q0(0), qx(0), qxx(0);
#pragma unroll
    for (int x = 0; x < kRectWidth; x += 4) {
      const Four<T> a = pairs[x / 2], b = pairs[x / 2 + 1];
#pragma unroll
      for (int k = 0; k < C; k++) {
        const Four<T> g = grads[k][x / 4];
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

// The sums of the splats that a warp has done, of up to 32. A lane has half of the sums of two of
// them: the upper half warp has the second half.
template <int C, class T>
struct KeptSums {
  static constexpr int kHalf = Sums<C, T>::kHalf, kWays = kWarp / kGroup / 2;
  T kept[kWays][kHalf] = {};

  // What the lanes of a splat have summed, a row each, becomes one, and two of these lanes keep it.
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
  // Writes them to `sums`, kSumStride for each of 32 instances, the first of them at place `first`.
  SNOW_INLINE void store(const Touching& list, int listed, int first, T* sums) const {
    const bool upper = lane_id() >= kWarp / 2;
#pragma unroll
    for (int way = 0; way < kWays; way++) {
      const int at = way * 2 * kGroup + int(threadIdx.x % (2 * kGroup));
      if (at >= listed) continue;
      T* const to = sums + (list[at] - first) * kSumStride + (upper ? kHalf : 0);
#pragma unroll
      for (int k = 0; k < kHalf; k++) to[k] = kept[way][k];
    }
  }
};

// The sums of an instance, a thread each, become its gradient as in splat_terms_vjp: a multiple of
// itself, and those of the mean, too, of each other. All threads of a warp have to call it.
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

// grad_alpha may be null; slots too, and then instance_slot. image and grad_image are the planes of
// the group of channels.
template <int C, class T>
SNOW_INLINE void backward(const Frame<T>& f, int channels, const uint32_t* instance_slot,
                          const T* image, const T* grad_image, const T* alpha, const T* grad_alpha,
                          T* slots, T* grad_packed, BackwardMemory<T>& memory) {
  const Seat seat(f.width, f.height);
  const int thread = int(threadIdx.x), warp = warp_id(), lane = lane_id();
  Pixel<T> pixel(seat);
  T behind(0), grad[C], grad_opaque(0);
#pragma unroll
  for (int k = 0; k < C; k++) {
    grad[k] = T(0);
    if (seat.inside && k < channels) {
      grad[k] = grad_image[k * seat.plane + seat.at];
      behind += grad[k] * image[k * seat.plane + seat.at];
    }
    reinterpret_cast<T*>(memory.grads[k])[thread] = grad[k];
  }
  if (seat.inside && grad_alpha) {
    grad_opaque = grad_alpha[seat.at];
    behind += grad_opaque * alpha[seat.at];
  }
  // In step 2: which splat of a group and row of the rectangle.
  const int slot = int(threadIdx.x % kGroup), row = int(threadIdx.x % kWarp / kGroup);
  Four<T>* const pairs = memory.pairs[warp];
  const Four<T>* const row_pairs = pairs + (slot * kPairStride + row * kRectWidth) / 2;
  const Four<T>(*const row_grads)[kBlock / 4] = reinterpret_cast<const Four<T>(*)[kBlock / 4]>(
      &memory.grads[0][(warp * kWarp + row * kRectWidth) / 4]);

  // When the sums of the warps are added: which of 16 instances, which number of it, and to which
  // column of the gradient this belongs.
  constexpr int kPlaces = kBlock / kSlotWidth;
  const int place = int(threadIdx.x / kSlotWidth), column = int(threadIdx.x % kSlotWidth);
  const int to = column < C ? int(f.columns[column]) : column == C ? 5 : column - C - 1;

  const uint32_t end = f.tile_end[blockIdx.x];
  uint32_t base = f.tile_start[blockIdx.x];
  for (; base < end; base += kBackwardBatch) {
    const int count = end - base < kBackwardBatch ? int(end - base) : kBackwardBatch;
    if (thread < count) {
      load<C>(f, base + uint32_t(thread), memory.batch, thread);
      memory.touched[thread] = f.instance_blocks[base + uint32_t(thread)];
    }
    __syncthreads();
    for (int first = 0; first < count; first += kWarp) {
      const bool touches = first + lane < count && memory.touched[first + lane] >> warp & 1;
      const unsigned lanes = __ballot_sync(kAllLanes, touches);
      const Touching& list = memory.list[warp];
      const int listed = list_touching(memory.list[warp], lanes, first + lane);
      KeptSums<C, T> sums;
      for (int done = 0; done < listed; done += kGroup) {
        if (!__any_sync(kAllLanes, pixel.unfinished())) break;
        const int group = listed - done < kGroup ? listed - done : kGroup;
        Two<T>* pair = reinterpret_cast<Two<T>*>(pairs) + lane;
        for (int j = 0; j < group; j++, pair += kPairStride) {
          const int i = list[done + j];
          const Four<T> look = memory.batch.look[i];
          const Two<T> look_on = memory.batch.look_on[i];
          T uncapped, a, weight, seen = grad_opaque;
          const bool blended = pixel.blend(memory.batch.shape[i], look, uncapped, a, weight);
          const T splat[kGroupChannels] = {look.z, look.w, look_on.x, look_on.y};
#pragma unroll
          for (int k = 0; k < C; k++) seen += splat[k] * grad[k];
          const T ahead = weight * seen;
          behind -= ahead;
          const T q = ahead - a * behind * reciprocal_estimate(T(1) - a);
          *pair = {weight, blended && uncapped < T(kMaxAlpha) ? q : T(0)};
        }
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
      sums.store(list, listed, first, reinterpret_cast<T*>(pairs));
      // Half a warp an instance, a thread a sum of it. Where that goes is fetched before the wait.
      uint32_t target[kWarp / kPlaces] = {};
#pragma unroll
      for (int h = 0; h < kWarp / kPlaces; h++) {
        const int i = first + place + h * kPlaces;
        if (i < count) target[h] = (slots ? instance_slot : f.instance_splat)[base + uint32_t(i)];
      }
      __syncthreads();
#pragma unroll
      for (int h = 0; h < kWarp / kPlaces; h++) {
        const int from = place + h * kPlaces, i = first + from;
        const unsigned bits = i < count && column < C + 6 ? memory.touched[i] : 0;
        T sum(0);
#pragma unroll
        for (int w = 0; w < kWarps; w++)
          if (bits >> w & 1)
            sum += reinterpret_cast<const T*>(memory.pairs[w])[from * kSumStride + column];
        if (slots) {
          if (i < count) slots[int64_t(target[h]) * kSlotWidth + column] = sum;
        } else {
          sum = gradient_of<C>(sum, column - C, memory.batch.shape[i], memory.batch.look[i]);
          if (bits && to >= 0 && sum != T(0))
            atomicAdd(grad_packed + target[h] * f.stride + to, sum);
        }
      }
      __syncthreads();
    }
  }
  if (!slots) return;
  // What nobody looked at.
  const uint32_t last = f.tile_start[blockIdx.x + 1];
  for (uint32_t i = end + uint32_t(thread / kSlotWidth); i < last; i += kBlock / kSlotWidth)
    slots[int64_t(instance_slot[i]) * kSlotWidth + thread % kSlotWidth] = T(0);
}

// Sum over pixels of grad_image · (1 − alpha): the gradient of the background. A block a row of
// pixels, a warp a channel of it.
template <class T>
SNOW_INLINE void background_row(int height, int width, int channels, const T* grad_image,
                                const T* alpha, double* rows) {
  const int64_t y = blockIdx.x;
  for (int k = warp_id(); k < channels; k += int(blockDim.x) / kWarp) {
    const T *grad = grad_image + (int64_t(k) * height + y) * width, *covered = alpha + y * width;
    double sum = 0;
    for (int x = lane_id(); x < width; x += kWarp)
      sum += double(grad[x]) * (1.0 - double(covered[x]));
#pragma unroll
    for (int step = kWarp / 2; step; step /= 2) sum += __shfl_xor_sync(kAllLanes, sum, step);
    if (lane_id() == 0) rows[y * channels + k] = sum;
  }
}

}  // namespace
}  // namespace snow

// On a GPU the splats are read from `packed`, and records are empty.
// RESIDENT: how many blocks of the backward pass 100 KiB of shared memory hold; registers are not
// to make them fewer.
#define SNOW_BLEND_KERNELS(SUFFIX, T, RESIDENT)                                                    \
  SNOW_KERNEL(blend_fwd##SUFFIX, 256,                                                              \
              (int64_t, int64_t width, int64_t height, const T* packed, int64_t stride,            \
               const int64_t* columns, const void*, const uint32_t* tile_start,                    \
               uint32_t* tile_end, const uint32_t* instance_splat, uint8_t* instance_blocks,       \
               int64_t channels, const T* background, T* image, T* alpha)) {                       \
    SNOW_SHARED(snow::ForwardMemory<T>, memory, 1);                                                \
    const snow::Frame<T> f = {int(width), int(height), packed,         stride,         columns,    \
                              tile_start, tile_end,    instance_splat, instance_blocks};           \
    if (channels <= 3)                                                                             \
      snow::forward<3, false>(f, int(channels), background, image, alpha, *memory);                \
    else                                                                                           \
      snow::forward<4, false>(f, int(channels), background, image, alpha, *memory);                \
  }                                                                                                \
  SNOW_KERNEL(                                                                                     \
      blend_count##SUFFIX, 256,                                                                    \
      (int64_t, int64_t width, int64_t height, const T* packed, int64_t stride,                    \
       const int64_t* columns, const void*, const uint32_t* tile_start, uint32_t* tile_end,        \
       const uint32_t* instance_splat, uint8_t* instance_blocks, T* counts)) {                     \
    SNOW_SHARED(snow::ForwardMemory<T>, memory, 1);                                                \
    const snow::Frame<T> f = {int(width), int(height), packed,         stride,         columns,    \
                              tile_start, tile_end,    instance_splat, instance_blocks};           \
    snow::forward<1, true>(f, 1, static_cast<const T*>(nullptr), counts, static_cast<T*>(nullptr), \
                           *memory);                                                               \
  }                                                                                                \
  SNOW_KERNEL_OF(                                                                                  \
      blend_bwd##SUFFIX, 256, RESIDENT,                                                            \
      (int64_t, int64_t width, int64_t height, const T* packed, int64_t stride,                    \
       const int64_t* columns, const void*, const uint32_t* tile_start, uint32_t* tile_end,        \
       const uint32_t* instance_splat, uint8_t* instance_blocks, int64_t channels,                 \
       const uint32_t* instance_slot, const T* image, const T* grad_image, const T* alpha,         \
       const T* grad_alpha, T* slots, T* grad_packed)) {                                           \
    SNOW_SHARED(snow::BackwardMemory<T>, memory, 1);                                               \
    const snow::Frame<T> f = {int(width), int(height), packed,         stride,         columns,    \
                              tile_start, tile_end,    instance_splat, instance_blocks};           \
    if (channels <= 3)                                                                             \
      snow::backward<3>(f, int(channels), instance_slot, image, grad_image, alpha, grad_alpha,     \
                        slots, grad_packed, *memory);                                              \
    else                                                                                           \
      snow::backward<4>(f, int(channels), instance_slot, image, grad_image, alpha, grad_alpha,     \
                        slots, grad_packed, *memory);                                              \
  }                                                                                                \
  SNOW_KERNEL(background_bwd##SUFFIX, 128,                                                         \
              (int64_t height, int64_t width, int64_t channels, const T* grad_image,               \
               const T* alpha, double* rows)) {                                                    \
    snow::background_row(int(height), int(width), int(channels), grad_image, alpha, rows);         \
  }

SNOW_BLEND_KERNELS(, float, 4)
SNOW_BLEND_KERNELS(_f64, double, 1)
