// neighbours: the exact distances from each point to its k nearest others.
//
//   neighbours_codes   the index of each point on a Morton curve (Morton 1966), 10 bits per axis
//   (a sort by code)   consecutive points are then near each other
//   neighbours_chunks  the points in that order; the bounding box of each chunk of 32 points
//   neighbours_groups  the bounding box of each group of 32 chunks
//   neighbours_search  the search, one thread per point
//
// A thread begins with its own chunk and the two adjacent ones, which bounds the k-th distance. It then
// visits each chunk whose box is nearer than the k-th best distance so far. So the result is exact.

struct Params {
  n: u32,
  k: u32,
  chunks: u32,
  groups: u32,
  half_extent: f32,  // half of the longest edge of the box of all points
  half_low_x: f32,   // half of its corner: differences of halves do not overflow
  half_low_y: f32,
  half_low_z: f32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> points: array<f32>;            // (n, 3)
@group(0) @binding(2) var<storage, read_write> codes: array<u32>;       // (n,)
@group(0) @binding(3) var<storage, read> order: array<u32>;             // (n,)
@group(0) @binding(4) var<storage, read_write> ordered: array<f32>;     // (n, 3)
@group(0) @binding(5) var<storage, read_write> chunk_boxes: array<f32>; // (chunks, 6): low, high
@group(0) @binding(6) var<storage, read_write> group_boxes: array<f32>; // (groups, 6)
@group(0) @binding(7) var<storage, read_write> distances: array<f32>;   // (n, k)

const kChunk = 32u;

var<private> best: array<f32, 64>;  // squared, ascending; the first k are in use

fn infinite() -> f32 {
  var bits = 0x7f800000u;  // no constant: WGSL has none for infinity
  return bitcast<f32>(bits);
}

fn spread(bits: u32) -> u32 {
  var x = bits;
  x = (x | (x << 16u)) & 0x030000ffu;
  x = (x | (x << 8u)) & 0x0300f00fu;
  x = (x | (x << 4u)) & 0x030c30c3u;
  return (x | (x << 2u)) & 0x09249249u;
}

fn cell(x: f32, half_low: f32) -> u32 {
  if (!(params.half_extent > 0.0)) { return 0u; }
  return spread(u32(clamp((0.5 * x - half_low) / params.half_extent, 0.0, 1.0) * 1023.0));
}

@compute @workgroup_size(64)
fn neighbours_codes(@builtin(workgroup_id) group: vec3<u32>,
                    @builtin(num_workgroups) size: vec3<u32>,
                    @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * size.x + group.x) * 64u + thread;
  if (i >= params.n) { return; }
  codes[i] = cell(points[3u * i], params.half_low_x) |
             (cell(points[3u * i + 1u], params.half_low_y) << 1u) |
             (cell(points[3u * i + 2u], params.half_low_z) << 2u);
}

@compute @workgroup_size(64)
fn neighbours_chunks(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) size: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let chunk = (group.y * size.x + group.x) * 64u + thread;
  if (chunk >= params.chunks) { return; }
  var low = vec3<f32>(infinite());
  var high = -low;
  for (var i = chunk * kChunk; i < min((chunk + 1u) * kChunk, params.n); i++) {
    let from_ = 3u * order[i];
    let point = vec3<f32>(points[from_], points[from_ + 1u], points[from_ + 2u]);
    low = min(low, point);
    high = max(high, point);
    for (var c = 0u; c < 3u; c++) { ordered[3u * i + c] = point[c]; }
  }
  for (var c = 0u; c < 3u; c++) {
    chunk_boxes[6u * chunk + c] = low[c];
    chunk_boxes[6u * chunk + 3u + c] = high[c];
  }
}

@compute @workgroup_size(64)
fn neighbours_groups(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) size: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let index = (group.y * size.x + group.x) * 64u + thread;
  if (index >= params.groups) { return; }
  for (var c = 0u; c < 3u; c++) {
    var low = infinite();
    var high = -low;
    for (var i = index * kChunk; i < min((index + 1u) * kChunk, params.chunks); i++) {
      low = min(low, chunk_boxes[6u * i + c]);
      high = max(high, chunk_boxes[6u * i + 3u + c]);
    }
    group_boxes[6u * index + c] = low;
    group_boxes[6u * index + 3u + c] = high;
  }
}

fn ordered_point(i: u32) -> vec3<f32> {
  return vec3<f32>(ordered[3u * i], ordered[3u * i + 1u], ordered[3u * i + 2u]);
}

fn squared(d: vec3<f32>) -> f32 {
  return d.x * d.x + d.y * d.y + d.z * d.z;
}

fn gap(low: f32, high: f32, x: f32) -> f32 {
  return max(max(low - x, x - high), 0.0);
}

fn away_from_chunk(i: u32, p: vec3<f32>) -> f32 {
  let b = 6u * i;
  return squared(vec3<f32>(gap(chunk_boxes[b], chunk_boxes[b + 3u], p.x),
                           gap(chunk_boxes[b + 1u], chunk_boxes[b + 4u], p.y),
                           gap(chunk_boxes[b + 2u], chunk_boxes[b + 5u], p.z)));
}

fn away_from_group(i: u32, p: vec3<f32>) -> f32 {
  let b = 6u * i;
  return squared(vec3<f32>(gap(group_boxes[b], group_boxes[b + 3u], p.x),
                           gap(group_boxes[b + 1u], group_boxes[b + 4u], p.y),
                           gap(group_boxes[b + 2u], group_boxes[b + 5u], p.z)));
}

fn visit(chunk: u32, query: u32, p: vec3<f32>) {
  for (var i = chunk * kChunk; i < min((chunk + 1u) * kChunk, params.n); i++) {
    if (i == query) { continue; }
    let distance = squared(p - ordered_point(i));
    if (!(distance < best[params.k - 1u])) { continue; }
    var at = params.k - 1u;
    while (at > 0u) {
      if (best[at - 1u] <= distance) { break; }
      best[at] = best[at - 1u];
      at--;
    }
    best[at] = distance;
  }
}

@compute @workgroup_size(64)
fn neighbours_search(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) size: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let query = (group.y * size.x + group.x) * 64u + thread;
  if (query >= params.n) { return; }
  let p = ordered_point(query);
  for (var i = 0u; i < params.k; i++) { best[i] = infinite(); }
  let own = query / kChunk;
  let first = max(own, 1u) - 1u;
  let last = min(own + 1u, params.chunks - 1u);
  for (var chunk = first; chunk <= last; chunk++) { visit(chunk, query, p); }
  for (var index = 0u; index < params.groups; index++) {
    if (!(away_from_group(index, p) < best[params.k - 1u])) { continue; }
    for (var chunk = index * kChunk; chunk < min((index + 1u) * kChunk, params.chunks); chunk++) {
      if (chunk >= first && chunk <= last) { continue; }
      if (away_from_chunk(chunk, p) < best[params.k - 1u]) { visit(chunk, query, p); }
    }
  }
  for (var i = 0u; i < params.k; i++) { distances[order[query] * params.k + i] = sqrt(best[i]); }
}
