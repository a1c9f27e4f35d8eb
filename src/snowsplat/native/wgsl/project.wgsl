// project: the Gaussians that a camera sees (project_cull), their 2D splats (project_fwd_*), and the
// gradients of the parameters from those of the splats (project_bwd_*). The mathematics is that of
// projection.h and sh.h, which have the derivations.
//
// An entry may bind eight buffers. So the geometry (_shape) and the colours (_color) of a row are
// separate entries. The gradients of a row are in `rows` first: means 0-2, log_scales 3-5, quats 6-9,
// opacity_logits 10, sh_dc 11-13, then sh_rest; project_bwd_add adds a part of them to a tensor.
struct Params {
  n: u32,
  first: u32,  // the splats from this one on: `rows` may be too small for all
  gaussians_sh_rest_rows: u32,
  gaussians_sh_degree: u32,
  gaussians_sh_dc_rows: u32,
  camera_width: f32,
  camera_height: f32,
  camera_fx: f32,
  camera_fy: f32,
  camera_cx: f32,
  camera_cy: f32,
  camera_near: f32,
  camera_antialiased: u32,
  column: u32,   // project_bwd_add: the first column in `rows`,
  columns: u32,  // the number of them; 0: those of sh_rest,
  stride: u32,   // and the row stride of `grad`; 0: that of sh_dc or sh_rest
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> gaussians_means: array<f32>;
@group(0) @binding(2) var<storage, read> gaussians_log_scales: array<f32>;
@group(0) @binding(3) var<storage, read> gaussians_quats: array<f32>;
@group(0) @binding(4) var<storage, read> gaussians_opacity_logits: array<f32>;
@group(0) @binding(5) var<storage, read> gaussians_sh_dc: array<f32>;
@group(0) @binding(6) var<storage, read> gaussians_sh_rest: array<f32>;
@group(0) @binding(7) var<storage, read> camera_cam_from_world: array<f32>;
@group(0) @binding(8) var<storage, read_write> ids: array<i32>;
@group(0) @binding(9) var<storage, read_write> packed: array<f32>;
@group(0) @binding(10) var<storage, read> grad_packed: array<f32>;
@group(0) @binding(11) var<storage, read_write> rows: array<f32>;
@group(0) @binding(12) var<storage, read_write> grad: array<f32>;

const kPackedStride = 16u;
const kPackedHeader = 8u;
const kLog2MinAlpha = -7.994353436858858;
const kLn2 = 0.6931471805599453;

fn item(group: vec3<u32>, groups: vec3<u32>, thread: u32) -> u32 {
  return (group.y * groups.x + group.x) * 64u + thread;
}

// By its bits, because a driver may assume that there are no other numbers.
fn is_finite(x: f32) -> bool {
  return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}

// ---- Geometry -----------------------------------------------------------------------------------

struct Projected {
  z: f32, inv_z: f32,
  u: f32, v: f32,    // x/z and y/z
  tx: f32, ty: f32,  // the same, clamped
  free_x: bool, free_y: bool,
  scale: vec3<f32>,
  quat: vec4<f32>,  // normalised, wxyz
  inv_quat_norm: f32,
  m0: vec3<f32>, m1: vec3<f32>, m2: vec3<f32>,  // rows of M
  t0: vec3<f32>, t1: vec3<f32>,                 // of T
  u0: vec3<f32>, u1: vec3<f32>,                 // of U
  normal: vec3<f32>,
  cov_xx: f32, cov_xy: f32, cov_yy: f32,
  inv_det: f32, undilated_det: f32,
  mean2d: vec2<f32>,
  conic: vec3<f32>,
  activated_opacity: f32, opacity: f32,
}

// A row of the rotation of the camera.
fn rotation_row(k: u32) -> vec3<f32> {
  return vec3(camera_cam_from_world[4 * k], camera_cam_from_world[4 * k + 1],
              camera_cam_from_world[4 * k + 2]);
}

fn mean_of(id: u32) -> vec3<f32> {
  return vec3(gaussians_means[3 * id], gaussians_means[3 * id + 1], gaussians_means[3 * id + 2]);
}

fn dilation() -> f32 {
  return select(0.3, 0.1, params.camera_antialiased != 0);
}

fn project_gaussian(id: u32) -> Projected {
  var p: Projected;
  let w0 = rotation_row(0);
  let w1 = rotation_row(1);
  let w2 = rotation_row(2);
  let mean = mean_of(id);
  let x = dot(w0, mean) + camera_cam_from_world[3];
  let y = dot(w1, mean) + camera_cam_from_world[7];
  p.z = dot(w2, mean) + camera_cam_from_world[11];
  p.inv_z = 1.0 / p.z;

  let q = vec4(gaussians_quats[4 * id], gaussians_quats[4 * id + 1], gaussians_quats[4 * id + 2],
               gaussians_quats[4 * id + 3]);
  p.inv_quat_norm = 1.0 / sqrt(dot(q, q) + 1e-24);
  p.quat = q * p.inv_quat_norm;
  let r = p.quat.x;
  let i = p.quat.y;
  let j = p.quat.z;
  let k = p.quat.w;
  p.scale = exp(vec3(gaussians_log_scales[3 * id], gaussians_log_scales[3 * id + 1],
                     gaussians_log_scales[3 * id + 2]));
  p.m0 = vec3(1 - 2 * (j * j + k * k), 2 * (i * j - r * k), 2 * (i * k + r * j)) * p.scale;
  p.m1 = vec3(2 * (i * j + r * k), 1 - 2 * (i * i + k * k), 2 * (j * k - r * i)) * p.scale;
  p.m2 = vec3(2 * (i * k - r * j), 2 * (j * k + r * i), 1 - 2 * (i * i + j * j)) * p.scale;

  // J is evaluated at most 15% outside of the image.
  let beyond_x = 0.15 * params.camera_width;
  let beyond_y = 0.15 * params.camera_height;
  let min_tx = -(params.camera_cx + beyond_x) / params.camera_fx;
  let max_tx = (params.camera_width - params.camera_cx + beyond_x) / params.camera_fx;
  let min_ty = -(params.camera_cy + beyond_y) / params.camera_fy;
  let max_ty = (params.camera_height - params.camera_cy + beyond_y) / params.camera_fy;
  p.u = x * p.inv_z;
  p.v = y * p.inv_z;
  p.tx = min(max(p.u, min_tx), max_tx);
  p.ty = min(max(p.v, min_ty), max_ty);
  p.free_x = p.u >= min_tx && max_tx >= p.u;
  p.free_y = p.v >= min_ty && max_ty >= p.v;
  let j00 = params.camera_fx * p.inv_z;
  let j11 = params.camera_fy * p.inv_z;
  p.t0 = j00 * w0 - (j00 * p.tx) * w2;
  p.t1 = j11 * w1 - (j11 * p.ty) * w2;
  p.u0 = p.t0.x * p.m0 + p.t0.y * p.m1 + p.t0.z * p.m2;
  p.u1 = p.t1.x * p.m0 + p.t1.y * p.m1 + p.t1.z * p.m2;
  let d = dilation();
  p.cov_xx = dot(p.u0, p.u0) + d;
  p.cov_xy = dot(p.u0, p.u1);
  p.cov_yy = dot(p.u1, p.u1) + d;
  p.normal = cross(p.u0, p.u1);
  p.undilated_det = dot(p.normal, p.normal);
  p.inv_det = 1.0 / (p.undilated_det + d * (p.cov_xx + p.cov_yy - d));
  p.conic = vec3(p.cov_yy, -p.cov_xy, p.cov_xx) * p.inv_det;
  p.mean2d = vec2(params.camera_fx * p.u + params.camera_cx,
                  params.camera_fy * p.v + params.camera_cy);
  // The limit only keeps exp() finite: a smaller logit is far below 1/255, too.
  p.activated_opacity = 1.0 / (1.0 + exp(min(-gaussians_opacity_logits[id], 80.0)));
  p.opacity = p.activated_opacity;
  if (params.camera_antialiased != 0) {
    p.opacity *= sqrt(p.undilated_det * p.inv_det);
  }
  return p;
}

fn is_visible(p: Projected) -> bool {
  if (!(p.z > params.camera_near && p.inv_det > 0 && p.opacity > 0)) {
    return false;
  }
  let k2 = 2 * kLn2 * (log2(p.opacity) - kLog2MinAlpha);
  let ex = sqrt(max(k2, 0) * p.cov_xx);
  let ey = sqrt(max(k2, 0) * p.cov_yy);
  return k2 >= 0 && is_finite(p.z) && is_finite(p.inv_det) && is_finite(p.opacity) &&
         is_finite(p.mean2d.x) && is_finite(p.mean2d.y) && is_finite(ex) && is_finite(ey) &&
         p.mean2d.x + ex >= 0.5 && params.camera_width - 0.5 >= p.mean2d.x - ex &&
         p.mean2d.y + ey >= 0.5 && params.camera_height - 0.5 >= p.mean2d.y - ey;
}

@compute @workgroup_size(64)
fn project_cull(@builtin(workgroup_id) group: vec3<u32>,
                @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i < params.n) {
    ids[i] = select(-1, i32(i), is_visible(project_gaussian(i)));
  }
}

