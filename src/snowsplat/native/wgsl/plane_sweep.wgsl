// plane_sweep: the inverse depth of every pixel by a plane sweep over several source images; see
// plane_sweep.h, where a value that is not valid is NaN. WGSL has no NaN that can be relied on, so
// such values are kNone here.
//
// A work group processes a tile of the reference view, one thread per pixel. For each plane and
// source, its threads sample the source at the positions of the pixels of the tile, and of a margin.

struct Params {
  n: u32,  // sources
  width: u32,
  height: u32,
  source_width: u32,
  source_height: u32,
  first: f32,
  step: f32,
  planes: u32,
  radius: u32,
  has_centre: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> image: array<f32>;              // (height, width)
@group(0) @binding(2) var<storage, read> sources: array<f32>;            // (n, height, width)
@group(0) @binding(3) var<storage, read> source_from_pixel: array<f32>;  // (n, 3, 4)
@group(0) @binding(4) var<storage, read> centre: array<f32>;             // (height, width)
@group(0) @binding(5) var<storage, read_write> inverse_depth: array<f32>;
@group(0) @binding(6) var<storage, read_write> score: array<f32>;

const kEdge = 16u;
const kMostWide = 30u;  // kEdge + 2 · 7
const kNone = 1e30;
const kMiddle = 0.5;
const kMinVariance = 1.0 / 65025.0;
const kNoScore = -2.0;

var<workgroup> reference: array<f32, 900>;
var<workgroup> samples: array<f32, 900>;

fn is_number(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

fn in_image(x: i32, y: i32) -> bool {
  return x >= 0 && y >= 0 && x < i32(params.width) && y < i32(params.height);
}

fn centre_at(at: u32) -> f32 {
  if (params.has_centre == 0u) { return 0.0; }
  return centre[at];
}

fn value_or_none(x: f32) -> f32 {
  return select(kNone, x, is_number(x));
}

// The luminance of a source at the point that pixel (u, v) shows at inverse depth w.
fn source_at(s: u32, u: f32, v: f32, w: f32) -> f32 {
  let m = 12u * s;
  let z = source_from_pixel[m + 8u] * u + (source_from_pixel[m + 9u] * v + source_from_pixel[m + 10u]) +
          source_from_pixel[m + 11u] * w;
  let inverse = 1.0 / z;
  let x = (source_from_pixel[m] * u + (source_from_pixel[m + 1u] * v + source_from_pixel[m + 2u]) +
           source_from_pixel[m + 3u] * w) * inverse - 0.5;
  let y = (source_from_pixel[m + 4u] * u + (source_from_pixel[m + 5u] * v + source_from_pixel[m + 6u]) +
           source_from_pixel[m + 7u] * w) * inverse - 0.5;
  let right = f32(params.source_width - 1u);
  let bottom = f32(params.source_height - 1u);
  if (!(z > 0.0 && w >= 0.0 && x >= 0.0 && y >= 0.0 && x <= right && y <= bottom)) { return kNone; }
  let column = min(u32(x), params.source_width - 2u);
  let row = min(u32(y), params.source_height - 2u);
  let at = (s * params.source_height + row) * params.source_width + column;
  let fx = x - f32(column);
  let fy = y - f32(row);
  let upper = sources[at] + fx * (sources[at + 1u] - sources[at]);
  let below = at + params.source_width;
  let lower = sources[below] + fx * (sources[below + 1u] - sources[below]);
  return value_or_none(upper + fy * (lower - upper) - kMiddle);
}

@compute @workgroup_size(256)
fn plane_sweep(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
  let tile = group.y * groups.x + group.x;
  let across = (params.width + kEdge - 1u) / kEdge;
  let wide = kEdge + 2u * params.radius;
  let left = i32(tile % across * kEdge) - i32(params.radius);
  let top = i32(tile / across * kEdge) - i32(params.radius);
  for (var i = thread; i < wide * wide; i += 256u) {
    let u = left + i32(i % wide);
    let v = top + i32(i / wide);
    var value = 0.0;
    if (in_image(u, v)) { value = value_or_none(image[u32(v) * params.width + u32(u)] - kMiddle); }
    reference[i] = value;
  }
  workgroupBarrier();

  let column = thread % kEdge;
  let row = thread / kEdge;
  // The window in the reference view.
  var sum = 0.0;
  var sum_of_squares = 0.0;
  var count = 0.0;
  var is_seen = true;
  for (var j = row; j <= row + 2u * params.radius; j++) {
    for (var i = column; i <= column + 2u * params.radius; i++) {
      let a = reference[j * wide + i];
      is_seen = is_seen && a != kNone;
      sum += a;
      sum_of_squares += a * a;
      count += select(0.0, 1.0, in_image(left + i32(i), top + i32(j)));
    }
  }
  let share = 1.0 / count;
  let mean_a = sum * share;
  let variance_a = sum_of_squares * share - mean_a * mean_a;
  is_seen = is_seen && variance_a >= kMinVariance;
  let inverse_deviation = 1.0 / sqrt(max(variance_a, kMinVariance));

  var best = vec4<f32>(-2.0, kNoScore, kNoScore, kNoScore);  // plane, its score, before, after
  var previous = kNoScore;
  for (var k = 0u; k < params.planes; k++) {
    let offset = params.first + params.step * f32(k);
    var first = kNoScore;  // the two best correlations
    var second = kNoScore;
    for (var s = 0u; s < params.n; s++) {
      workgroupBarrier();
      for (var i = thread; i < wide * wide; i += 256u) {
        let u = left + i32(i % wide);
        let v = top + i32(i / wide);
        var value = 0.0;
        if (in_image(u, v)) {
          let w = centre_at(u32(v) * params.width + u32(u)) + offset;
          value = source_at(s, f32(u) + 0.5, f32(v) + 0.5, w);
        }
        samples[i] = value;
      }
      workgroupBarrier();
      var b = 0.0;
      var bb = 0.0;
      var ab = 0.0;
      var is_valid = is_seen;
      for (var j = row; j <= row + 2u * params.radius; j++) {
        for (var i = column; i <= column + 2u * params.radius; i++) {
          let sample = samples[j * wide + i];
          is_valid = is_valid && sample != kNone;
          b += sample;
          bb += sample * sample;
          ab += sample * reference[j * wide + i];
        }
      }
      if (is_valid) {
        let mean_b = b * share;
        let variance = max(bb * share - mean_b * mean_b, kMinVariance);
        let ratio = (ab * share - mean_a * mean_b) * inverse_deviation / sqrt(variance);
        let correlation = select(kNoScore, clamp(ratio, -1.0, 1.0), ratio >= -1.5);
        second = max(second, min(first, correlation));
        first = max(first, correlation);
      }
    }
    let added = select(first, 0.5 * (first + second), second >= -1.0);
    if (best.x >= f32(k) - 1.0) { best.w = added; }
    if (added > best.y) { best = vec4<f32>(f32(k), added, previous, kNoScore); }
    previous = added;
  }

  let x = left + i32(column + params.radius);
  let y = top + i32(row + params.radius);
  if (!in_image(x, y)) { return; }
  let at = u32(y) * params.width + u32(x);
  var shift = 0.0;
  if (min(best.z, best.w) >= -1.0) {
    shift = 0.5 * (best.z - best.w) / (best.z - best.y + (best.w - best.y));
  }
  let depth = centre_at(at) + params.first + params.step * (best.x + shift);
  inverse_depth[at] = select(0.0, depth, best.y >= -1.0);
  score[at] = max(best.y, -1.0);
}
