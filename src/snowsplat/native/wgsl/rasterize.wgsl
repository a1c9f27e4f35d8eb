// Rasterization: composites the splats of each 16×16 tile front to back, and computes the gradient.
// One workgroup processes one tile, one thread a pixel; 32 neighbouring threads have a rectangle of
// 8×4 pixels. The mathematics is that of rasterize.h; the backward pass goes front to back, as in
// rasterize.cu, which has the derivation.
//
// Culling   Instances are loaded into workgroup memory in batches. The thread that loads an instance
//           tests it against the eight rectangles; a thread skips those that do not touch its own.
// Backward  The gradient of a splat is a sum over pixels. For four splats at a time, one thread per
//           pixel writes w = T α and q = ∂L/∂(log α) to workgroup memory; then one thread per splat
//           and row of pixels sums them; then one thread per splat and sum adds the 16 rows. The order
//           of all sums is fixed. The result is written to the slot of the instance.
//
// The entry rasterize_bwd may bind eight buffers. So rasterize_bwd_pixels first collects what it
// reads for each pixel in two of them.
struct Params {
  n: u32,
  frame_width: u32,
  frame_height: u32,
  frame_stride: u32,
  frame_additive: u32,
  channels: u32,
  mode: u32,  // of rasterize_fwd
  has_background: u32,
  background_offset: u32,
  has_alpha: u32,
  has_grad_alpha: u32,
  image_offset: u32,
  grad_image_offset: u32,
  width: u32,  // background_bwd
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> frame_packed: array<f32>;
@group(0) @binding(2) var<storage, read> frame_columns: array<i32>;  // of 64 bits each
@group(0) @binding(3) var<storage, read> frame_tile_start: array<u32>;
@group(0) @binding(4) var<storage, read> frame_instance_splat: array<u32>;
@group(0) @binding(5) var<storage, read> background: array<f32>;
@group(0) @binding(6) var<storage, read_write> image: array<f32>;
@group(0) @binding(7) var<storage, read_write> alpha: array<f32>;
@group(0) @binding(8) var<storage, read> grad_image: array<f32>;
@group(0) @binding(9) var<storage, read> grad_alpha: array<f32>;
@group(0) @binding(10) var<storage, read_write> pixel_grads: array<vec4<f32>>;  // ∂L/∂C
@group(0) @binding(11) var<storage, read_write> pixel_sums: array<vec2<f32>>;   // g·C, ∂L/∂alpha
@group(0) @binding(12) var<storage, read> instance_slot: array<u32>;
@group(0) @binding(13) var<storage, read_write> slots: array<f32>;
@group(0) @binding(14) var<storage, read_write> rows: array<u32>;  // numbers of 64 bits

const kTile = 16u;
const kThreads = 256u;
const kLog2E = 1.4426950408889634;
const kLog2MinAlpha = -7.994353436858858;
const kMaxAlpha = 0.99;
const kMinTransmittance = 1e-4;
const kCullSlack = 1e-3;
// Values of params.mode.
const kCount = 1u;   // the value of a pixel is the number of splats that are composited
const kMedian = 2u;  // the splat at which T falls below 1/2; then the colours without a background

struct Splat {
  mean_conic: vec4<f32>,     // mean, A, B of rasterize.h
  opacity_color: vec4<f32>,  // C, log2_opacity, colours 0 and 1
  color_23: vec2<f32>,       // colours 2 and 3
  rectangles: u32,           // a bit for each rectangle of the tile that the splat touches
}

fn column_of(row: u32, k: u32) -> f32 {
  let column = frame_columns[2 * k];
  if (k >= params.channels || column < 0) {
    return 0.0;
  }
  return frame_packed[row + u32(column)];
}

// `corner`: the first pixel of the tile.
fn load_splat(instance: u32, corner: vec2<u32>) -> Splat {
  let row = frame_instance_splat[instance] * params.frame_stride;
  let mean = vec2(frame_packed[row], frame_packed[row + 1]);
  let conic = vec3(frame_packed[row + 2], frame_packed[row + 3], frame_packed[row + 4]);
  let a = -0.5 * kLog2E * conic.x;
  let b = -kLog2E * conic.y;
  let c = -0.5 * kLog2E * conic.z;
  let log2_opacity = log2(frame_packed[row + 5]);
  var s: Splat;
  s.mean_conic = vec4(mean, a, b);
  s.opacity_color = vec4(c, log2_opacity, column_of(row, 0), column_of(row, 1));
  s.color_23 = vec2(column_of(row, 2), column_of(row, 3));
  // As in peak_over_rectangle.
  for (var r = 0u; r < 8; r++) {
    let low = vec2<f32>(corner + vec2(r % 2 * 8, r / 2 * 4)) + 0.5 - mean;
    let high = low + vec2(7.0, 3.0);
    let nearest = min(max(vec2(0.0), low), high);
    let x_on = min(max(-(conic.y / conic.x) * nearest.y, low.x), high.x);
    let y_on = min(max(-(conic.y / conic.z) * nearest.x, low.y), high.y);
    let on_row = (a * x_on + b * nearest.y) * x_on + c * nearest.y * nearest.y;
    let on_column = (c * y_on + b * nearest.x) * y_on + a * nearest.x * nearest.x;
    let peak = max(on_row, on_column) + log2_opacity;
    s.rectangles |= select(0u, 1u << r, peak >= kLog2MinAlpha - kCullSlack);
  }
  return s;
}

struct Blended {
  transmittance: f32,  // behind the splat; its negative if the pixel is finished
  uncapped: f32,  // α
  capped: f32,
  weight: f32,
  blended: bool,
}

// Composites a splat into a pixel whose signed transmittance is `front`.
fn blend(pixel: vec2<f32>, front: f32, mean_conic: vec4<f32>, opacity_color: vec4<f32>) -> Blended {
  let d = pixel - mean_conic.xy;
  let power = fma(fma(mean_conic.z, d.x, mean_conic.w * d.y), d.x,
                  fma(opacity_color.x * d.y, d.y, opacity_color.y));
  let uncapped = exp2(power);
  let capped = min(uncapped, kMaxAlpha);
  let visible = power >= kLog2MinAlpha && front > 0;
  if (params.frame_additive != 0) {
    return Blended(front, uncapped, capped, select(0.0, uncapped, visible), visible);
  }
  let behind = fma(-capped, front, front);
  let blended = visible && behind >= kMinTransmittance;
  return Blended(select(select(front, -front, visible), behind, blended), uncapped, capped,
                 select(0.0, capped * front, blended), blended);
}

struct Pixel {
  corner: vec2<u32>,  // of the tile
  at: vec2<u32>,
  inside: bool,
  index: u32,  // in a channel
}

fn pixel_of(tile: u32, thread: u32) -> Pixel {
  let tiles_x = (params.frame_width + kTile - 1) / kTile;
  var p: Pixel;
  p.corner = kTile * vec2(tile % tiles_x, tile / tiles_x);
  let rectangle = thread / 32;
  p.at = p.corner + vec2(rectangle % 2 * 8 + thread % 8, rectangle / 2 * 4 + thread % 32 / 8);
  p.inside = p.at.x < params.frame_width && p.at.y < params.frame_height;
  p.index = p.at.y * params.frame_width + p.at.x;
  return p;
}

var<workgroup> open_pixels: atomic<u32>;  // that are not finished
var<workgroup> goes_on: u32;

// All threads of the workgroup call this, and get the same answer.
fn any_open(thread: u32) -> bool {
  workgroupBarrier();
  if (thread == 0) {
    goes_on = atomicLoad(&open_pixels);
  }
  return workgroupUniformLoad(&goes_on) != 0;
}

// ---- Forward ------------------------------------------------------------------------------------

var<workgroup> batch_mean_conic: array<vec4<f32>, 256>;
var<workgroup> batch_opacity_color: array<vec4<f32>, 256>;
var<workgroup> batch_color_23: array<vec2<f32>, 256>;
var<workgroup> touching: array<atomic<u32>, 64>;  // for each rectangle: a bit for each instance

@compute @workgroup_size(256)
fn rasterize_fwd(@builtin(workgroup_id) group: vec3<u32>,
                 @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) thread: u32) {
  let tile = group.y * groups.x + group.x;
  if (tile >= params.n) {
    return;
  }
  let p = pixel_of(tile, thread);
  let position = vec2<f32>(p.at) + 0.5;
  var transmittance = select(-1.0, 1.0, p.inside);
  var color = vec4(0.0);
  var median = vec4(0.0);
  if (p.inside) {
    atomicAdd(&open_pixels, 1u);
  }
  let end = frame_tile_start[tile + 1];
  for (var base = frame_tile_start[tile]; base < end; base += kThreads) {
    if (!any_open(thread)) {
      break;
    }
    if (thread < 64) {
      atomicStore(&touching[thread], 0u);
    }
    workgroupBarrier();
    if (base + thread < end) {
      let s = load_splat(base + thread, p.corner);
      batch_mean_conic[thread] = s.mean_conic;
      batch_opacity_color[thread] = s.opacity_color;
      batch_color_23[thread] = s.color_23;
      for (var r = 0u; r < 8; r++) {
        if (((s.rectangles >> r) & 1) != 0) {
          atomicOr(&touching[8 * r + thread / 32], 1u << (thread % 32));
        }
      }
    }
    workgroupBarrier();
    let was_open = transmittance > 0;
    for (var word = 0u; word < 8 && transmittance > 0; word++) {
      var bits = atomicLoad(&touching[8 * (thread / 32) + word]);
      while (bits != 0 && transmittance > 0) {
        let i = 32 * word + countTrailingZeros(bits);
        bits &= bits - 1;
        let opacity_color = batch_opacity_color[i];
        let b = blend(position, transmittance, batch_mean_conic[i], opacity_color);
        let splat = vec4(opacity_color.zw, batch_color_23[i]);
        if (params.mode == kCount) {
          color.x += f32(b.blended);
        } else {
          if (params.mode == kMedian && b.blended && transmittance >= 0.5) {
            median = splat;
          }
          color += b.weight * splat;
        }
        transmittance = b.transmittance;
      }
    }
    if (was_open && transmittance < 0) {
      atomicSub(&open_pixels, 1u);
    }
  }
  if (!p.inside) {
    return;
  }
  let pixels = params.frame_width * params.frame_height;
  let left = abs(transmittance);
  for (var k = 0u; k < params.channels; k++) {
    var value = color[k];
    if (params.mode == kMedian) {
      image[params.image_offset + (params.channels + k) * pixels + p.index] = value;
      value = median[k];
    } else if (params.has_background != 0) {
      value += left * background[params.background_offset + k];
    }
    image[params.image_offset + k * pixels + p.index] = value;
  }
  if (params.has_alpha != 0) {
    alpha[p.index] = 1 - left;
  }
}