@compute @workgroup_size(64)
fn project_fwd_shape(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) groups: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n) {
    return;
  }
  let row = i * kPackedStride;
  if (ids[i] < 0) {
    for (var k = 0u; k < kPackedStride; k++) {
      packed[row + k] = 0;
    }
    return;
  }
  let p = project_gaussian(u32(ids[i]));
  packed[row] = p.mean2d.x;
  packed[row + 1] = p.mean2d.y;
  packed[row + 2] = p.conic.x;
  packed[row + 3] = p.conic.y;
  packed[row + 4] = p.conic.z;
  packed[row + 5] = p.opacity;
  packed[row + 6] = p.z;
  // The square root of the larger eigenvalue of Σ', relative to `mid`, whose square could overflow.
  let mid = 0.5 * (p.cov_xx + p.cov_yy);
  let dif = 0.5 * (p.cov_xx - p.cov_yy) / mid;
  let off = p.cov_xy / mid;
  packed[row + 7] = 3 * sqrt(mid + mid * sqrt(dif * dif + off * off));
}

@compute @workgroup_size(64)
fn project_bwd_shape(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) groups: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let at = item(group, groups, thread);
  if (at >= params.n) {
    return;
  }
  let i = params.first + at;
  let row = at * row_width();
  if (ids[i] < 0) {
    for (var k = 0u; k < 11; k++) {
      rows[row + k] = 0;
    }
    return;
  }
  let id = u32(ids[i]);
  let p = project_gaussian(id);
  let start = i * kPackedStride;
  let d_mean2d = vec2(grad_packed[start], grad_packed[start + 1]);
  let ga = grad_packed[start + 2];
  let gb = 0.5 * grad_packed[start + 3];
  let gc = grad_packed[start + 4];
  let d_opacity = grad_packed[start + 5];
  let d_depth = grad_packed[start + 6];
  rows[row + 10] = d_opacity * p.opacity * (1 - p.activated_opacity);

  let d = dilation();
  let x0 = cross(p.u1, p.normal);
  let x1 = cross(p.normal, p.u0);
  let v0 = (d * p.u0 + x0) * p.inv_det;
  let v1 = (d * p.u1 + x1) * p.inv_det;
  var g0 = -2 * (ga * v0 + gb * v1);
  var g1 = -2 * (gb * v0 + gc * v1);
  if (params.camera_antialiased != 0) {
    let gain = d_opacity * p.opacity * d / p.undilated_det;
    g0 += gain * x0;
    g1 += gain * x1;
  }
  let d_u0 = p.conic.x * g0 + p.conic.y * g1;
  let d_u1 = p.conic.y * g0 + p.conic.z * g1;
  let d_log_scale = v0 * g0 + v1 * g1;
  let d_t0 = vec3(dot(d_u0, p.m0), dot(d_u0, p.m1), dot(d_u0, p.m2));
  let d_t1 = vec3(dot(d_u1, p.m0), dot(d_u1, p.m1), dot(d_u1, p.m2));

  let w0 = rotation_row(0);
  let w1 = rotation_row(1);
  let w2 = rotation_row(2);
  let dj00 = dot(d_t0, w0);
  let dj02 = dot(d_t0, w2);
  let dj11 = dot(d_t1, w1);
  let dj12 = dot(d_t1, w2);
  let fx = params.camera_fx;
  let fy = params.camera_fy;
  let du = fx * d_mean2d.x - select(0.0, dj02 * fx * p.inv_z, p.free_x);
  let dv = fy * d_mean2d.y - select(0.0, dj12 * fy * p.inv_z, p.free_y);
  let d_inv_z = dj00 * fx + dj11 * fy - dj02 * fx * p.tx - dj12 * fy * p.ty;
  let dz = d_depth - p.inv_z * (du * p.u + dv * p.v + d_inv_z * p.inv_z);
  let d_mean = w0 * (du * p.inv_z) + w1 * (dv * p.inv_z) + w2 * dz;

  // The rows of ∂L/∂R, where M = R S, then the normalised quaternion.
  let r0 = (p.t0.x * d_u0 + p.t1.x * d_u1) * p.scale;
  let r1 = (p.t0.y * d_u0 + p.t1.y * d_u1) * p.scale;
  let r2 = (p.t0.z * d_u0 + p.t1.z * d_u1) * p.scale;
  let w = p.quat.x;
  let x = p.quat.y;
  let y = p.quat.z;
  let z = p.quat.w;
  let dq = 2 * vec4(x * (r2.y - r1.z) + y * (r0.z - r2.x) + z * (r1.x - r0.y),
                    y * (r0.y + r1.x) + z * (r0.z + r2.x) + w * (r2.y - r1.z) -
                        2 * x * (r1.y + r2.z),
                    x * (r0.y + r1.x) + z * (r1.z + r2.y) + w * (r0.z - r2.x) -
                        2 * y * (r0.x + r2.z),
                    x * (r0.z + r2.x) + y * (r1.z + r2.y) + w * (r1.x - r0.y) -
                        2 * z * (r0.x + r1.y));
  let d_quat = (dq - dot(dq, p.quat) * p.quat) * p.inv_quat_norm;
  for (var k = 0u; k < 3; k++) {
    rows[row + k] = d_mean[k];
    rows[row + 3 + k] = d_log_scale[k];
  }
  for (var k = 0u; k < 4; k++) {
    rows[row + 6 + k] = d_quat[k];
  }
}

