// Rasterization: composites the splats of each 16×16 tile front to back, and computes the gradient.
// One block processes one tile, in the backward pass one segment of its list; one warp a rectangle of
// 8×4 pixels, one thread a pixel.
//
// Culling   Instances are loaded into shared memory in batches. 32 instances are tested at a time:
//           each lane tests one of them against the rectangle of the warp, exactly. The warp
//           composites only the instances that touch its rectangle. The results are stored for the
//           backward pass as one byte per instance, with one bit per warp.
// Forward   The transmittance and the colour of a pixel stay in the registers of its thread. A tile
//           ends when its last pixel is finished; tile_end stores the end of the visited instances.
// Backward  The splats are processed front to back again. S is the dot product of g = ∂L/∂C and the
//           contribution of the splats behind the current one. At the start all splats are behind,
//           so S₀ = g·C is known. The derivative with respect to log α is w·(g·c) − α S/(1 − α).
//           It needs no division by T and no last index per pixel.
// Segments  The list of a tile is cut after every 256 instances, and each part is processed by a
//           block of its own in the backward pass; otherwise the longest list would decide the time.
//           At each cut, the forward pass stores T and the colour C' of the splats in front, so the
//           segment behind begins with S = g·(C − C').
//
// The gradient of a splat is a sum over pixels. Most of its cost is the addition of numbers of
// different threads. It is done with one thread per splat, as in the bucketed backward pass of
// Mallick et al. 2024 ("Taming 3DGS"), but within a tile:
//   1. One thread per pixel writes w = T α and q = ∂L/∂(log α) of eight splats to shared memory.
//   2. One thread per splat and row of the rectangle reads w and q of the eight pixels of the row.
//      It sums w·g, and q times the powers of d = pixel − mean. Two exchanges between lanes add the
//      four rows of a splat.
//   3. After 32 instances, the sums of the warps are added in a fixed order. The result is one
//      gradient per splat and tile. It is written to the slot of the instance, or added to the row
//      of the splat atomically.
//
// w and q are stored between steps 1 and 2. The alternative is to compute them again with one
// thread per splat and to pass the states of pixels from lane to lane. It would take about 50
// instructions, two of them slow, for every pixel of the tile. Step 2 takes 23 per pixel, and only
// for the pixels of the rectangles that the splat touches.
//
// Instructions per warp with three channels (counted in the code for sm_80 to sm_120, not timed):
//   forward            26 to 30 for a splat and a rectangle of 32 pixels
//   backward, step 1   38 to 42 for the same
//   backward, step 2   180 for eight splats
//   backward, step 3   240 for 32 instances
#include "cuda/device.h"
#include "rasterize.h"

namespace snow {
namespace {

constexpr int kRectWidth = 8, kRectHeight = 4, kRectsAcross = kTile / kRectWidth;
constexpr int kWarps = kTile * kTile / kWarp, kBlock = kTile * kTile;
constexpr int kForwardBatch = kBlock, kBackwardBatch = 64;

// Four numbers. If they are float, one instruction reads all of them.
template <class T>
struct alignas(16) Four {
  T x, y, z, w;
};
template <class T>
struct alignas(2 * sizeof(T)) Two {
  T x, y;
};

// The pixel of a thread and the rectangle of its warp.
struct PixelPosition {
  int left, top;  // first pixel of the rectangle
  int x, y;
  bool inside;
  int64_t pixel_count, index;  // pixels of the image; index of this pixel in a channel

