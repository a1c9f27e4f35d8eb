// adam_step for one of the six parameters of the Gaussians; the rule is that of adam.h. The gradients
// of the parameters come from `rows`, which project_bwd_shape and project_bwd_color have written.
//
// A work group updates 64 Gaussians: its threads take the values in the order of their addresses.

struct Params {
  n: u32,        // Gaussians
  first: u32,    // the splat of the first of `rows`
  count: u32,    // of `rows`
  width: u32,    // columns of `rows`
  column: u32,   // the first column of this parameter
  columns: u32,  // of this parameter that are in use
  stride: u32,   // of the parameter
  index: u32,    // of the parameter, for nonfinite_rows
  rate: f32,     // lr / (1 − β₁ᵗ)
  beta1: f32,
  gain1: f32,    // 1 − β₁
  beta2: f32,
  gain2: f32,    // 1 − β₂
  inv_correction2: f32,
  eps2: f32,
  visible_only: u32,
  splats: u32,   // adam_splat_of: splats
  has_extra: u32,
  has_valid: u32,
  has_nonfinite_rows: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> splat_of: array<i32>;  // (n,) the splat or −1
@group(0) @binding(2) var<storage, read> rows: array<f32>;      // (count, width)
@group(0) @binding(3) var<storage, read_write> value: array<f32>;
@group(0) @binding(4) var<storage, read_write> m: array<f32>;
@group(0) @binding(5) var<storage, read_write> v: array<f32>;
@group(0) @binding(6) var<storage, read> extra: array<f32>;
@group(0) @binding(7) var<storage, read> valid: array<u32>;  // (1,) bool
@group(0) @binding(8) var<storage, read_write> nonfinite_rows: array<atomic<i32>>;
@group(0) @binding(9) var<storage, read> ids: array<i32>;              // adam_splat_of: (splats,)
@group(0) @binding(10) var<storage, read_write> found: array<atomic<i32>>;  // adam_splat_of: (n,)

const kRows = 64u;
const kUnseen = -1;
const kNotUpdated = -2;

var<workgroup> row_of: array<i32, 64>;  // in `rows`, or one of the two values above
var<workgroup> skipped: array<atomic<u32>, 64>;

fn is_finite(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// The row of a Gaussian. Those without a splat are updated together with the first rows.
fn find_row(i: u32) -> i32 {
  if (i >= params.n) { return kNotUpdated; }
  let splat = splat_of[i];
  if (splat < 0) {
    return select(kUnseen, kNotUpdated, params.visible_only != 0u || params.first != 0u);
  }
  if (params.width == 0u) { return select(kUnseen, kNotUpdated, params.first != 0u); }
  let row = splat - i32(params.first);
  return select(kNotUpdated, row, row >= 0 && row < i32(params.count));
}

@compute @workgroup_size(64)
fn adam_update(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
  let first = (group.y * groups.x + group.x) * kRows;
  row_of[thread] = find_row(first + thread);
  atomicStore(&skipped[thread], 0u);
  workgroupBarrier();
  let is_valid = params.has_valid == 0u || (valid[0] & 255u) != 0u;
  if (is_valid) {
    for (var i = thread; i < kRows * params.columns; i += kRows) {
      let local = i / params.columns;
      let column = i - local * params.columns;
      let row = row_of[local];
      if (row == kNotUpdated) { continue; }
      let at = (first + local) * params.stride + column;
      var g = 0.0;
      if (params.has_extra != 0u) { g = extra[at]; }
      if (row >= 0) { g += rows[u32(row) * params.width + params.column + column]; }
      let new_m = params.beta1 * m[at] + params.gain1 * g;
      let new_v = params.beta2 * v[at] + params.gain2 * g * g;
      let root = sqrt(new_v * params.inv_correction2 + params.eps2);
      let new_value = value[at] - params.rate * new_m / root;
      if (is_finite(new_v) && is_finite(new_value)) {
        m[at] = new_m;
        v[at] = new_v;
        value[at] = new_value;
      } else {
        atomicStore(&skipped[local], 1u);
      }
    }
  }
  workgroupBarrier();
  if (params.has_nonfinite_rows != 0u && atomicLoad(&skipped[thread]) != 0u) {
    atomicAdd(&nonfinite_rows[params.index], 1);
  }
}

// The splat of each Gaussian, if the rows of the splats are compacted. `found` is −1 before.
@compute @workgroup_size(64)
fn adam_splat_of(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * kRows + thread;
  if (i >= params.splats) { return; }
  let id = ids[i];
  if (id >= 0 && id < i32(params.n)) { atomicStore(&found[id], i32(i)); }
}