// ---- Colours ------------------------------------------------------------------------------------

const kSH0 = 0.28209479177387814;
const kSH1 = 0.4886025119029199;
const kSH2 = array<f32, 5>(1.0925484305920792, -1.0925484305920792, 0.31539156525252005,
                           -1.0925484305920792, 0.5462742152960396);
const kSH3 = array<f32, 7>(-0.5900435899266435, 2.890611442640554, -0.4570457994644658,
                           0.3731763325901154, -0.4570457994644658, 1.445305721320277,
                           -0.5900435899266435);

fn coefficients() -> u32 {
  return (params.gaussians_sh_degree + 1) * (params.gaussians_sh_degree + 1);
}

fn row_width() -> u32 {
  return 11 + 3 * coefficients();
}

fn sh_basis(v: vec3<f32>) -> array<f32, 16> {
  let x = v.x;
  let y = v.y;
  let z = v.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  return array<f32, 16>(
    kSH0, -kSH1 * y, kSH1 * z, -kSH1 * x,
    kSH2[0] * x * y, kSH2[1] * y * z, kSH2[2] * (2 * zz - xx - yy), kSH2[3] * x * z,
    kSH2[4] * (xx - yy),
    kSH3[0] * y * (3 * xx - yy), kSH3[1] * x * y * z, kSH3[2] * y * (4 * zz - xx - yy),
    kSH3[3] * z * (2 * zz - 3 * xx - 3 * yy), kSH3[4] * x * (4 * zz - xx - yy),
    kSH3[5] * z * (xx - yy), kSH3[6] * x * (xx - 3 * yy));
}