  SNOW_INLINE PixelPosition(int width, int height, int tile) {
    const int tiles_x = (width + kTile - 1) / kTile;
    left = tile % tiles_x * kTile + warp_id() % kRectsAcross * kRectWidth;
    top = tile / tiles_x * kTile + warp_id() / kRectsAcross * kRectHeight;
    x = left + lane_id() % kRectWidth, y = top + lane_id() / kRectWidth;
    inside = x < width && y < height;
    pixel_count = int64_t(width) * height, index = int64_t(y) * width + x;
  }
};

template <class T>
SNOW_INLINE T centre(int pixel) {
  return T(pixel) + T(0.5);
}

template <class T, int kSize>
struct Batch {
  // The components of SplatTerms, and the colours:
  Four<T> mean_conic[kSize];     // mean_x, mean_y, A, B
  Four<T> opacity_color[kSize];  // C, log2_opacity, colours 0 and 1
  Two<T> color_23[kSize];        // colours 2 and 3
};

// Loads the splat of an instance into the batch, at index `entry`.
template <int C, int kSize, class T>
SNOW_INLINE SplatTerms<T> load(const FrameParams<T>& f, uint32_t instance, Batch<T, kSize>& batch,
                               int entry) {
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
  batch.mean_conic[entry] = {s.mean_x, s.mean_y, s.A, s.B};
  batch.opacity_color[entry] = {s.C, s.log2_opacity, color[0], color[1]};
  batch.color_23[entry] = {color[2], color[3]};
  return s;
}

// The batch indices of the instances that touch a warp's rectangle, in order.
using Touching = uint8_t[kWarp];

// Lists the batch indices of the splats that touch the rectangle, and returns their number. `lanes`
// has the bits of the lanes whose splat touches it; `entry` is the batch index of the lane's splat.
// The warp has to synchronize before it calls this function again.
SNOW_INLINE int list_touching(Touching& list, unsigned lanes, int entry) {
  const int lane = lane_id();
  if (lanes >> lane & 1) list[__popc(lanes & ((1u << lane) - 1))] = uint8_t(entry);
  __syncwarp();
  return __popc(lanes);
}

// −|a|: one instruction on a GPU.
SNOW_INLINE float negative(float a) { return ::fminf(a, -a); }
SNOW_INLINE double negative(double a) { return ::fmin(a, -a); }

template <class T>
struct Pixel {
  T x, y;
  // The transmittance; its negative if the pixel is finished or outside of the image.
  T signed_transmittance;

  SNOW_INLINE explicit Pixel(const PixelPosition& position)
      : x(centre<T>(position.x)), y(centre<T>(position.y)),
        signed_transmittance(position.inside ? T(1) : T(-1)) {}

  SNOW_INLINE bool unfinished() const { return signed_transmittance > T(0); }
  SNOW_INLINE T transmittance() const { return max(signed_transmittance, -signed_transmittance); }

