// From splats to a depth-sorted list of splats for each tile of 16×16 pixels, and back:
//   splats_prepare   depth keys; a sort by them follows (sort.wgsl)
//   tiles_count      the number of tiles that each splat touches, in the order of depth; their prefix
//                    sum gives the first slot of each splat
//   tiles_fill       the instances (pairs of a splat and a tile) in this order; a sort by tile follows
//   tiles_gather     the splat of each instance of the sorted list
//   tiles_start      the first instance of each tile
//   splats_reduce    sums the gradients of a splat's tiles in a fixed order
// The tiles that a splat touches are those of tiles.cu: rasterize.h has the derivation. The workspace
// has a head of four numbers, of which the first is the number of instances, then the counts and the
// first slots of the splats.
struct Params {
  n: u32,
  stride: u32,
  binning_stride: u32,
  width: u32,
  height: u32,
  binning_tiles_x: u32,
  binning_tiles_y: u32,
  capacity: u32,
  channels: u32,
  add: u32,
  has_slot_range: u32,
  has_abs_grad: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> packed: array<f32>;
@group(0) @binding(2) var<storage, read_write> keys: array<u32>;
@group(0) @binding(3) var<storage, read> binning_order: array<u32>;
@group(0) @binding(4) var<storage, read_write> binning_workspace: array<u32>;
@group(0) @binding(5) var<storage, read_write> slot_splat: array<u32>;
@group(0) @binding(6) var<storage, read_write> slot_range: array<u32>;
@group(0) @binding(7) var<storage, read> instance_slot: array<u32>;
@group(0) @binding(8) var<storage, read_write> instance_splat: array<u32>;
@group(0) @binding(9) var<storage, read_write> binning_tile_start: array<u32>;
@group(0) @binding(10) var<storage, read> slots: array<f32>;
@group(0) @binding(11) var<storage, read> columns: array<i32>;  // of 64 bits each
@group(0) @binding(12) var<storage, read_write> grad_packed: array<f32>;
@group(0) @binding(13) var<storage, read_write> abs_grad: array<f32>;

const kTile = 16u;
const kLog2MinAlpha = -7.994353436858858;
const kLn2 = 0.6931471805599453;
const kLog2E = 1.4426950408889634;
const kCullSlack = 1e-3;

fn item(group: vec3<u32>, groups: vec3<u32>, thread: u32) -> u32 {
  return (group.y * groups.x + group.x) * 256u + thread;
}

fn is_finite(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

struct Splat {
  mean: vec2<f32>,
  conic: vec3<f32>,
  log2_opacity: f32,
  visible: bool,
  first: vec2<u32>,  // tile
  size: vec2<u32>,   // tiles; 0 if the splat is not visible
}

// The splat of a row, and the rectangle of tiles of its ellipse in which α ≥ 1/255.
fn splat_at(row: u32, tiles: vec2<u32>) -> Splat {
  var s: Splat;
  s.mean = vec2(packed[row], packed[row + 1]);
  s.conic = vec3(packed[row + 2], packed[row + 3], packed[row + 4]);
  let opacity = packed[row + 5];
  let det = s.conic.x * s.conic.z - s.conic.y * s.conic.y;
  if (!(opacity > 0 && det > 0 && s.conic.x > 0 && is_finite(det) && is_finite(opacity) &&
        is_finite(s.mean.x) && is_finite(s.mean.y))) {
    return s;
  }
  s.log2_opacity = log2(opacity);
  let k2 = 2 * kLn2 * (s.log2_opacity - kLog2MinAlpha);
  let reach = max(k2, 0) / det;
  let extent = vec2(sqrt(reach * s.conic.z), sqrt(reach * s.conic.x));
  let low = max(s.mean - extent - 0.5, vec2(0.0));
  let high = min(s.mean + extent - 0.5, vec2<f32>(kTile * tiles - 1));
  if (!(k2 >= 0 && high.x >= low.x && high.y >= low.y)) {
    return s;
  }
  s.first = vec2<u32>(low) / kTile;
  s.size = vec2<u32>(high) / kTile - s.first + 1;
  return s;
}

// The maximum of log₂(α / o) over the pixel centres of a tile reaches the threshold.
fn touches(s: Splat, tile: vec2<u32>) -> bool {
  let a = -0.5 * kLog2E * s.conic.x;
  let b = -kLog2E * s.conic.y;
  let c = -0.5 * kLog2E * s.conic.z;
  let low = vec2<f32>(tile * kTile) + 0.5 - s.mean;
  let high = low + f32(kTile - 1);
  let nearest = min(max(vec2(0.0), low), high);
  let x_on = min(max(-(s.conic.y / s.conic.x) * nearest.y, low.x), high.x);
  let y_on = min(max(-(s.conic.y / s.conic.z) * nearest.x, low.y), high.y);
  let on_row = (a * x_on + b * nearest.y) * x_on + c * nearest.y * nearest.y;
  let on_column = (c * y_on + b * nearest.x) * y_on + a * nearest.x * nearest.x;
  return max(on_row, on_column) >= kLog2MinAlpha - kCullSlack - s.log2_opacity;
}

@compute @workgroup_size(256)
fn splats_prepare(@builtin(workgroup_id) group: vec3<u32>,
                  @builtin(num_workgroups) groups: vec3<u32>,
                  @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n) {
    return;
  }
  let row = i * params.stride;
  let tiles = (vec2(params.width, params.height) + kTile - 1) / kTile;
  var key = 0xffffffffu;  // not visible: behind all others
  if (splat_at(row, tiles).size.x > 0) {
    let bits = bitcast<u32>(packed[row + 6]);
    key = select(bits | 0x80000000u, ~bits, (bits >> 31) != 0);
  }
  keys[i] = key;
}

fn tiles_of_image() -> vec2<u32> {
  return vec2(params.binning_tiles_x, params.binning_tiles_y);
}

@compute @workgroup_size(256)
fn tiles_count(@builtin(workgroup_id) group: vec3<u32>,
               @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n) {
    return;
  }
  let s = splat_at(binning_order[i] * params.binning_stride, tiles_of_image());
  var count = s.size.x * s.size.y;
  if (count > 1) {  // a single tile needs no test
    count = 0;
    for (var y = 0u; y < s.size.y; y++) {
      for (var x = 0u; x < s.size.x; x++) {
        count += u32(touches(s, s.first + vec2(x, y)));
      }
    }
  }
  binning_workspace[4 + i] = count;
  binning_workspace[4 + params.n + i] = count;
}

