// What only the page needs: whether the memory of a frame suffices, and its image on the canvas.
struct Params {
  capacity: u32,
  width: u32,
  height: u32,
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read> required: array<u32>;
@group(0) @binding(2) var<storage, read_write> valid: array<u32>;
@group(0) @binding(3) var<storage, read> image: array<f32>;        // (3, height, width)
@group(0) @binding(4) var<storage, read_write> pixels: array<u32>;  // (height, width), 4 bytes

@compute @workgroup_size(1)
fn check_capacity() {
  valid[0] = select(0u, 1u, required[0] <= params.capacity);
}

@compute @workgroup_size(64)
fn show(@builtin(workgroup_id) group: vec3<u32>,
        @builtin(num_workgroups) groups: vec3<u32>,
        @builtin(local_invocation_index) thread: u32) {
  let i = (group.y * groups.x + group.x) * 64u + thread;
  let size = params.width * params.height;
  if (i < size) {
    pixels[i] = pack4x8unorm(vec4(image[i], image[size + i], image[2 * size + i], 1.0));
  }
}
