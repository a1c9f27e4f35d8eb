// photometric: L1, the Huber function and SSIM (ssim.h) between two images, and the gradient of their
// weighted sum.
//
//   photometric_similarity  the sums of a tile, and the derivatives of SSIM by three windowed means
//   photometric_gradient    filters these derivatives
//   photometric_means       adds the sums of all tiles, in a fixed order
//
// A work group processes a tile of a channel, one thread per pixel. The window is separable.

struct Params {
  n: u32,  // channels, from channel `first` on
  first: u32,
  width: u32,  // pixels
  height: u32,
  bytes: u32,       // 1: `reference` has bytes, where 255 means 1; 0: float32
  l1_weight: f32,   // divided by the number of values
  ssim_weight: f32,
  huber_weight: f32,
  tiles: u32,       // of a channel
  parts: u32,       // photometric_means: rows of `sums`
  values: f32,      // photometric_means: the number of values of an image
  has_maps: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> image: array<f32>;           // (channels, height, width)
@group(0) @binding(2) var<storage, read> reference: array<u32>;       // the same shape
@group(0) @binding(3) var<storage, read_write> maps: array<f32>;      // (n, 3, height, width)
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;      // (channels, tiles, 3)
@group(0) @binding(5) var<storage, read_write> grad: array<f32>;      // (channels, height, width)
@group(0) @binding(6) var<storage, read_write> means: array<u32>;     // (3,) float64

const kEdge = 16u;
const kRadius = 5u;
// The window, from its centre on; it is symmetric. A loop over an array of them would be slower.
const kTap0 = 0.26601172486179436;
const kTap1 = 0.2130055377112537;
const kTap2 = 0.10936068950970002;
const kTap3 = 0.03600077212843083;
const kTap4 = 0.007598758135239185;
const kTap5 = 0.00102838008447911;
const kWide = 26u;               // kEdge + 2 kRadius
const kWideCount = 676u;         // kWide²
const kRows = 416u;              // kWide · kEdge
const kC1 = 0.0001;
const kC2 = 0.0009;
const kHuberDelta = 0.1;

var<workgroup> wide: array<f32, 2028>;      // 3 kWideCount
var<workgroup> filtered: array<f32, 1664>;  // 4 kRows

fn reference_at(i: u32) -> f32 {
  if (params.bytes == 0u) { return bitcast<f32>(reference[i]); }
  return f32((reference[i / 4u] >> (8u * (i % 4u))) & 255u) * (1.0 / 255.0);
}

struct Tile {
  channel: u32,  // of all
  left: u32,
  top: u32,
  index: u32,    // of the tile, for `sums`
}

fn tile_of(index: u32) -> Tile {
  let across = (params.width + kEdge - 1u) / kEdge;
  let tile = index % params.tiles;
  let channel = params.first + index / params.tiles;
  return Tile(channel, tile % across * kEdge, tile / across * kEdge, channel * params.tiles + tile);
}

// The index in a channel of pixel i of the tile with its margin, or −1 outside of the image.
fn wide_pixel(tile: Tile, i: u32) -> i32 {
  let x = i32(tile.left + i % kWide) - i32(kRadius);
  let y = i32(tile.top + i / kWide) - i32(kRadius);
  let inside = x >= 0 && y >= 0 && x < i32(params.width) && y < i32(params.height);
  return select(-1, y * i32(params.width) + x, inside);
}

// The column filter of a map at the pixel of a thread.
fn down(map: u32, thread: u32) -> f32 {
  let at = map * kRows + thread;  // of the first of 11 rows of 16 pixels
  return kTap5 * (filtered[at] + filtered[at + 160u]) + kTap4 * (filtered[at + 16u] + filtered[at + 144u]) +
         kTap3 * (filtered[at + 32u] + filtered[at + 128u]) +
         kTap2 * (filtered[at + 48u] + filtered[at + 112u]) +
         kTap1 * (filtered[at + 64u] + filtered[at + 96u]) + kTap0 * filtered[at + 80u];
}

// a, b, a² + b² and ab at a pixel of the tile with its margin.
fn products(at: u32) -> vec4<f32> {
  let a = wide[at];
  let b = wide[kWideCount + at];
  return vec4<f32>(a, b, a * a + b * b, a * b);
}

fn derivatives(at: u32) -> vec3<f32> {
  return vec3<f32>(wide[at], wide[kWideCount + at], wide[2u * kWideCount + at]);
}

@compute @workgroup_size(256)
fn photometric_similarity(@builtin(workgroup_id) group: vec3<u32>,
                          @builtin(num_workgroups) groups: vec3<u32>,
                          @builtin(local_invocation_index) thread: u32) {
  let index = group.y * groups.x + group.x;
  if (index >= params.n * params.tiles) { return; }
  let tile = tile_of(index);
  let plane = params.width * params.height;
  for (var i = thread; i < kWideCount; i += 256u) {
    let at = wide_pixel(tile, i);
    var a = 0.0;
    var b = 0.0;
    if (at >= 0) {
      a = image[tile.channel * plane + u32(at)];
      b = reference_at(tile.channel * plane + u32(at));
    }
    wide[i] = a;
    wide[kWideCount + i] = b;
  }
  workgroupBarrier();
  for (var i = thread; i < kRows; i += 256u) {
    let at = i / kEdge * kWide + i % kEdge;
    let sum = kTap5 * (products(at) + products(at + 10u)) + kTap4 * (products(at + 1u) + products(at + 9u)) +
              kTap3 * (products(at + 2u) + products(at + 8u)) + kTap2 * (products(at + 3u) + products(at + 7u)) +
              kTap1 * (products(at + 4u) + products(at + 6u)) + kTap0 * products(at + 5u);
    for (var map = 0u; map < 4u; map++) { filtered[map * kRows + i] = sum[map]; }
  }
  workgroupBarrier();
  let x = tile.left + thread % kEdge;
  let y = tile.top + thread / kEdge;
  var found = vec3<f32>(0.0);  // |a − b|, SSIM, the Huber function
  if (x < params.width && y < params.height) {
    let mean_a = down(0u, thread);
    let mean_b = down(1u, thread);
    let squares = mean_a * mean_a + mean_b * mean_b;
    let ab = mean_a * mean_b;
    let l_up = 2.0 * ab + kC1;
    let l_down = squares + kC1;
    let s_up = 2.0 * (down(3u, thread) - ab) + kC2;
    let s_down = down(2u, thread) - squares + kC2;
    let inverse = 1.0 / (l_down * s_down);
    let ssim = l_up * s_up * inverse;
    if (params.has_maps != 0u) {
      let d_ab = 2.0 * l_up * inverse;
      let d_aa = -(ssim * inverse * l_down);
      let d_a = 2.0 * (mean_b * s_up * inverse - mean_a * ssim * inverse * s_down - mean_a * d_aa)
                - mean_b * d_ab;
      let at = 3u * (tile.channel - params.first) * plane + y * params.width + x;
      maps[at] = d_a;
      maps[at + plane] = d_aa;
      maps[at + 2u * plane] = d_ab;
    }
    let centre = (thread / kEdge + kRadius) * kWide + thread % kEdge + kRadius;
    let size = abs(wide[centre] - wide[kWideCount + centre]);
    let near = min(size, kHuberDelta);
    found = vec3<f32>(size, ssim, near * (2.0 * size - near));
  }
  workgroupBarrier();
  for (var k = 0u; k < 3u; k++) { wide[256u * k + thread] = found[k]; }
  workgroupBarrier();
  let sum = sum_of_list(thread);
  if (thread < 3u) { sums[3u * tile.index + thread] = sum; }
}

// The sum of list `thread` of three lists of 256 numbers in `wide`, for thread 0 to 2. In two steps,
// because a barrier takes long on drivers that compute on the CPU.
fn sum_of_list(thread: u32) -> f32 {
  if (thread < 48u) {
    var part = 0.0;
    for (var i = 0u; i < 16u; i++) { part += wide[16u * thread + i]; }
    wide[768u + thread] = part;
  }
  workgroupBarrier();
  var sum = 0.0;
  if (thread < 3u) {
    for (var i = 0u; i < 16u; i++) { sum += wide[768u + 16u * thread + i]; }
  }
  return sum;
}

@compute @workgroup_size(256)
fn photometric_gradient(@builtin(workgroup_id) group: vec3<u32>,
                        @builtin(num_workgroups) groups: vec3<u32>,
                        @builtin(local_invocation_index) thread: u32) {
  let index = group.y * groups.x + group.x;
  if (index >= params.n * params.tiles) { return; }
  let tile = tile_of(index);
  let plane = params.width * params.height;
  let begin = 3u * (tile.channel - params.first) * plane;
  // Windows are centred only on pixels of the image: outside of it the derivatives are 0.
  for (var i = thread; i < kWideCount; i += 256u) {
    let at = wide_pixel(tile, i);
    for (var map = 0u; map < 3u; map++) {
      var d = 0.0;
      if (at >= 0) { d = maps[begin + map * plane + u32(at)]; }
      wide[map * kWideCount + i] = d;
    }
  }
  workgroupBarrier();
  for (var i = thread; i < kRows; i += 256u) {
    let at = i / kEdge * kWide + i % kEdge;
    let sum = kTap5 * (derivatives(at) + derivatives(at + 10u)) + kTap4 * (derivatives(at + 1u) + derivatives(at + 9u)) +
              kTap3 * (derivatives(at + 2u) + derivatives(at + 8u)) + kTap2 * (derivatives(at + 3u) + derivatives(at + 7u)) +
              kTap1 * (derivatives(at + 4u) + derivatives(at + 6u)) + kTap0 * derivatives(at + 5u);
    for (var map = 0u; map < 3u; map++) { filtered[map * kRows + i] = sum[map]; }
  }
  workgroupBarrier();
  let x = tile.left + thread % kEdge;
  let y = tile.top + thread / kEdge;
  if (x >= params.width || y >= params.height) { return; }
  let at = tile.channel * plane + y * params.width + x;
  let a = image[at];
  let b = reference_at(at);
  let away = params.l1_weight + 2.0 * params.huber_weight * min(abs(a - b), kHuberDelta);
  grad[at] = select(select(0.0, -away, b > a), away, a > b) +
             params.ssim_weight * (down(0u, thread) + 2.0 * a * down(1u, thread) + b * down(2u, thread));
}

// One work group: means[0] = Σ |a − b| / values; means[1] and means[2] are those of SSIM and Huber.
@compute @workgroup_size(256)
fn photometric_means(@builtin(local_invocation_index) thread: u32) {
  for (var k = 0u; k < 3u; k++) {
    var sum = 0.0;
    for (var i = thread; i < params.parts; i += 256u) { sum += sums[3u * i + k]; }
    wide[256u * k + thread] = sum;
  }
  workgroupBarrier();
  let total = sum_of_list(thread);
  if (thread < 3u) {
    // The bits of a float64.
    let bits = bitcast<u32>(total / params.values);
    let exponent = (bits >> 23u) & 255u;
    let fraction = bits & 0x7fffffu;
    let high = select(exponent + 896u, 2047u, exponent == 255u) << 20u;
    means[2u * thread] = fraction << 29u;
    means[2u * thread + 1u] = (bits & 0x80000000u) | high | (fraction >> 3u);
    if (exponent == 0u) {
      means[2u * thread] = 0u;
      means[2u * thread + 1u] = bits & 0x80000000u;
    }
  }
}