  // Composites a splat and returns whether it contributes. Sets `weight` (0 if it does not
  // contribute), and α before (`uncapped`) and after (`alpha`) the limit 0.99. Both passes must
  // make the same decisions, so every rounding is explicit (fma). In a finished pixel, `next` is
  // negative, so no further splat is composited. In the additive mode, the weight is the uncapped α.
  template <bool kAdditive>
  SNOW_INLINE bool blend(const Four<T>& mean_conic, const Four<T>& opacity_color, T& uncapped,
                         T& alpha, T& weight) {
    const T dx = x - mean_conic.x, dy = y - mean_conic.y;
    const T power = fma(fma(mean_conic.z, dx, mean_conic.w * dy), dx,
                        fma(opacity_color.x * dy, dy, opacity_color.y));
    uncapped = exp2_blend(power), alpha = capped_alpha(uncapped);
    if constexpr (kAdditive) {
      const bool added = is_blended(power) && unfinished();  // false outside of the image
      weight = added ? uncapped : T(0);
      return added;
    }
    const T next = fma(-alpha, signed_transmittance, signed_transmittance);
    const bool visible = is_blended(power), open = is_open(next);
    const bool blended = visible && open;
    weight = blended ? alpha * signed_transmittance : T(0);
    if (blended) signed_transmittance = next;
    if (visible && !open) signed_transmittance = negative(signed_transmittance);
    return blended;
  }
};

template <class T>
struct ForwardMemory {
  Batch<T, kForwardBatch> batch;
  Two<T> slopes[kForwardBatch];
  Touching list[kWarps];
  uint32_t touched[kForwardBatch / kWarp]
                  [kWarps];  // for each rectangle: one bit for each of 32 instances
  uint32_t ends[kWarps];
};

// The state of the thread's pixel in front of the instance at index `begin`, with which a segment
// begins: the signed transmittance, then C colours, kBlock numbers apart. The segments of all tiles,
// without the first of each, begin at least kSegment instances apart, so no two have the same place.
template <int C, class T>
SNOW_INLINE T* pixel_state(T* states, uint32_t begin) {
  return states + int64_t(begin / kSegment - 1) * ((1 + C) * kBlock) + threadIdx.x;
}
static_assert(kSegment == kForwardBatch, "the forward pass stores a state before each batch");

// kCount: the value of a pixel is the number of splats that are composited. kMedian: the values are
// those of the splat at which the transmittance falls below 1/2, and after them, those of
// kFrontToBack without a background.
enum class Blend { kFrontToBack, kAdditive, kCount, kMedian };

template <int C, Blend kBlend, class T>
SNOW_INLINE void forward(const FrameParams<T>& f, int channels, const T* background, T* image,
                         T* alpha, T* states, ForwardMemory<T>& memory) {
  uint8_t* const instance_blocks = static_cast<uint8_t*>(f.instance_blocks);
  const PixelPosition position(int(f.width), int(f.height), int(blockIdx.x));
  const int thread = int(threadIdx.x), warp = warp_id(), lane = lane_id();
  Pixel<T> pixel(position);
  T color[kBlend == Blend::kMedian ? 2 * C : C] = {};
  const uint32_t end = f.tile_start[blockIdx.x + 1];
  uint32_t base = f.tile_start[blockIdx.x], visited_end = base;
  bool warp_unfinished = __any_sync(kAllLanes, pixel.unfinished());
  for (; base < end; base += kForwardBatch) {
    // Also waits until all threads have finished the last batch.
    if (!__syncthreads_or(pixel.unfinished())) break;
    if (kBlend == Blend::kFrontToBack && states && base > f.tile_start[blockIdx.x]) {
      T* const state = pixel_state<C>(states, base);
      state[0] = pixel.signed_transmittance;
#pragma unroll
      for (int k = 0; k < C; k++) state[(1 + k) * kBlock] = color[k];
    }
    const int count = end - base < kForwardBatch ? int(end - base) : kForwardBatch;
    if (thread < count) {
      const SplatTerms<T> s = load<C>(f, base + uint32_t(thread), memory.batch, thread);
      memory.slopes[thread] = {s.slope_x, s.slope_y};
    }
    __syncthreads();
    for (int first = 0; first < count; first += kWarp) {
      bool touches = false;
      const int index = first + lane;
      if (warp_unfinished && index < count) {
        const Four<T> mean_conic = memory.batch.mean_conic[index],
                      opacity_color = memory.batch.opacity_color[index];
        const Two<T> slope = memory.slopes[index];
        const SplatTerms<T> s = {mean_conic.x,    mean_conic.y,    mean_conic.z, mean_conic.w,
                                 opacity_color.x, opacity_color.y, slope.x,      slope.y};
        const T x = centre<T>(position.left) - s.mean_x, y = centre<T>(position.top) - s.mean_y;
        const T peak = peak_over_rectangle(s, x, y, x + T(kRectWidth - 1), y + T(kRectHeight - 1));
        touches = peak + s.log2_opacity >= T(kLog2MinAlpha - kCullSlack);
      }
      const unsigned lanes = __ballot_sync(kAllLanes, touches);
      if (lane == 0) memory.touched[first / kWarp][warp] = lanes;
      if (warp_unfinished)
        visited_end = base + uint32_t(first + kWarp < count ? first + kWarp : count);
      const int listed = list_touching(memory.list[warp], lanes, index);
      for (int j = 0; j < listed; j++) {
        const int i = memory.list[warp][j];
        const Four<T> opacity_color = memory.batch.opacity_color[i];
        const T front = pixel.signed_transmittance;
        T uncapped, a, weight;
        const bool blended = pixel.template blend<kBlend == Blend::kAdditive>(
            memory.batch.mean_conic[i], opacity_color, uncapped, a, weight);
        if constexpr (kBlend == Blend::kCount) {
          color[0] += blended ? T(1) : T(0);
        } else {
          const Two<T> color_23 = memory.batch.color_23[i];
          const T splat[kGroupChannels] = {opacity_color.z, opacity_color.w, color_23.x,
                                           color_23.y};
#pragma unroll
          for (int k = 0; k < C; k++) {
            if constexpr (kBlend == Blend::kMedian) {
              color[k] = blended && front >= T(0.5) ? splat[k] : color[k];
              color[C + k] += weight * splat[k];
            } else {
              color[k] += weight * splat[k];
            }
          }
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
  if (lane == 0) memory.ends[warp] = visited_end;
  __syncthreads();
  if (thread == 0) {
    for (int w = 1; w < kWarps; w++)
      if (memory.ends[w] > visited_end) visited_end = memory.ends[w];
    f.tile_end[blockIdx.x] = visited_end;
  }
  if (!position.inside) return;
  const T transmittance = pixel.transmittance();
#pragma unroll
  for (int k = 0; k < C; k++)
    if (k < channels) {
      if constexpr (kBlend == Blend::kMedian)
        image[(channels + k) * position.pixel_count + position.index] = color[C + k];
      image[k * position.pixel_count + position.index] =
          kBlend == Blend::kCount || kBlend == Blend::kMedian
              ? color[k]
              : color[k] + transmittance * background[k];
    }
  if (alpha) alpha[position.index] = T(1) - transmittance;
}

template <Blend kBlend, class T>
SNOW_INLINE void forward_of_channels(const RasterizeForwardParams<T>& p, ForwardMemory<T>& memory) {
  const int channels = int(p.channels);
  if (channels <= 3)
    forward<3, kBlend>(p.frame, channels, p.background, p.image, p.alpha, p.states, memory);
  else
    forward<4, kBlend>(p.frame, channels, p.background, p.image, p.alpha, p.states, memory);
}

constexpr int kGroup = kWarp / kRectHeight;  // splats that a warp processes at a time
constexpr int kSums = kGroupChannels + 6;
// With these strides, the numbers of one column are in different banks.
constexpr int kPairStride = kWarp + 2, kSumStride = kSums + 1;

// Scratch memory of a warp. Step 3 reuses the memory of steps 1 and 2.
template <class T>
union WarpScratch {
  Two<T> pairs[kGroup * kPairStride];       // steps 1 and 2: w and q, of each splat and pixel
  Four<T> quads[kGroup * kPairStride / 2];  // the same, of two pixels at a time
  T sums[kWarp][kSumStride];                // step 3: the sums of each of 32 instances
};

// ∂L/∂C of each pixel, in the order of the threads. Four values are read at once.
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
  uint8_t touched[kBackwardBatch];  // for each instance, the byte that the forward pass stored
  int packed_columns[kSlotWidth];   // of each sum, see `packed_column`
};

// Sums over pixels for one splat: of C colours, then the six moments (see BlendMoments).
template <int C, class T>
struct Sums {
  static constexpr int kHalf = (C + 7) / 2;
  T value[2 * kHalf] = {};

  // Step 2, for a splat and a row of a rectangle. (dx, dy) is the position of the first pixel of
  // the row relative to the mean. `pairs` contains w and q of the pixels, `grads` ∂L/∂C.
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

// The sums over a rectangle of the up to 32 splats that its warp has processed. Each lane holds one
// half of the sums of two splats: lanes 0 to 15 the first half, lanes 16 to 31 the second.
template <int C, class T>
struct WarpSums {
  static constexpr int kHalf = Sums<C, T>::kHalf, kSplatsPerLane = kWarp / kGroup / 2;
  T sums[kSplatsPerLane][kHalf] = {};

  // Adds the sums of the four lanes of a splat, which are those of one row each. Two of these lanes
  // keep the result, one half each.
  SNOW_INLINE void add_group(const Sums<C, T>& rows, int group) {
    const bool upper = lane_id() >= kWarp / 2;
    const int odd = int(threadIdx.x / kGroup % 2);
#pragma unroll
    for (int k = 0; k < kHalf; k++) {
      const T low = rows.value[k], high = rows.value[kHalf + k];
      T sum = upper ? high : low;
      sum += __shfl_xor_sync(kAllLanes, upper ? low : high, kWarp / 2);
      sum += __shfl_xor_sync(kAllLanes, sum, kGroup);
#pragma unroll
      for (int j = 0; j < kSplatsPerLane; j++)
        if (group == 2 * j + odd) sums[j][k] = sum;
    }
  }
  // Writes the sums to `out`, which has one row for each of the 32 instances from index `first` of
  // the batch on.
  SNOW_INLINE void store(const Touching& list, int listed, int first,
                         T (&out)[kWarp][kSumStride]) const {
    const bool upper = lane_id() >= kWarp / 2;
#pragma unroll
    for (int j = 0; j < kSplatsPerLane; j++) {
      const int i = j * 2 * kGroup + int(threadIdx.x % (2 * kGroup));
      if (i >= listed) continue;
      T* const row = out[list[i] - first] + (upper ? kHalf : 0);
#pragma unroll
      for (int k = 0; k < kHalf; k++) row[k] = sums[j][k];
    }
  }
};

// The gradient of an instance from its sums, with one thread per sum, as in splat_terms_vjp. Each
// gradient is a multiple of the sum of its thread. The two gradients of the mean also depend on the
// sum of the other coordinate. All threads of a warp must take part.
template <int C, class T>
SNOW_INLINE T gradient_of(T sum, int moment, const Four<T>& mean_conic,
                          const Four<T>& opacity_color) {
  const T other = __shfl_sync(kAllLanes, sum, moment == 1 ? C + 2 : C + 1, kSlotWidth);
  const bool of_mean = moment == 1 || moment == 2;
  // A, B and C are multiples of the conic a, b and c (rasterize.h).
  T factor = T(-2 * kLn2) * (moment == 1 ? mean_conic.z : opacity_color.x);
  if (!of_mean) factor = moment == 4 ? T(-1) : T(-0.5);
  if (moment == 0) factor = exp2_blend(-opacity_color.y);
  if (moment < 0) factor = T(1);
  return factor * sum + (of_mean ? T(-kLn2) * mean_conic.w * other : T(0));
}

// A pixel in the backward pass: its gradients, and S of the splats behind the current one.
template <int C, class T>
struct PixelGradient {
  Pixel<T> pixel;
  T behind, grad[C], grad_alpha;

  // Reads the gradients of the thread's pixel, and stores the gradients of its colours for step 2.
  // `state`: that of the pixel, or null at the first instance of a tile and in the additive mode.
  SNOW_INLINE PixelGradient(const PixelPosition& position, const RasterizeBackwardParams<T>& p,
                            const T* state, PixelGrads<T>& grads)
      : pixel(position), behind(0), grad_alpha(0) {
    if (state) pixel.signed_transmittance = state[0];
#pragma unroll
    for (int k = 0; k < C; k++) {
      grad[k] = T(0);
      if (position.inside && k < int(p.channels)) {
        grad[k] = p.grad_image[k * position.pixel_count + position.index];
        const T in_front = state ? state[(1 + k) * kBlock] : T(0);
        behind += grad[k] * (p.image[k * position.pixel_count + position.index] - in_front);
      }
      grads.one[k][threadIdx.x] = grad[k];
    }
    if (position.inside && p.grad_alpha) {
      grad_alpha = p.grad_alpha[position.index];
      const T in_front = T(1) - pixel.transmittance();
      behind += grad_alpha * (p.alpha[position.index] - in_front);
    }
  }

  // Step 1: composites a splat of the batch; returns w and q.
  template <bool kAdditive>
  SNOW_INLINE Two<T> add(const Batch<T, kBackwardBatch>& batch, int i) {
    const Four<T> opacity_color = batch.opacity_color[i];
    const Two<T> color_23 = batch.color_23[i];
    T uncapped, alpha, weight, grad_dot_color = grad_alpha;
    const bool blended = pixel.template blend<kAdditive>(batch.mean_conic[i], opacity_color,
                                                         uncapped, alpha, weight);
    const T splat[kGroupChannels] = {opacity_color.z, opacity_color.w, color_23.x, color_23.y};
#pragma unroll
    for (int k = 0; k < C; k++) grad_dot_color += splat[k] * grad[k];
    const T weighted_dot = weight * grad_dot_color;
    if constexpr (kAdditive) return {weight, weighted_dot};
    behind -= weighted_dot;
    const T q = log_alpha_gradient(weighted_dot, alpha, behind);
    return {weight, blended && uncapped < T(kMaxAlpha) ? q : T(0)};
  }
};

// Steps 1 and 2 for the 32 instances from index `first` of the batch on. Composites the instances
// that touch the rectangle of the warp, and stores the sums over its pixels in the warp's scratch.
template <int C, bool kAdditive, class T>
SNOW_INLINE void sum_over_pixels(PixelGradient<C, T>& gradient, int count, int first,
                                 BackwardMemory<T>& memory) {
  const int warp = warp_id(), lane = lane_id();
  // In step 2: the index of the thread's splat within the group, and the row of the rectangle.
  const int slot = lane % kGroup, row = lane / kGroup;
  WarpScratch<T>& scratch = memory.scratch[warp];
  const Four<T>* const row_pairs = scratch.quads + (slot * kPairStride + row * kRectWidth) / 2;
  const Four<T>* const row_grads = memory.grads.quads + (warp * kWarp + row * kRectWidth) / 4;

  const bool touches = first + lane < count && memory.touched[first + lane] >> warp & 1;
  const unsigned lanes = __ballot_sync(kAllLanes, touches);
  const Touching& list = memory.list[warp];
  const int listed = list_touching(memory.list[warp], lanes, first + lane);
  WarpSums<C, T> sums;
  for (int done = 0; done < listed; done += kGroup) {
    if (!__any_sync(kAllLanes, gradient.pixel.unfinished())) break;
    const int group = listed - done < kGroup ? listed - done : kGroup;
    Two<T>* pair = scratch.pairs + lane;
    for (int j = 0; j < group; j++, pair += kPairStride)
      *pair = gradient.template add<kAdditive>(memory.batch, list[done + j]);
    __syncwarp();
    Sums<C, T> rows;
    if (slot < group) {
      const Four<T> mean_conic = memory.batch.mean_conic[list[done + slot]];
      // The pixel of the thread is in this row, at column `slot`; the subtraction is exact.
      static_assert(kGroup == kRectWidth, "a thread per pixel and a thread per splat and row");
      const Pixel<T>& pixel = gradient.pixel;
      rows.add_row(row_pairs, row_grads, pixel.x - T(slot) - mean_conic.x, pixel.y - mean_conic.y);
    }
    sums.add_group(rows, done / kGroup);
    __syncwarp();
  }
  sums.store(list, listed, first, scratch.sums);
}

// The sum that a thread adds in step 3, which uses 16 threads per instance, one per sum.
struct SumPosition {
  int instance, column;  // the instance, of 16 at a time; the index of the sum

  SNOW_INLINE SumPosition()
      : instance(int(threadIdx.x) / kSlotWidth), column(int(threadIdx.x) % kSlotWidth) {}
};

// The column of the packed gradient to which a sum belongs.
SNOW_INLINE int packed_column(int sum, int channels, const int64_t* columns) {
  if (sum < channels) return int(columns[sum]);
  return sum == channels ? 5 : sum - channels - 1;
}

// Step 3 for the 32 instances from index `first` of the batch on. Adds the sums of the warps in
// order. Writes the gradient of each instance to its slot, or adds it to the row of its splat. All
// threads of the block must take part; they are synchronized before and after the additions.
template <int C, class T>
SNOW_INLINE void add_warps(const RasterizeBackwardParams<T>& p, const SumPosition& position,
                           uint32_t base, int count, int first, BackwardMemory<T>& memory) {
  constexpr int kInstances = kBlock / kSlotWidth, kRounds = kWarp / kInstances;
  uint32_t target[kRounds] = {};  // loaded before the barrier, to hide the latency
#pragma unroll
  for (int h = 0; h < kRounds; h++) {
    const int i = first + position.instance + h * kInstances;
    if (i < count)
      target[h] = (p.slots ? p.instance_slot : p.frame.instance_splat)[base + uint32_t(i)];
  }
  __syncthreads();
#pragma unroll
  for (int h = 0; h < kRounds; h++) {
    const int from = position.instance + h * kInstances, i = first + from;
    const unsigned warps = i < count && position.column < C + 6 ? memory.touched[i] : 0;
    T sum(0);
#pragma unroll
    for (int w = 0; w < kWarps; w++)
      if (warps >> w & 1) sum += memory.scratch[w].sums[from][position.column];
    if (p.slots) {
      if (i < count) p.slots[int64_t(target[h]) * kSlotWidth + position.column] = sum;
    } else {
      sum = gradient_of<C>(sum, position.column - C, memory.batch.mean_conic[i],
                           memory.batch.opacity_color[i]);
      const int column = memory.packed_columns[position.column];
      if (warps && column >= 0 && sum != T(0)) {
        atomicAdd(p.grad_packed + target[h] * p.frame.stride + column, sum);
        if (p.abs_grad && column < 2)
          atomicAdd(p.abs_grad + 2 * int64_t(target[h]) + column, abs(sum));
      }
    }
  }
  __syncthreads();
}

// The last tile whose list begins before an instance, which is not the first of all. All threads of
// the block search together; 65,536 tiles need two rounds.
SNOW_INLINE int tile_before(const uint32_t* tile_start, int tiles, uint32_t instance) {
  int first = 0;
  while (tiles > 1) {
    const int step = (tiles + kBlock - 1) / kBlock, at = int(threadIdx.x) * step;
    const bool begins = at < tiles && tile_start[first + at] < instance;
    const int passed = (__syncthreads_count(begins) - 1) * step;
    first += passed;
    tiles = tiles - passed < step ? tiles - passed : step;
  }
  return first;
}

// The instances of a tile that a block of the backward pass processes.
struct Segment {
  int tile;
  uint32_t begin, end;  // empty if there is none for the block
  bool is_first;        // of its tile

  // The first blocks have the segments other than the first of a tile. Block k has the one that
  // begins at one of kSegment instances from (k + 1) kSegment on, if there is one. There is at most
  // one, and its tile begins before these instances. The other blocks have the first segments of all
  // tiles. All threads of the block must take part.
  SNOW_INLINE Segment(const uint32_t* tile_start, int tiles)
      : tile(int(blockIdx.x) - (int(gridDim.x) - tiles)), begin(0), end(0), is_first(tile >= 0) {
    const uint32_t range = (blockIdx.x + 1) * uint32_t(kSegment);
    if (!is_first) {
      if (range >= tile_start[tiles]) return;
      tile = tile_before(tile_start, tiles, range);
    }
    const uint32_t start = tile_start[tile], last = tile_start[tile + 1];
    begin = start;
    if (!is_first) begin += (range - start + kSegment - 1) / kSegment * kSegment;
    if (begin < last) end = last - begin < kSegment ? last : begin + kSegment;
  }
};

// The gradients of the instances from index `begin` to `end` of a tile. `state`: see PixelGradient.
template <int C, bool kAdditive, class T>
SNOW_INLINE void add_instances(const RasterizeBackwardParams<T>& p, int tile, uint32_t begin,
                               uint32_t end, const T* state, BackwardMemory<T>& memory) {
  const FrameParams<T>& f = p.frame;
  const uint8_t* const instance_blocks = static_cast<const uint8_t*>(f.instance_blocks);
  const PixelPosition position(int(f.width), int(f.height), tile);
  const int thread = int(threadIdx.x);
  PixelGradient<C, T> gradient(position, p, state, memory.grads);
  const SumPosition sum_position;
  if (thread < kSlotWidth) memory.packed_columns[thread] = packed_column(thread, C, f.columns);

  for (uint32_t base = begin; base < end; base += kBackwardBatch) {
    const int count = end - base < kBackwardBatch ? int(end - base) : kBackwardBatch;
    if (thread < count) {
      load<C>(f, base + uint32_t(thread), memory.batch, thread);
      memory.touched[thread] = instance_blocks[base + uint32_t(thread)];
    }
    __syncthreads();
    for (int first = 0; first < count; first += kWarp) {
      sum_over_pixels<C, kAdditive>(gradient, count, first, memory);
      add_warps<C>(p, sum_position, base, count, first, memory);
    }
  }
}

template <int C, bool kAdditive, class T>
SNOW_INLINE void backward(const RasterizeBackwardParams<T>& p, BackwardMemory<T>& memory) {
  const Segment segment(p.frame.tile_start, int(p.n));
  if (segment.begin >= segment.end) return;
  const uint32_t visited_end = p.frame.tile_end[segment.tile];
  if (p.slots) {
    // Zeroes the slots of the instances after the last one that the forward pass visited.
    const int thread = int(threadIdx.x);
    const uint32_t first = visited_end > segment.begin ? visited_end : segment.begin;
    for (uint32_t i = first + uint32_t(thread / kSlotWidth); i < segment.end;
         i += kBlock / kSlotWidth)
      p.slots[int64_t(p.instance_slot[i]) * kSlotWidth + thread % kSlotWidth] = T(0);
  }
  if (visited_end <= segment.begin) return;
  const uint32_t end = visited_end < segment.end ? visited_end : segment.end;
  const bool has_state = !kAdditive && !segment.is_first;
  const T* const state = has_state ? pixel_state<C>(p.states, segment.begin) : nullptr;
  add_instances<C, kAdditive>(p, segment.tile, segment.begin, end, state, memory);
}

template <bool kAdditive, class T>
SNOW_INLINE void backward_of_channels(const RasterizeBackwardParams<T>& p,
                                      BackwardMemory<T>& memory) {
  if (p.channels <= 3)
    backward<3, kAdditive>(p, memory);
  else
    backward<4, kAdditive>(p, memory);
}

// The gradient of the background: the sum over pixels of grad_image · (1 − alpha). One block per
// row of pixels, one warp per channel.
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

// Minimum number of blocks per multiprocessor; it limits the number of registers. A multiprocessor
// of compute capability 7.5 has threads for at most four blocks of the forward pass. Four blocks of
// the backward pass fit into 100 KiB of shared memory.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ < 800
#define SNOW_FORWARD_BLOCKS 4
#else
#define SNOW_FORWARD_BLOCKS 5
#endif
#define SNOW_BACKWARD_BLOCKS 4

#define SNOW_RASTERIZE_KERNELS(SUFFIX, T, FORWARD_BLOCKS, BACKWARD_BLOCKS)                      \
  SNOW_KERNEL_OF(rasterize_fwd##SUFFIX, kBlock, FORWARD_BLOCKS, RasterizeForwardParams<T>) {    \
    SNOW_SHARED(ForwardMemory<T>, memory, 1);                                                   \
    if (p.frame.additive)                                                                       \
      forward_of_channels<Blend::kAdditive>(p, *memory);                                        \
    else                                                                                        \
      forward_of_channels<Blend::kFrontToBack>(p, *memory);                                     \
  }                                                                                             \
  SNOW_KERNEL(rasterize_median##SUFFIX, kBlock, RasterizeForwardParams<T>) {                    \
    SNOW_SHARED(ForwardMemory<T>, memory, 1);                                                   \
    forward<4, Blend::kMedian, T>(p.frame, int(p.channels), nullptr, p.image, p.alpha, nullptr, \
                                  *memory);                                                     \
  }                                                                                             \
  SNOW_KERNEL(rasterize_count##SUFFIX, kBlock, RasterizeCountParams<T>) {                       \
    SNOW_SHARED(ForwardMemory<T>, memory, 1);                                                   \
    forward<1, Blend::kCount, T>(p.frame, 1, nullptr, p.counts, nullptr, nullptr, *memory);     \
  }                                                                                             \
  SNOW_KERNEL_OF(rasterize_bwd##SUFFIX, kBlock, BACKWARD_BLOCKS, RasterizeBackwardParams<T>) {  \
    SNOW_SHARED(BackwardMemory<T>, memory, 1);                                                  \
    if (p.frame.additive)                                                                       \
      backward_of_channels<true>(p, *memory);                                                   \
    else                                                                                        \
      backward_of_channels<false>(p, *memory);                                                  \
  }                                                                                             \
  SNOW_KERNEL(background_bwd##SUFFIX, 128, BackgroundBackwardParams<T>) { background_row(p); }

SNOW_RASTERIZE_KERNELS(, float, SNOW_FORWARD_BLOCKS, SNOW_BACKWARD_BLOCKS)
SNOW_RASTERIZE_KERNELS(_f64, double, 1, 1)