// The gradient of Σ d_k Y_k with respect to x, y and z as independent variables; d_k = 0 beyond the
// degree.
fn sh_basis_vjp(v: vec3<f32>, d: array<f32, 16>) -> vec3<f32> {
  let x = v.x;
  let y = v.y;
  let z = v.z;
  let xx = x * x;
  let yy = y * y;
  let zz = z * z;
  let xy = x * y;
  let yz = y * z;
  let xz = x * z;
  var g = vec3(-kSH1 * d[3], -kSH1 * d[1], kSH1 * d[2]);
  g += vec3(kSH2[0] * y * d[4] - 2 * kSH2[2] * x * d[6] + kSH2[3] * z * d[7] +
                2 * kSH2[4] * x * d[8],
            kSH2[0] * x * d[4] + kSH2[1] * z * d[5] - 2 * kSH2[2] * y * d[6] -
                2 * kSH2[4] * y * d[8],
            kSH2[1] * y * d[5] + 4 * kSH2[2] * z * d[6] + kSH2[3] * x * d[7]);
  g += vec3(6 * kSH3[0] * xy * d[9] + kSH3[1] * yz * d[10] - 2 * kSH3[2] * xy * d[11] -
                6 * kSH3[3] * xz * d[12] + kSH3[4] * (4 * zz - 3 * xx - yy) * d[13] +
                2 * kSH3[5] * xz * d[14] + 3 * kSH3[6] * (xx - yy) * d[15],
            3 * kSH3[0] * (xx - yy) * d[9] + kSH3[1] * xz * d[10] +
                kSH3[2] * (4 * zz - xx - 3 * yy) * d[11] - 6 * kSH3[3] * yz * d[12] -
                2 * kSH3[4] * xy * d[13] - 2 * kSH3[5] * yz * d[14] - 6 * kSH3[6] * xy * d[15],
            kSH3[1] * xy * d[10] + 8 * kSH3[2] * yz * d[11] +
                3 * kSH3[3] * (2 * zz - xx - yy) * d[12] + 8 * kSH3[4] * xz * d[13] +
                kSH3[5] * (xx - yy) * d[14]);
  return g;
}