// ---- Backward -----------------------------------------------------------------------------------

@compute @workgroup_size(256)
fn rasterize_bwd_pixels(@builtin(workgroup_id) group: vec3<u32>,
                        @builtin(num_workgroups) groups: vec3<u32>,
                        @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * kThreads + thread;
  let pixels = params.frame_width * params.frame_height;
  if (i >= pixels) {
    return;
  }
  var grads = vec4(0.0);
  var sums = vec2(0.0);
  for (var k = 0u; k < params.channels; k++) {
    grads[k] = grad_image[params.grad_image_offset + k * pixels + i];
    sums.x += grads[k] * image[params.image_offset + k * pixels + i];
  }
  if (params.has_grad_alpha != 0) {
    sums.y = grad_alpha[i];
    sums.x += sums.y * alpha[i];
  }
  pixel_grads[i] = grads;
  pixel_sums[i] = sums;
}

const kBatch = 32u;  // instances
const kGroup = 4u;   // splats that are processed at a time
const kSums = 10u;   // four colours, then the moments q, qx, qy, qxx, qxy, qyy

var<workgroup> mean_conics: array<vec4<f32>, 32>;
var<workgroup> opacity_colors: array<vec4<f32>, 32>;
var<workgroup> colors_23: array<vec2<f32>, 32>;
var<workgroup> rectangles: array<u32, 32>;
var<workgroup> grads_of: array<vec4<f32>, 256>;    // of each pixel, row by row
var<workgroup> pairs: array<vec2<f32>, 1024>;      // w and q, of each splat and pixel
var<workgroup> sums_of_rows: array<f32, 640>;      // of each splat and row of pixels

