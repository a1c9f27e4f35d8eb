// fuse_depth: adds a depth map to a truncated signed distance field; see fusion.h. One thread per
// sample.

struct Params {
  n: u32,
  side: u32,
  spacing: f32,
  width: u32,
  height: u32,
  channels: u32,
  truncation: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> origins: array<f32>;   // (n / side³, 3)
@group(0) @binding(2) var<storage, read> to_image: array<f32>;  // (3, 4)
@group(0) @binding(3) var<storage, read> depth: array<f32>;     // (height, width)
@group(0) @binding(4) var<storage, read> weight: array<f32>;    // (height, width)
@group(0) @binding(5) var<storage, read> image: array<f32>;     // (channels, height, width)
@group(0) @binding(6) var<storage, read_write> sums: array<f32>;  // (n, 2 + channels)

// Pixels above left, above right, below left, below right.
fn interpolated(p: vec4<f32>, f: vec2<f32>) -> f32 {
  let above = p.x + f.x * (p.y - p.x);
  let below = p.z + f.x * (p.w - p.z);
  return above + f.y * (below - above);
}

fn nearest(p: vec4<f32>, f: vec2<f32>) -> f32 {
  let pair = select(p.xy, p.zw, f.y >= 0.5);
  return select(pair.x, pair.y, f.x >= 0.5);
}

@compute @workgroup_size(64)
fn fuse_depth(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
              @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  if (i >= params.n) { return; }
  let side = params.side;
  let cube = i / (side * side * side);
  let local = i - cube * side * side * side;
  let index = vec3<u32>(local % side, local / side % side, local / (side * side));
  var point = vec3<f32>(0.0);
  var at = vec3<f32>(0.0);
  for (var c = 0u; c < 3u; c++) { point[c] = origins[3u * cube + c] + f32(index[c]) * params.spacing; }
  for (var c = 0u; c < 3u; c++) {
    at[c] = to_image[4u * c] * point.x + to_image[4u * c + 1u] * point.y +
            to_image[4u * c + 2u] * point.z + to_image[4u * c + 3u];
  }
  let u = at.x / at.z;
  let v = at.y / at.z;
  if (!(at.z > 0.0 && u >= 0.0 && v >= 0.0 && u < f32(params.width) && v < f32(params.height))) {
    return;
  }
  // Between the centres of four pixels, or at the border: see PixelIndex.
  let right = select(0u, 1u, params.width > 1u);
  let below = select(0u, params.width, params.height > 1u);
  let column = min(u32(max(u - 0.5, 0.0)), params.width - 1u - right);
  let row = min(u32(max(v - 0.5, 0.0)), params.height - 1u - select(0u, 1u, params.height > 1u));
  let first = row * params.width + column;
  let f = vec2<f32>(select(-0.5, u - 0.5 - f32(column), right > 0u),
                    select(-0.5, v - 0.5 - f32(row), below > 0u));
  let is_between = f.x >= 0.0 && f.x < 1.0 && f.y >= 0.0 && f.y < 1.0;

  let d = vec4<f32>(depth[first], depth[first + right], depth[first + below], depth[first + below + right]);
  let low = min(min(d.x, d.y), min(d.z, d.w));
  let high = max(max(d.x, d.y), max(d.z, d.w));
  let near = nearest(d, f);
  var surface = near;
  if (is_between && low > 0.0 && high - low < params.truncation) { surface = interpolated(d, f); }
  let s = (surface - at.z) / params.truncation;
  let w = weight[first + select(0u, right, f.x >= 0.5) + select(0u, below, f.y >= 0.5)];
  let limit = select(2.0, 1.0, params.channels > 0u);
  if (!(w > 0.0 && near > 0.0 && at.z - near < params.truncation && s > -1.0 && limit > min(s, 1.0))) {
    return;
  }
  let added = w * min(1.0, 1.0 + s);
  let begin = i * (2u + params.channels);
  sums[begin] += added;
  sums[begin + 1u] += added * min(s, 1.0);
  for (var k = 0u; k < params.channels; k++) {
    let plane = k * params.width * params.height + first;
    let c = vec4<f32>(image[plane], image[plane + right], image[plane + below], image[plane + below + right]);
    sums[begin + 2u + k] += added * select(nearest(c, f), interpolated(c, f), is_between);
  }
}