// The vector from the camera to a mean.
fn view_vector(id: u32) -> vec3<f32> {
  let t = vec3(camera_cam_from_world[3], camera_cam_from_world[7], camera_cam_from_world[11]);
  let position = -(rotation_row(0) * t.x + rotation_row(1) * t.y + rotation_row(2) * t.z);
  return mean_of(id) - position;
}

fn rest_of(id: u32, k: u32) -> vec3<f32> {
  let start = 3 * (params.gaussians_sh_rest_rows * id + k - 1);
  return vec3(gaussians_sh_rest[start], gaussians_sh_rest[start + 1], gaussians_sh_rest[start + 2]);
}

fn sh_color(id: u32, basis: array<f32, 16>) -> vec3<f32> {
  let start = 3 * params.gaussians_sh_dc_rows * id;
  let dc = vec3(gaussians_sh_dc[start], gaussians_sh_dc[start + 1], gaussians_sh_dc[start + 2]);
  var y = basis;
  var color = 0.5 + y[0] * dc;
  for (var k = 1u; k < coefficients(); k++) {
    color += y[k] * rest_of(id, k);
  }
  return color;
}

@compute @workgroup_size(64)
fn project_fwd_color(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) groups: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let i = item(group, groups, thread);
  if (i >= params.n || ids[i] < 0) {
    return;
  }
  let id = u32(ids[i]);
  let color = max(sh_color(id, sh_basis(normalize(view_vector(id)))), vec3(0.0));
  let at = i * kPackedStride + kPackedHeader;
  for (var k = 0u; k < 3; k++) {
    packed[at + k] = color[k];
  }
  for (var k = 3u; k < kPackedStride - kPackedHeader; k++) {
    packed[at + k] = 0;
  }
}

// After project_bwd_shape, to whose gradient of the mean it adds.
@compute @workgroup_size(64)
fn project_bwd_color(@builtin(workgroup_id) group: vec3<u32>,
                     @builtin(num_workgroups) groups: vec3<u32>,
                     @builtin(local_invocation_index) thread: u32) {
  let at = item(group, groups, thread);
  if (at >= params.n) {
    return;
  }
  let i = params.first + at;
  let row = at * row_width();
  if (ids[i] < 0) {
    for (var k = 11u; k < row_width(); k++) {
      rows[row + k] = 0;
    }
    return;
  }
  let id = u32(ids[i]);
  let start = i * kPackedStride + kPackedHeader;
  let v = view_vector(id);
  let inv_length = 1.0 / sqrt(dot(v, v));
  let direction = v * inv_length;
  var y = sh_basis(direction);
  let color = sh_color(id, y);
  let given = vec3(grad_packed[start], grad_packed[start + 1], grad_packed[start + 2]);
  let d_color = select(vec3(0.0), given, color >= vec3(0.0));
  var d: array<f32, 16>;
  for (var k = 0u; k < coefficients(); k++) {
    let d_coefficient = y[k] * d_color;
    for (var c = 0u; c < 3; c++) {
      rows[row + 11 + 3 * k + c] = d_coefficient[c];
    }
    if (k > 0) {
      d[k] = dot(rest_of(id, k), d_color);
    }
  }
  let g = sh_basis_vjp(direction, d);
  let d_mean = (g - dot(g, direction) * direction) * inv_length;
  for (var k = 0u; k < 3; k++) {
    rows[row + k] += d_mean[k];
  }
}

// Adds some columns of `rows` to the rows of a tensor.
@compute @workgroup_size(64)
fn project_bwd_add(@builtin(workgroup_id) group: vec3<u32>,
                   @builtin(num_workgroups) groups: vec3<u32>,
                   @builtin(local_invocation_index) thread: u32) {
  let at = item(group, groups, thread);
  if (at >= params.n || ids[params.first + at] < 0) {
    return;
  }
  let id = u32(ids[params.first + at]);
  var columns = params.columns;
  var stride = params.stride;
  if (params.column == 11) {
    stride = 3 * params.gaussians_sh_dc_rows;
  }
  if (params.column == 14) {
    columns = 3 * (coefficients() - 1);
    stride = 3 * params.gaussians_sh_rest_rows;
  }
  for (var k = 0u; k < columns; k++) {
    grad[id * stride + k] += rows[at * row_width() + params.column + k];
  }
}
