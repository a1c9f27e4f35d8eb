// Prefix sums and a stable radix sort of 32-bit keys with 32-bit values. No workgroup waits for
// another one, and nothing depends on the size of a subgroup; so each step that needs the results of
// all workgroups is an entry of its own:
//
//   scan_sums, scan_blocks, scan_apply      an exclusive prefix sum, in place
//   sort_count, sort_offsets, sort_scatter  one pass of the sort, by a digit of 8 bits
struct Params {
  n: u32,          // items; of the sort: pairs that memory is allocated for
  scan_first: u32,  // scans: the index of the first item in `scan`, divided by n, after a head of 4
  shift: u32,      // sort: the first bit of the digit
  rows: u32,       // sort: 1: the values are the indices of the pairs; `values` is not read
  has_count: u32,  // sort: 1: count[0] is the number of pairs, if that is less than n
}

@group(0) @binding(0) var<uniform> params: Params;
@group(0) @binding(1) var<storage, read_write> scan: array<u32>;
@group(0) @binding(2) var<storage, read_write> sums: array<u32>;   // (workgroups,)
@group(0) @binding(3) var<storage, read_write> total: array<u32>;  // one number of 64 bits
@group(0) @binding(4) var<storage, read> keys: array<u32>;
@group(0) @binding(5) var<storage, read> values: array<u32>;
@group(0) @binding(6) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(7) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(8) var<storage, read_write> counts: array<u32>;  // (256, workgroups)
@group(0) @binding(9) var<storage, read_write> totals: array<u32>;  // (256,)
@group(0) @binding(10) var<storage, read> count: array<u32>;

const kThreads = 256u;
const kItems = 4u;
const kBlock = kThreads * kItems;

// ---- Sums ---------------------------------------------------------------------------------------

// A sum that does not fit into 32 bits is 2^32 - 1, which is larger than any capacity.
fn add(a: u32, b: u32) -> u32 {
  return select(a + b, 0xffffffffu, a > 0xffffffffu - b);
}

var<workgroup> each: array<u32, 256>;
var<workgroup> of_16: array<u32, 16>;  // sums of 16 threads
var<workgroup> whole: u32;

// The sum of the values of the threads before this one; `whole` becomes that of all. In two levels,
// because barriers are what takes time in drivers that compute on the CPU.
fn sum_before(value: u32, thread: u32) -> u32 {
  each[thread] = value;
  workgroupBarrier();
  if (thread < 16) {
    var sum = 0u;
    for (var k = 16 * thread; k < 16 * thread + 16; k++) {
      sum = add(sum, each[k]);
    }
    of_16[thread] = sum;
  }
  workgroupBarrier();
  var before = 0u;
  for (var k = 0u; k < thread / 16; k++) {
    before = add(before, of_16[k]);
  }
  for (var k = thread / 16 * 16; k < thread; k++) {
    before = add(before, each[k]);
  }
  if (thread == kThreads - 1) {
    whole = add(before, value);
  }
  workgroupBarrier();
  return before;
}

fn scan_index(i: u32) -> u32 {
  return 4 + params.scan_first * params.n + i;
}

fn sum_of_items(first: u32) -> u32 {
  var sum = 0u;
  for (var i = first; i < min(first + kItems, params.n); i++) {
    sum = add(sum, scan[scan_index(i)]);
  }
  return sum;
}

@compute @workgroup_size(256)
fn scan_sums(@builtin(workgroup_id) group: vec3<u32>,
             @builtin(num_workgroups) groups: vec3<u32>,
             @builtin(local_invocation_index) thread: u32) {
  let block = group.y * groups.x + group.x;
  _ = sum_before(sum_of_items((block * kThreads + thread) * kItems), thread);
  if (thread == 0 && block * kBlock < params.n) {
    sums[block] = whole;
  }
}

// One workgroup. Replaces each sum with that of the blocks before; the sum of all is written to
// `total` and to the head of `scan`.
@compute @workgroup_size(256)
fn scan_blocks(@builtin(local_invocation_index) thread: u32) {
  let blocks = (params.n + kBlock - 1) / kBlock;
  var carry = 0u;
  for (var first = 0u; first < blocks; first += kThreads) {
    var value = 0u;
    if (first + thread < blocks) {
      value = sums[first + thread];
    }
    let before = sum_before(value, thread);
    if (first + thread < blocks) {
      sums[first + thread] = add(carry, before);
    }
    carry = add(carry, workgroupUniformLoad(&whole));
  }
  if (thread == 0) {
    scan[0] = carry;
    total[0] = carry;
    total[1] = 0;
  }
}

