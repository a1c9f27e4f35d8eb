// The parameters of every operation: one struct for each. Python fills the structs by the names of
// their fields (ops/native.py; layout.h tells how it knows them) and passes them to the kernels: to a
// CPU entry by pointer, to a CUDA kernel by value.
//
// Every field has 8 bytes. The first field is `n`, the number of items that the operation
// processes. T is float or double. Pointers marked "or null" are optional. Shapes are row-major.
#pragma once

#include "layout.h"

namespace snow {

template <class T>
struct SplatRecord;  // cpu/splat_record.h

template <class T>
struct DepthKeyOf;
template <>
struct DepthKeyOf<float> {
  using type = uint32_t;
};
template <>
struct DepthKeyOf<double> {
  using type = uint64_t;
};
template <class T>
using DepthKey = typename DepthKeyOf<T>::type;

// ---- Parts of the structs below -----------------------------------------------------------------

// A pinhole camera. Pixel (i, j) has its centre at (i + 0.5, j + 0.5); z points forward.
template <class T>
struct CameraParams {
  const T* cam_from_world;   // (3, 4): rotation and translation
  double width, height;      // pixels
  double fx, fy, cx, cy;     // pixels
  const double* intrinsics;  // (4,) in place of these four numbers; or null
  double near;               // world units; nearer Gaussians are not visible
  int64_t antialiased;       // 1: the dilation of a splat lowers its opacity; see projection.h
  SNOW_FIELDS(cam_from_world, width, height, fx, fy, cx, cy, intrinsics, near, antialiased)
};

// The parameters of N Gaussians.
template <class T>
struct GaussianTensors {
  const T* means;           // (N, 3) world units
  const T* log_scales;      // (N, 3)
  const T* quats;           // (N, 4) wxyz, not necessarily normalised
  const T* opacity_logits;  // (N,)
  const T* sh_dc;           // (N, 1, 3) of a tensor (N, sh_dc_rows, 3)
  const T* sh_rest;         // (N, K, 3) of a tensor (N, sh_rest_rows, 3)
  int64_t sh_rest_rows;     // at least K
  int64_t sh_degree;        // 0 to 3: K = (sh_degree + 1)² − 1
  int64_t sh_dc_rows = 1;   // more than 1 if sh_dc and sh_rest are parts of one tensor
  SNOW_FIELDS(means, log_scales, quats, opacity_logits, sh_dc, sh_rest, sh_rest_rows, sh_degree,
              sh_dc_rows)
};

// The gradients of these parameters, with the same shapes and rows.
template <class T>
struct GaussianGradients {
  T *means, *log_scales, *quats, *opacity_logits, *sh_dc, *sh_rest;
  SNOW_FIELDS(means, log_scales, quats, opacity_logits, sh_dc, sh_rest)
};

// ---- project ------------------------------------------------------------------------------------

// project_cull: which Gaussians the camera sees.
template <class T>
struct ProjectCullParams {
  int64_t n;  // Gaussians
  GaussianTensors<T> gaussians;
  CameraParams<T> camera;
  // out, (n,). CPU: the visible Gaussians, compacted; returns their number. CUDA: i or −1.
  int32_t* ids;
  SNOW_FIELDS(n, gaussians, camera, ids)
};

// project_fwd: the splats of the visible Gaussians.
template <class T>
struct ProjectForwardParams {
  int64_t n;           // splats
  const int32_t* ids;  // (n,) the Gaussian of each splat; CUDA: −1 for an empty row
  GaussianTensors<T> gaussians;
  CameraParams<T> camera;
  T* packed;  // out, (n, 16)
  SNOW_FIELDS(n, ids, gaussians, camera, packed)
};

// project_bwd: gradients of the Gaussians and the pose from the gradient of the splats.
template <class T>
struct ProjectBackwardParams {
  int64_t n;           // splats
  const int32_t* ids;  // (n,) as for project_fwd
  GaussianTensors<T> gaussians;
  CameraParams<T> camera;
  const T* grad_packed;        // (n, 16)
  GaussianGradients<T> grads;  // in and out: the gradients are added; or all null
  double* pose;     // out, (project_pose_blocks, 16) sums, which the caller adds; or null
  double rounding;  // each term t of these sums is (t + rounding) - rounding, in double
  SNOW_FIELDS(n, ids, gaussians, camera, grad_packed, grads, pose, rounding)
};

// ---- adam_step ----------------------------------------------------------------------------------

// A parameter of the Gaussians, its moments, additional gradient and learning rate.
template <class T>
struct AdamTensor {
  T *value, *m, *v;
  const T* extra;  // additional gradient, of the shape of `value`; or null
  double rate;     // lr / (1 − β₁ᵗ)
  SNOW_FIELDS(value, m, v, extra, rate)
};

template <class T>
struct AdamStepParams {
  int64_t n;             // Gaussians
  int64_t splats;        // rows of grad_packed
  const int32_t* ids;    // CPU: (splats,) the Gaussians, ascending. CUDA: (n,) the splats or −1
  const T* grad_packed;  // (splats, 16); or null: there are only additional gradients
  CameraParams<T> camera;
  int64_t sh_rest_rows, sh_degree;  // as in GaussianTensors
  AdamTensor<T> means, log_scales, quats, opacity_logits, sh_dc, sh_rest;
  double beta1, beta2;
  double inv_correction2;   // 1 / (1 − β₂ᵗ)
  double eps2;              // ε²
  int64_t visible_only;     // 1: the values and moments of Gaussians without a splat stay unchanged
  const bool* valid;        // (1,), or null; false: nothing is changed
  int32_t* nonfinite_rows;  // (6,), or null: increased by the number of skipped rows
  SNOW_FIELDS(n, splats, ids, grad_packed, camera, sh_rest_rows, sh_degree, means, log_scales,
              quats, opacity_logits, sh_dc, sh_rest, beta1, beta2, inv_correction2, eps2,
              visible_only, valid, nonfinite_rows)
};

// ---- add_noise ----------------------------------------------------------------------------------

template <class T>
struct AddNoiseParams {
  int64_t n;                  // Gaussians
  T* means;                   // in and out, (n, 3)
  const T* log_scales;        // (n, 3)
  const T* quats;             // (n, 4)
  const T* opacity_logits;    // (n,)
  double amount;              // of the noise
  double sharpness, opacity;  // k and t of σ(k (t − o))
  double negligible;          // rows with a smaller value of this sigmoid have no noise
  int64_t seed, first;        // row i has the random numbers number first + i of this seed
  SNOW_FIELDS(n, means, log_scales, quats, opacity_logits, amount, sharpness, opacity, negligible,
              seed, first)
};

// ---- accumulate_screen_statistics ---------------------------------------------------------------

template <class T>
struct ScreenStatisticsParams {
  int64_t n;             // splats
  const int32_t* ids;    // (n,) distinct Gaussians; negative: an empty row
  const T* packed;       // (n, stride)
  int64_t stride;        // columns
  const T* grad_means;   // (n, grad_stride): the first two columns, of the 2D mean, are read
  int64_t grad_stride;   // columns
  double width, height;  // pixels
  T* norm_sum;           // (N,) the norm of the gradient of the 2D mean is added
  T* views;              // (N,) 1 is added
  T* max_radii;          // (N,), or null: replaced by the radius if that is larger
  const bool* valid;     // (1,), or null; false: nothing is changed
  SNOW_FIELDS(n, ids, packed, stride, grad_means, grad_stride, width, height, norm_sum, views,
              max_radii, valid)
};

// ---- rasterize: splats → tiles ------------------------------------------------------------------

// splats_prepare: the depth keys; on the CPU also the records, which the later stages read.
template <class T>
struct SplatsPrepareParams {
  int64_t n;                // splats
  const T* packed;          // (n, stride)
  int64_t stride;           // columns
  int64_t width, height;    // pixels
  const int64_t* columns;   // (4,) the column of each channel; −1: the channel is zero
  SplatRecord<T>* records;  // out, (n,); CPU only
  DepthKey<T>* keys;        // out, (n,)
  SNOW_FIELDS(n, packed, stride, width, height, columns, records, keys)
};

// splats_recolor: replaces the channels of the records. CPU only.
template <class T>
struct SplatsRecolorParams {
  int64_t n;
  const T* packed;
  int64_t stride;
  const int64_t* columns;
  SplatRecord<T>* records;
  SNOW_FIELDS(n, packed, stride, columns, records)
};

// splats_sort: a stable sort by key.
template <class T>
struct SplatsSortParams {
  int64_t n;
  DepthKey<T>* keys;   // (n,) overwritten
  DepthKey<T>* keys2;  // (n,) scratch
  uint32_t* order;     // out, (n,) splats, nearest first
  uint32_t* order2;    // (n,) scratch
  SNOW_FIELDS(n, keys, keys2, order, order2)
};

// Parameters shared by tiles_count and tiles_fill.
template <class T>
struct TileBinning {
  const uint32_t* order;          // (splats,) from splats_sort
  const T* packed;                // (splats, stride); CUDA only
  int64_t stride;                 // columns
  const SplatRecord<T>* records;  // (splats,); CPU only
  int64_t tiles_x, tiles_y;       // tiles of the image
  int64_t parts;                  // number of parallel parts, from tiles_parts; CPU only
  void* workspace;       // of tiles_workspace_bytes; written by tiles_count, read by tiles_fill
  uint32_t* tile_start;  // out, (tiles + 1,) first instance of each tile
  SNOW_FIELDS(order, packed, stride, records, tiles_x, tiles_y, parts, workspace, tile_start)
};

// tiles_count: counts the instances (pairs of a splat and a tile that it touches).
template <class T>
struct TilesCountParams {
  int64_t n;  // splats
  TileBinning<T> binning;
  int64_t capacity;   // CUDA: instances for which memory is allocated, or −1 to wait for the count
  int64_t* required;  // out, (1,) instances
  SNOW_FIELDS(n, binning, capacity, required)
};

// tiles_fill: the splats of each tile, nearest first.
template <class T>
struct TilesFillParams {
  int64_t n;  // splats
  TileBinning<T> binning;
  int64_t capacity;          // size of the instance arrays
  uint32_t* instance_splat;  // out, (capacity,) sorted by tile
  uint32_t* instance_slot;   // out, (capacity,) index in the list ordered by splat; or null (CPU)
  uint32_t* slot_range;      // out, (n, 2) first slot of a splat, its last slot + 1; or null (CPU)
  SNOW_FIELDS(n, binning, capacity, instance_splat, instance_slot, slot_range)
};

// ---- rasterize: tiles → image and back ----------------------------------------------------------

// The splats of a frame, sorted into tiles.
template <class T>
struct FrameParams {
  int64_t width, height;           // pixels
  const T* packed;                 // (splats, stride)
  int64_t stride;                  // columns
  const int64_t* columns;          // (4,) the column of each channel; −1: the channel is zero
  const SplatRecord<T>* records;   // (splats,); CPU only
  const uint32_t* tile_start;      // (tiles + 1,)
  uint32_t* tile_end;              // (tiles,) end of the instances that the forward pass visited
  const uint32_t* instance_splat;  // (instances,)
  void* instance_blocks;           // (instances,) bits of the pixel blocks that a splat touches
  int64_t additive;                // 1: splats are added; 0: they are composited front to back
  SNOW_FIELDS(width, height, packed, stride, columns, records, tile_start, tile_end, instance_splat,
              instance_blocks, additive)
};

template <class T>
struct RasterizeForwardParams {
  int64_t n;  // tiles
  FrameParams<T> frame;
  int64_t channels;     // 1 to 4
  const T* background;  // (channels,)
  T* image;             // out, (channels, height, width)
  T* alpha;             // out, (height, width), or null
  // CUDA: out, (rasterize_boundaries, 1 + max(channels, 3), 256), or null if there is no backward
  // pass: of each pixel of a tile, in front of the first instance of a segment, the transmittance
  // (its negative if the pixel is finished) and the colour of the segments before. The first segment
  // of a tile has none. That of the instances from index i on is at index i / kSegment - 1.
  T* states;
  SNOW_FIELDS(n, frame, channels, background, image, alpha, states)
};

// rasterize_median has the same parameters. The image is (2, channels, height, width): the channels of
// the last splat of each pixel that is blended with T >= 1/2, 0 if there is none; and those of
// rasterize_fwd without a background.

// rasterize_count: the number of splats that are blended in each pixel.
template <class T>
struct RasterizeCountParams {
  int64_t n;  // tiles
  FrameParams<T> frame;
  T* counts;  // out, (height, width)
  SNOW_FIELDS(n, frame, counts)
};

template <class T>
struct RasterizeBackwardParams {
  int64_t n;  // tiles
  FrameParams<T> frame;
  int64_t channels;               // 1 to 4
  const uint32_t* instance_slot;  // (instances,), or null if `slots` is null
  const T* image;                 // (channels, height, width), output of the forward pass
  const T* grad_image;            // the same shape
  const T* states;                // of the forward pass; null: additive, or CPU
  const T* alpha;                 // (height, width)
  const T* grad_alpha;            // (height, width), or null
  T* slots;                       // out, (instances, 16) gradients, which splats_reduce adds;
                                  // null (CPU, CUDA): they are added to grad_packed. The order is
                                  // fixed on the CPU; CUDA adds atomically
  T* grad_packed;                 // (splats, stride)
  T* abs_grad;                    // as for splats_reduce, if `slots` is null; or null
  SNOW_FIELDS(n, frame, channels, instance_slot, image, grad_image, states, alpha, grad_alpha,
              slots, grad_packed, abs_grad)
};

// splats_reduce (CUDA): the gradient of a splat as the sum over its instances.
template <class T>
struct SplatsReduceParams {
  int64_t n;                   // splats
  const T* slots;              // (instances, 16)
  const uint32_t* slot_range;  // (n, 2)
  const T* packed;             // (n, stride)
  int64_t stride;              // columns
  int64_t channels;            // 1 to 4
  const int64_t* columns;      // (4,) destination columns of the gradients of the channels
  int64_t add;                 // 1: add to grad_packed; 0: write every column
  T* grad_packed;              // (n, stride)
  T* abs_grad;  // (n, 2), or null: |∂L/∂mean2d| of each instance is added, for x and y
  SNOW_FIELDS(n, slots, slot_range, packed, stride, channels, columns, add, grad_packed, abs_grad)
};

// background_bwd: the sum of grad_image · (1 − alpha) over each row of pixels.
template <class T>
struct BackgroundBackwardParams {
  int64_t n;            // rows: the height of the image
  int64_t width;        // pixels
  int64_t channels;     // any number
  const T* grad_image;  // (channels, n, width)
  const T* alpha;       // (n, width)
  double* rows;         // out, (n, channels)
  SNOW_FIELDS(n, width, channels, grad_image, alpha, rows)
};

// ---- photometric --------------------------------------------------------------------------------

// L1, the Huber function and SSIM between two images. Target is T, or uint8_t, where 255 means 1.
template <class T, class Target>
struct PhotometricParams {
  int64_t n;                      // channels
  int64_t width, height;          // pixels
  const T* image;                 // (n, height, width)
  const Target* target;           // (n, height, width)
  double l1_weight, ssim_weight;  // weights of L1 and SSIM in the gradient
  double huber_weight;            // weight of the Huber function in the gradient
  T* grad;                        // out, the gradient of the weighted sum, or null
  double* means;                  // out, (3,) means of |a − b|, of SSIM, of the Huber function
  SNOW_FIELDS(n, width, height, image, target, l1_weight, ssim_weight, huber_weight, grad, means)
};

// ---- neighbours ---------------------------------------------------------------------------------

template <class T>
struct NeighboursParams {
  int64_t n;        // points
  const T* points;  // (n, 3)
  int64_t k;        // 1 to 64
  T* distances;     // out, (n, k) ascending; infinity if there are fewer than k other points
  SNOW_FIELDS(n, points, k, distances)
};

// ---- plane_sweep --------------------------------------------------------------------------------

// The inverse depth of plane k at a pixel is first + k · step, plus `centre` of this pixel.
template <class T>
struct PlaneSweepParams {
  int64_t n;                            // sources, 1 to kMaxSweepSources
  int64_t width, height;                // of the reference view, pixels
  int64_t source_width, source_height;  // pixels, at least 2, with a product below 2^31
  const T* image;                       // (height, width) luminance; NaN: no value
  const T* sources;                     // (n, source_height, source_width)
  const T* source_from_pixel;           // (n, 3, 4)
  const T* centre;                      // (height, width), or null
  double first, step;                   // inverse depths
  int64_t planes;                       // at least 2
  int64_t radius;                       // of the window, 1 to kMaxSweepRadius
  T* inverse_depth;                     // out, (height, width); 0: none
  T* score;                             // out, (height, width), -1 to 1; -1: none
  SNOW_FIELDS(n, width, height, source_width, source_height, image, sources, source_from_pixel,
              centre, first, step, planes, radius, inverse_depth, score)
};

// ---- points_in_frusta ---------------------------------------------------------------------------

template <class T>
struct PointsInFrustaParams {
  int64_t n;          // points
  const T* points;    // (n, 3) world units
  int64_t views;      // V
  const T* to_image;  // (V, 3, 4) K [R | t]
  const T* size;      // (V, 2) width and height, pixels
  const T* depths;    // (V, 2) the range of depths, without its ends
  const T* focal;     // (V,) pixels
  T* counts;          // out, (n,) the number of views that contain the point
  T* rates;           // out, (n,) the largest focal / depth of these views, or 0
  SNOW_FIELDS(n, points, views, to_image, size, depths, focal, counts, rates)
};

// ---- points_in_spheres --------------------------------------------------------------------------

template <class T>
struct PointsInSpheresParams {
  int64_t n;         // points
  const T* points;   // (n, 3) world units
  int64_t count;     // C
  const T* spheres;  // (C, 4) centre and radius, world units
  T* counts;         // out, (n,) the number of spheres that contain the point
  T* nearest;        // out, (n,) the distance of the nearest centre, or inf
  SNOW_FIELDS(n, points, count, spheres, counts, nearest)
};

// ---- fuse_depth ---------------------------------------------------------------------------------

// Adds a depth map to the sums of samples, which are in cubes of side³ samples, x first.
template <class T>
struct FuseDepthParams {
  int64_t n;              // samples: side³ for each cube
  int64_t side;           // at least 1
  double spacing;         // of the samples, world units
  const T* origins;       // (n / side³, 3) the first sample of each cube, world units
  const T* to_image;      // (3, 4) K [R | t]
  int64_t width, height;  // of the depth map in pixels, with a product below 2^31
  const T* depth;         // (height, width) z; 0: unknown, infinity: there is no surface
  const T* weight;        // (height, width)
  int64_t channels;       // of `image`, 0 to 4
  const T* image;         // (channels, height, width), or null
  double truncation;      // world units
  T* sums;                // in and out, (n, 2 + channels): Σ w, Σ w s, and Σ w c of the channels
  SNOW_FIELDS(n, side, spacing, origins, to_image, width, height, depth, weight, channels, image,
              truncation, sums)
};

// ---- detect_sift (CPU only) ---------------------------------------------------------------------

// The `count` largest features of a photo, or fewer; returns their number, −1 if memory is missing.
struct DetectSiftParams {
  int64_t width;           // pixels, at least 1
  int64_t height;          // at least 1
  const uint8_t* grey;     // (height, width)
  const uint8_t* allowed;  // (height, width): 0 where no feature is wanted; or null
  int64_t count;           // at most
  float* keypoints;        // out, (count, 6): x, y from the corner of the photo; (2, 2) scale in
                           // pixels times rotation
  uint8_t* descriptors;    // out, (count, 128): RootSIFT, with the norm 512
  SNOW_FIELDS(width, height, grey, allowed, count, keypoints, descriptors)
};

// ---- match_descriptors (CPU only) ---------------------------------------------------------------

// For each row, a descriptor of the first image, the column with the largest dot product, this
// product, and that of the second best column; 0 if there is none. The same for each column. A row is
// compared with the first `common` columns, and with those of its range.
struct MatchDescriptorsParams {
  int64_t n;               // descriptors of the first image, below 2^31
  int64_t m;               // descriptors of the second image, below 2^31, at least 1 if n is
  const uint8_t* first;    // (n, 128)
  const uint8_t* second;   // (m, 128)
  int64_t common;          // 0 to m
  const int32_t* begin;    // (n,) of the range of each row, 0 to m
  const int32_t* end;      // (n,) of this range, 0 to m; the column `end` is not part of it
  int32_t* row_index;      // out, (n,); the smallest of the columns with the largest product, or -1
  int32_t* row_best;       // out, (n,)
  int32_t* row_second;     // out, (n,)
  int32_t* column_index;   // out, (m,)
  int32_t* column_best;    // out, (m,)
  int32_t* column_second;  // out, (m,)
  SNOW_FIELDS(n, m, first, second, common, begin, end, row_index, row_best, row_second,
              column_index, column_best, column_second)
};

// ---- align_patches (CPU only) -------------------------------------------------------------------

// For each pair of patches the affine transform of the positions that minimises the weighted squared
// differences of the grey values in a window, up to a gain and an offset of these values.
struct AlignPatchesParams {
  int64_t n;               // pairs
  int64_t side;            // of a patch in pixels; odd, at least 2 * kAlignmentRadius + 3
  const uint8_t* patches;  // (m, side, side)
  const int32_t* pairs;    // (n, 2); the window is at the centre of the first patch of a pair
  float* transform;    // out, (n, 2, 3), from the window to the second patch; both from the centre
  float* correlation;  // out, (n,), -1 to 1; -1 and the identity if there is no solution
  SNOW_FIELDS(n, side, patches, pairs, transform, correlation)
};

// ---- resample (CPU only) ------------------------------------------------------------------------

// The colours of a photo at positions between nodes. Pixel (x, y) of the result is at the bilinear
// interpolation, with the fractions across[x] and down[y], of the nodes column[x], column[x] + 1 of
// the rows row[y], row[y] + 1.
struct ResampleParams {
  int64_t channels;      // 1 to 4
  int64_t source_width;  // of the photo in pixels, below 2^16
  int64_t source_height;
  const uint8_t* source;  // (channels, source_height, source_width)
  int64_t wraps;       // beside the photo: 0: its border, 1: its other side; then 0 <= x <= 3 width
  int64_t columns;     // of the nodes
  const float* nodes;  // (rows, columns, 2): x, y in pixels of the photo; NaN as (-inf, -inf)
  const int32_t* column;  // (width,), at most columns - 2
  const float* across;    // (width,), 0 to 1
  const int32_t* row;     // (count,)
  const float* down;      // (count,), 0 to 1
  int64_t width;          // of the result in pixels
  int64_t height;
  int64_t first;  // row of the result; this row and those after it are written
  int64_t count;  // of the rows that are written
  uint8_t* made;  // out, (channels, height, width)
  SNOW_FIELDS(channels, source_width, source_height, source, wraps, columns, nodes, column, across,
              row, down, width, height, first, count, made)
};

// ---- sizes --------------------------------------------------------------------------------------

// Parameters of the entries that return a size, such as that of a scratch tensor.
struct SizeQueryParams {
  int64_t n;      // items
  int64_t tiles;  // tiles_workspace_bytes only
  int64_t parts;  // tiles_workspace_bytes only
  SNOW_FIELDS(n, tiles, parts)
};

}  // namespace snow