// Writes exactly the counted number of instances, up to the capacity. Two entries may round in
// different ways: if the test finds fewer tiles here, the other instances get a tile after the last
// one, and their slots do not belong to the splat.
@compute @workgroup_size(256)
fn tiles_fill(@builtin(workgroup_id) group: vec3<u32>,
              @builtin(num_workgroups) groups: vec3<u32>,
              @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n) {
    return;
  }
  let splat = binning_order[i];
  let s = splat_at(splat * params.binning_stride, tiles_of_image());
  let begin = min(binning_workspace[4 + params.n + i], params.capacity);
  let count = min(binning_workspace[4 + i], params.capacity - begin);
  var done = 0u;
  for (var y = 0u; y < s.size.y && done < count; y++) {
    for (var x = 0u; x < s.size.x && done < count; x++) {
      let tile = s.first + vec2(x, y);
      if (s.size.x * s.size.y == 1 || touches(s, tile)) {
        keys[begin + done] = tile.y * params.binning_tiles_x + tile.x;
        slot_splat[begin + done] = splat;
        done++;
      }
    }
  }
  if (params.has_slot_range != 0) {
    slot_range[2 * splat] = begin;
    slot_range[2 * splat + 1] = begin + done;
  }
  for (; done < count; done++) {
    keys[begin + done] = params.binning_tiles_x * params.binning_tiles_y;
    slot_splat[begin + done] = splat;
  }
}

@compute @workgroup_size(256)
fn tiles_gather(@builtin(workgroup_id) group: vec3<u32>,
                @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i < min(params.capacity, binning_workspace[0])) {
    instance_splat[i] = slot_splat[instance_slot[i]];
  }
}

@compute @workgroup_size(256)
fn tiles_start(@builtin(workgroup_id) group: vec3<u32>,
               @builtin(num_workgroups) groups: vec3<u32>,
               @builtin(local_invocation_index) thread: u32) {
  let tile = item(group, groups, thread);
  if (tile > params.binning_tiles_x * params.binning_tiles_y) {
    return;
  }
  var low = 0u;
  var high = min(params.capacity, binning_workspace[0]);
  while (low < high) {
    let middle = (low + high) / 2;
    if (keys[middle] < tile) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  binning_tile_start[tile] = low;
}

// One thread per splat: the sums of the columns of its slots, three or four colours and six moments.
@compute @workgroup_size(64)
fn splats_reduce(@builtin(workgroup_id) group: vec3<u32>,
                 @builtin(num_workgroups) groups: vec3<u32>,
                 @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64 + thread;
  if (i >= params.n) {
    return;
  }
  let begin = slot_range[2 * i];
  let end = slot_range[2 * i + 1];
  if (params.add != 0 && begin == end) {
    return;
  }
  let row = i * params.stride;
  let conic = vec3(packed[row + 2], packed[row + 3], packed[row + 4]);
  let q = select(4u, 3u, params.channels <= 3);  // the column of the first moment
  var sums = array<f32, 10>();
  var abs_sum = vec2(0.0);
  for (var s = begin; s < end; s++) {
    for (var k = 0u; k < q + 6; k++) {
      sums[k] += slots[16 * s + k];
    }
    let moments = vec2(slots[16 * s + q + 1], slots[16 * s + q + 2]);
    abs_sum += abs(vec2(dot(conic.xy, moments), dot(conic.yz, moments)));
  }
  if (params.has_abs_grad != 0) {
    abs_grad[2 * i] += abs_sum.x;
    abs_grad[2 * i + 1] += abs_sum.y;
  }
  var geometry = array<f32, 6>();
  if (begin < end) {
    let moments = vec2(sums[q + 1], sums[q + 2]);
    geometry = array<f32, 6>(dot(conic.xy, moments), dot(conic.yz, moments), -0.5 * sums[q + 3],
                             -sums[q + 4], -0.5 * sums[q + 5], sums[q] / packed[row + 5]);
  }
  for (var column = 0u; column < params.stride; column++) {
    var value = 0.0;
    if (params.add != 0) {
      value = grad_packed[row + column];
    }
    if (column < 6) {
      value += geometry[column];
    }
    for (var k = 0u; k < params.channels; k++) {
      if (i32(column) == columns[2 * k]) {
        value += sums[k];
      }
    }
    grad_packed[row + column] = value;
  }
}