@compute @workgroup_size(256)
fn scan_apply(@builtin(workgroup_id) group: vec3<u32>,
              @builtin(num_workgroups) groups: vec3<u32>,
              @builtin(local_invocation_index) thread: u32) {
  let block = group.y * groups.x + group.x;
  let first = (block * kThreads + thread) * kItems;
  var sum = sum_before(sum_of_items(first), thread);
  if (first < params.n) {
    sum = add(sums[block], sum);
  }
  for (var i = first; i < min(first + kItems, params.n); i++) {
    let value = scan[scan_index(i)];
    scan[scan_index(i)] = sum;
    sum = add(sum, value);
  }
}

// ---- Radix sort ---------------------------------------------------------------------------------

var<workgroup> histogram: array<atomic<u32>, 256>;

fn valid_pairs() -> u32 {
  return select(params.n, min(params.n, count[0]), params.has_count != 0);
}

fn digit_of(key: u32) -> u32 {
  return (key >> params.shift) & 255;
}

// How often each digit is in the keys of a block.
@compute @workgroup_size(256)
fn sort_count(@builtin(workgroup_id) group: vec3<u32>,
              @builtin(num_workgroups) groups: vec3<u32>,
              @builtin(local_invocation_index) thread: u32) {
  let block = group.y * groups.x + group.x;
  let blocks = (params.n + kBlock - 1) / kBlock;
  atomicStore(&histogram[thread], 0u);
  workgroupBarrier();
  for (var k = 0u; k < kItems; k++) {
    let i = block * kBlock + k * kThreads + thread;
    if (i < valid_pairs()) {
      atomicAdd(&histogram[digit_of(keys[i])], 1u);
    }
  }
  workgroupBarrier();
  if (block < blocks) {
    counts[thread * blocks + block] = atomicLoad(&histogram[thread]);
  }
}

// Replaces each count with that of the blocks before. A workgroup processes 16 digits, with 16
// threads for each, of which each has a part of the blocks.
@compute @workgroup_size(256)
fn sort_offsets(@builtin(workgroup_id) group: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
  let blocks = (params.n + kBlock - 1) / kBlock;
  let digit = group.x * 16 + thread / 16;
  let size = (blocks + 15) / 16;
  let begin = digit * blocks + min(thread % 16 * size, blocks);
  let end = digit * blocks + min((thread % 16 + 1) * size, blocks);
  var sum = 0u;
  for (var i = begin; i < end; i++) {
    sum += counts[i];
  }
  each[thread] = sum;
  workgroupBarrier();
  var before = 0u;
  for (var k = thread / 16 * 16; k < thread; k++) {
    before += each[k];
  }
  for (var i = begin; i < end; i++) {
    let here = counts[i];
    counts[i] = before;
    before += here;
  }
  if (thread % 16 == 15) {
    totals[digit] = before;
  }
}

var<workgroup> next: array<u32, 256>;  // of each digit, the place of its next key
// Of each digit, a bit for each thread that has it.
var<workgroup> having: array<atomic<u32>, 2048>;

// 256 keys at a time. The rank of a key among those with the same digit is the number of bits of the
// threads before, so keys of the same digit stay in order.
@compute @workgroup_size(256)
fn sort_scatter(@builtin(workgroup_id) group: vec3<u32>,
                @builtin(num_workgroups) groups: vec3<u32>,
                @builtin(local_invocation_index) thread: u32) {
  let block = group.y * groups.x + group.x;
  let blocks = (params.n + kBlock - 1) / kBlock;
  if (block * kBlock >= valid_pairs()) {
    return;
  }
  let before_digit = sum_before(totals[thread], thread);
  next[thread] = before_digit + counts[thread * blocks + block];
  for (var w = 0u; w < 8; w++) {
    atomicStore(&having[8 * thread + w], 0u);
  }
  workgroupBarrier();
  for (var k = 0u; k < kItems; k++) {
    let i = block * kBlock + k * kThreads + thread;
    let is_valid = i < valid_pairs();
    var key = 0u;
    if (is_valid) {
      key = keys[i];
      atomicOr(&having[8 * digit_of(key) + thread / 32], 1u << (thread % 32));
    }
    workgroupBarrier();
    if (is_valid) {
      let words = 8 * digit_of(key);
      let word = thread / 32;
      var place = next[digit_of(key)] +
                  countOneBits(atomicLoad(&having[words + word]) & ((1u << (thread % 32)) - 1));
      for (var w = 0u; w < word; w++) {
        place += countOneBits(atomicLoad(&having[words + w]));
      }
      keys_out[place] = key;
      if (params.rows != 0) {
        values_out[place] = i;
      } else {
        values_out[place] = values[i];
      }
    }
    workgroupBarrier();
    for (var w = 0u; w < 8; w++) {
      next[thread] += countOneBits(atomicExchange(&having[8 * thread + w], 0u));
    }
    workgroupBarrier();
  }
}
