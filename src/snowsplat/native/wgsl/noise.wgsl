// add_noise: random displacements of the means along their covariances; see noise.h, which has the
// same random numbers. One thread per Gaussian.

struct Params {
  n: u32,
  amount: f32,
  sharpness: f32,
  opacity: f32,
  negligible: f32,
  seed_low: u32,
  seed_high: u32,
  first_low: u32,
  first_high: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> means: array<f32>;
@group(0) @binding(2) var<storage, read> log_scales: array<f32>;
@group(0) @binding(3) var<storage, read> quats: array<f32>;
@group(0) @binding(4) var<storage, read> opacity_logits: array<f32>;

const kMaxLogVariance = 40.0;

// The upper 32 bits of a product.
fn high_of_product(a: u32, b: u32) -> u32 {
  let al = a & 0xffffu;
  let ah = a >> 16u;
  let bl = b & 0xffffu;
  let bh = b >> 16u;
  let middle = ah * bl + ((al * bl) >> 16u);
  let lower = al * bh + (middle & 0xffffu);
  return ah * bh + (middle >> 16u) + (lower >> 16u);
}

// Philox 4x32-10 (Salmon et al. 2011), with the key `seed` and the counter first + i.
fn random_bits(i: u32) -> vec4<u32> {
  let low = params.first_low + i;
  var c = vec4<u32>(low, params.first_high + select(0u, 1u, low < i), 0u, 0u);
  var key = vec2<u32>(params.seed_low, params.seed_high);
  for (var round = 0; round < 10; round++) {
    c = vec4<u32>(high_of_product(0xCD9E8D57u, c.z) ^ c.y ^ key.x, 0xCD9E8D57u * c.z,
                  high_of_product(0xD2511F53u, c.x) ^ c.w ^ key.y, 0xD2511F53u * c.x);
    key += vec2<u32>(0x9E3779B9u, 0xBB67AE85u);
  }
  return c;
}

// Two samples of N(0, 1) (Box and Muller 1958).
fn normal_samples(bits0: u32, bits1: u32) -> vec2<f32> {
  let unit = 1.0 / 4294967296.0;
  let radius = sqrt(-2.0 * log((f32(bits0) + 0.5) * unit));
  let angle = 6.283185307179586 * (f32(bits1) * unit);
  return radius * vec2<f32>(cos(angle), sin(angle));
}

@compute @workgroup_size(64)
fn add_noise(@builtin(workgroup_id) group: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  if (i >= params.n) { return; }
  let opacity = 1.0 / (1.0 + exp(-opacity_logits[i]));
  let gate = 1.0 / (1.0 + exp(params.sharpness * (opacity - params.opacity)));
  if (!(gate > params.negligible)) { return; }
  let bits = random_bits(i);
  let eta = vec3<f32>(normal_samples(bits.x, bits.y), normal_samples(bits.z, bits.w).x);
  let given = vec4<f32>(quats[4u * i], quats[4u * i + 1u], quats[4u * i + 2u], quats[4u * i + 3u]);
  let q = given / sqrt(dot(given, given) + 1e-24);
  // The columns of R.
  let rotation = array<vec3<f32>, 3>(
    vec3(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w), 2.0 * (q.y * q.w - q.x * q.z)),
    vec3(2.0 * (q.y * q.z - q.x * q.w), 1.0 - 2.0 * (q.y * q.y + q.w * q.w), 2.0 * (q.z * q.w + q.x * q.y)),
    vec3(2.0 * (q.y * q.w + q.x * q.z), 2.0 * (q.z * q.w - q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z)));
  var noise = vec3<f32>(0.0);
  for (var k = 0u; k < 3u; k++) {
    let log_variance = 2.0 * log_scales[3u * i + k];
    let variance = exp(select(log_variance, kMaxLogVariance, log_variance > kMaxLogVariance));
    noise += rotation[k] * (variance * dot(rotation[k], eta));
  }
  noise *= params.amount * gate;
  let mean = vec3<f32>(means[3u * i], means[3u * i + 1u], means[3u * i + 2u]) + noise;
  if ((bitcast<u32>(mean.x + mean.y + mean.z) & 0x7f800000u) == 0x7f800000u) { return; }
  for (var k = 0u; k < 3u; k++) { means[3u * i + k] = mean[k]; }
}
