// accumulate_screen_statistics: adds the splats of a view to the statistics of density control; see
// statistic.h. One thread per splat.

struct Params {
  n: u32,
  stride: u32,
  grad_stride: u32,
  width: f32,
  height: f32,
  has_max_radii: u32,
  has_valid: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> ids: array<i32>;
@group(0) @binding(2) var<storage, read> packed: array<f32>;
@group(0) @binding(3) var<storage, read> grad_means: array<f32>;
@group(0) @binding(4) var<storage, read_write> norm_sum: array<f32>;
@group(0) @binding(5) var<storage, read_write> views: array<f32>;
@group(0) @binding(6) var<storage, read_write> max_radii: array<f32>;
@group(0) @binding(7) var<storage, read> valid: array<u32>;  // (1,) bool

@compute @workgroup_size(64)
fn accumulate_screen_statistics(@builtin(workgroup_id) group: vec3<u32>,
                                @builtin(num_workgroups) groups: vec3<u32>,
                                @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  if (i >= params.n || (params.has_valid != 0u && (valid[0] & 255u) == 0u)) { return; }
  let row = ids[i];
  if (row < 0) { return; }
  let x = grad_means[i * params.grad_stride] * (0.5 * params.width);
  let y = grad_means[i * params.grad_stride + 1u] * (0.5 * params.height);
  let norm = sqrt(x * x + y * y);
  if ((bitcast<u32>(norm) & 0x7f800000u) == 0x7f800000u) { return; }
  norm_sum[row] += norm;
  views[row] += 1.0;
  if (params.has_max_radii != 0u) {
    max_radii[row] = max(packed[i * params.stride + 7u], max_radii[row]);
  }
}