// The columns of a slot that are used.
fn used_sums() -> u32 {
  return select(kSums, kSums - 1, params.channels <= 3);
}

@compute @workgroup_size(256)
fn rasterize_bwd(@builtin(workgroup_id) group: vec3<u32>,
                 @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) thread: u32) {
  let tile = group.y * groups.x + group.x;
  if (tile >= params.n) {
    return;
  }
  let p = pixel_of(tile, thread);
  let position = vec2<f32>(p.at) + 0.5;
  let in_tile = p.at - p.corner;
  let place = kTile * in_tile.y + in_tile.x;
  var transmittance = select(-1.0, 1.0, p.inside);
  var grads = vec4(0.0);
  var sums = vec2(0.0);
  if (p.inside) {
    grads = pixel_grads[p.index];
    sums = pixel_sums[p.index];
    atomicAdd(&open_pixels, 1u);
  }
  grads_of[place] = grads;
  var behind = sums.x;  // S of the splats behind the current one
  let end = frame_tile_start[tile + 1];
  var base = frame_tile_start[tile];
  for (; base < end; base += kBatch) {
    if (!any_open(thread)) {
      break;
    }
    let size = min(kBatch, end - base);
    if (thread < size) {
      let s = load_splat(base + thread, p.corner);
      mean_conics[thread] = s.mean_conic;
      opacity_colors[thread] = s.opacity_color;
      colors_23[thread] = s.color_23;
      rectangles[thread] = s.rectangles;
    }
    workgroupBarrier();
    let was_open = transmittance > 0;
    for (var first = 0u; first < size; first += kGroup) {
      for (var j = 0u; j < min(kGroup, size - first); j++) {
        let i = first + j;
        var pair = vec2(0.0);
        if (transmittance > 0 && ((rectangles[i] >> (thread / 32)) & 1) != 0) {
          let opacity_color = opacity_colors[i];
          let b = blend(position, transmittance, mean_conics[i], opacity_color);
          transmittance = b.transmittance;
          let weighted_dot =
            b.weight * (dot(grads, vec4(opacity_color.zw, colors_23[i])) + sums.y);
          pair = vec2(b.weight, weighted_dot);
          if (params.frame_additive == 0) {
            behind -= weighted_dot;
            let q = weighted_dot - b.capped * behind / (1 - b.capped);
            pair.y = select(0.0, q, b.blended && b.uncapped < kMaxAlpha);
          }
        }
        pairs[j * kThreads + place] = pair;
      }
      workgroupBarrier();
      if (thread < kTile * kGroup && first + thread / kTile < size) {
        let mean_conic = mean_conics[first + thread / kTile];
        let y = thread % kTile;
        var color = vec4(0.0);
        var q = vec3(0.0);  // times 1, dx and dx²
        for (var k = 0u; k < kTile; k++) {
          let x = (k + y) % kTile;  // the threads read different banks
          let pair = pairs[thread / kTile * kThreads + kTile * y + x];
          let dx = f32(p.corner.x + x) + 0.5 - mean_conic.x;
          color += pair.x * grads_of[kTile * y + x];
          q += pair.y * vec3(1, dx, dx * dx);
        }
        let dy = f32(p.corner.y + y) + 0.5 - mean_conic.y;
        let at = thread * kSums;
        for (var k = 0u; k < 4; k++) {
          sums_of_rows[at + k] = color[k];
        }
        sums_of_rows[at + 4] = q.x;
        sums_of_rows[at + 5] = q.y;
        sums_of_rows[at + 6] = q.x * dy;
        sums_of_rows[at + 7] = q.z;
        sums_of_rows[at + 8] = q.y * dy;
        sums_of_rows[at + 9] = q.x * dy * dy;
      }
      workgroupBarrier();
      let splat = thread / 16;
      if (splat < kGroup && first + splat < size && thread % 16 < used_sums()) {
        // Without a fourth colour, the moments are one column before.
        let column = thread % 16 + select(0u, 1u, params.channels <= 3 && thread % 16 >= 3);
        var sum = 0.0;
        for (var y = 0u; y < kTile; y++) {
          sum += sums_of_rows[(splat * kTile + y) * kSums + column];
        }
        slots[16 * instance_slot[base + first + splat] + thread % 16] = sum;
      }
    }
    if (was_open && transmittance < 0) {
      atomicSub(&open_pixels, 1u);
    }
  }
  // No pixel sees the instances that are left.
  for (var i = base + thread / 16; i < end; i += kThreads / 16) {
    if (thread % 16 < used_sums()) {
      slots[16 * instance_slot[i] + thread % 16] = 0;
    }
  }
}

