// points_in_frusta and points_in_spheres; see frusta.h. One thread per point.

struct Params {
  n: u32,
  views: u32,
  count: u32,  // of spheres
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> points: array<f32>;
@group(0) @binding(2) var<storage, read> to_image: array<f32>;  // (views, 3, 4)
@group(0) @binding(3) var<storage, read> size: array<f32>;      // (views, 2)
@group(0) @binding(4) var<storage, read> depths: array<f32>;    // (views, 2)
@group(0) @binding(5) var<storage, read> focal: array<f32>;     // (views,)
@group(0) @binding(6) var<storage, read_write> counts: array<f32>;
@group(0) @binding(7) var<storage, read_write> rates: array<f32>;
@group(0) @binding(8) var<storage, read> spheres: array<f32>;   // (count, 4)
@group(0) @binding(9) var<storage, read_write> nearest: array<f32>;

fn point_of(i: u32) -> vec3<f32> {
  return vec3<f32>(points[3u * i], points[3u * i + 1u], points[3u * i + 2u]);
}

fn along(row: u32, point: vec3<f32>) -> f32 {
  return to_image[row] * point.x + to_image[row + 1u] * point.y + to_image[row + 2u] * point.z +
         to_image[row + 3u];
}

@compute @workgroup_size(64)
fn points_in_frusta(@builtin(workgroup_id) group: vec3<u32>,
                    @builtin(num_workgroups) groups: vec3<u32>,
                    @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  if (i >= params.n) { return; }
  let point = point_of(i);
  var found = 0.0;
  var rate = 0.0;
  for (var view = 0u; view < params.views; view++) {
    let x = along(12u * view, point);
    let y = along(12u * view + 4u, point);
    let z = along(12u * view + 8u, point);
    if (z > depths[2u * view] && depths[2u * view + 1u] > z && x >= 0.0 && y >= 0.0 &&
        size[2u * view] * z > x && size[2u * view + 1u] * z > y) {
      found += 1.0;
      rate = max(rate, focal[view] / z);
    }
  }
  counts[i] = found;
  rates[i] = rate;
}

@compute @workgroup_size(64)
fn points_in_spheres(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) groups: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  if (i >= params.n) { return; }
  let point = point_of(i);
  var found = 0.0;
  var infinity = 0x7f800000u;
  var least = bitcast<f32>(infinity);
  for (var k = 0u; k < params.count; k++) {
    let away = point - vec3<f32>(spheres[4u * k], spheres[4u * k + 1u], spheres[4u * k + 2u]);
    let distance = sqrt(dot(away, away));
    if (spheres[4u * k + 3u] > distance) { found += 1.0; }
    least = select(distance, least, least < distance);  // keeps a NaN
  }
  counts[i] = found;
  nearest[i] = least;
}