// ---- Background ---------------------------------------------------------------------------------

var<workgroup> row_sums: array<f32, 128>;

// The sum over a row of pixels of grad_image · (1 − alpha), written as a number of 64 bits. One
// workgroup for each row.
@compute @workgroup_size(128)
fn background_bwd(@builtin(workgroup_id) group: vec3<u32>,
                  @builtin(num_workgroups) groups: vec3<u32>,
                  @builtin(local_invocation_index) thread: u32) {
  let y = group.y * groups.x + group.x;
  if (y >= params.n) {
    return;
  }
  for (var k = 0u; k < params.channels; k++) {
    var sum = 0.0;
    for (var x = thread; x < params.width; x += 128) {
      let grad = grad_image[params.grad_image_offset + (k * params.n + y) * params.width + x];
      sum += grad * (1 - alpha[y * params.width + x]);
    }
    row_sums[thread] = sum;
    workgroupBarrier();
    for (var step = 64u; step > 0; step /= 2) {
      if (thread < step) {
        row_sums[thread] += row_sums[thread + step];
      }
      workgroupBarrier();
    }
    if (thread == 0) {
      let bits = bitcast<u32>(row_sums[0]);
      let exponent = (bits >> 23) & 255;
      let high = select(select(exponent + 896, 2047u, exponent == 255), 0u, exponent == 0);
      let fraction = select(bits & 0x7fffff, 0u, exponent == 0);
      rows[2 * (y * params.channels + k)] = fraction << 29;
      rows[2 * (y * params.channels + k) + 1] = (bits & 0x80000000) | (high << 20) | (fraction >> 3);
    }
    workgroupBarrier();
  }
}
