// Prefix sums and a radix sort of any length, for the other parts of the engine. No block waits for
// another: what needs the results of all blocks is a kernel of its own (see ops/cuda/sorting.py).
//
//   scan_sums, scan_of_sums, scan_apply   an exclusive prefix sum
//   sort_count, sort_offsets, sort_scatter   one pass of the sort, by one digit of at most 8 bits
//
// Keys are unsigned, of 16, 32 or 64 bits; values have 32. The sort is stable.
#include "cuda/scan.h"

namespace snow {
namespace {

constexpr int kThreads = 256;

// ---- Prefix sum ---------------------------------------------------------------------------------

constexpr int kScanItems = 4;  // of a thread, one after the other

struct ScanItems {
  uint32_t value[kScanItems];
  uint64_t sum;
};

SNOW_INLINE ScanItems load_scan_items(int64_t n, const uint32_t* values) {
  const int64_t first = thread_index() * kScanItems;
  ScanItems items;
  items.sum = 0;
#pragma unroll
  for (int k = 0; k < kScanItems; k++) {
    items.value[k] = first + k < n ? values[first + k] : 0;
    items.sum += items.value[k];
  }
  return items;
}

SNOW_INLINE void sum_blocks(int64_t n, const uint32_t* values, uint64_t* sums) {
  const BlockScan<uint64_t> scan = block_scan<kThreads>(load_scan_items(n, values).sum);
  if (threadIdx.x == 0) sums[blockIdx.x] = scan.total;
}

// One block. Replaces the sums by those of the blocks before.
SNOW_INLINE void scan_blocks(int64_t n, uint64_t* sums, int64_t* total) {
  uint64_t carry = 0;
  for (int64_t first = 0; first < n; first += kThreads) {
    const int64_t i = first + threadIdx.x;
    const BlockScan<uint64_t> scan = block_scan<kThreads>(i < n ? sums[i] : uint64_t(0));
    if (i < n) sums[i] = carry + scan.before;
    carry += scan.total;
  }
  if (threadIdx.x == 0) *total = int64_t(carry);
}

// `out` may be `values`. What does not fit into 32 bits becomes the largest number that does, and
// is then beyond whatever memory there is.
SNOW_INLINE void apply_scan(int64_t n, const uint32_t* values, const uint64_t* sums,
                            uint32_t* out) {
  const ScanItems items = load_scan_items(n, values);
  const int64_t first = thread_index() * kScanItems;
  uint64_t sum = sums[blockIdx.x] + block_scan<kThreads>(items.sum).before;
#pragma unroll
  for (int k = 0; k < kScanItems; k++) {
    if (first + k < n) out[first + k] = sum < 0xffffffffu ? uint32_t(sum) : 0xffffffffu;
    sum += items.value[k];
  }
}

// ---- Radix sort ---------------------------------------------------------------------------------

constexpr int kDigitBits = 8, kDigits = 1 << kDigitBits;
static_assert(kDigits == kThreads, "a thread for each digit");

// Keys of a thread. A block keeps 16 kB of them in shared memory.
template <class Key>
constexpr int kSortItems = sizeof(Key) == 8 ? 8 : 16;

struct Digit {
  int shift;
  uint32_t mask;

  template <class Key>
  SNOW_INLINE int operator()(Key key) const {
    return int(uint32_t(key >> shift) & mask);
  }
};

SNOW_INLINE Digit digit_at(int64_t shift, int64_t bits) {
  return {int(shift), (1u << int(bits)) - 1};
}

// How many of n items there are: the number may be known on the GPU only.
SNOW_INLINE int64_t valid_items(int64_t n, const int64_t* count) {
  return count && *count < n ? *count : n;
}

// The lanes that have the same digit. A vote for each of its bits: unlike the instruction that
// compares whole values, it takes as long for many digits as for few.
SNOW_INLINE uint32_t lanes_with(int digit) {
  uint32_t same = kAllLanes;
#pragma unroll
  for (int b = 0; b < kDigitBits; b++) {
    const bool set = digit >> b & 1;
    const uint32_t votes = __ballot_sync(kAllLanes, set);
    same &= set ? votes : ~votes;
  }
  return same;
}

SNOW_INLINE uint32_t lanes_below() { return (1u << lane_id()) - 1; }

// counts[digit · blocks + block]: how often the digit is in the keys of a block.
template <class Key>
SNOW_INLINE void count_digits(int64_t n, const Key* keys, Digit digit_of, int64_t blocks,
                              uint32_t* counts, const int64_t* count) {
  constexpr int kItems = kSortItems<Key>;
  SNOW_SHARED(uint32_t, histogram, kDigits);
  histogram[threadIdx.x] = 0;
  __syncthreads();
  const int64_t valid = valid_items(n, count);
  const int64_t first = int64_t(blockIdx.x) * (kThreads * kItems);
  if (first < valid) {
    const int64_t left = valid - first;
#pragma unroll
    for (int k = 0; k < kItems; k++) {
      const int at = k * kThreads + int(threadIdx.x);
      const bool is_valid = at < left;
      const int digit = is_valid ? digit_of(keys[first + at]) : 0;
      // One lane adds for all that have its digit, because often most of them do.
      const uint32_t same = lanes_with(digit) & __ballot_sync(kAllLanes, is_valid);
      if (is_valid && (same & lanes_below()) == 0) atomicAdd(&histogram[digit], __popc(same));
    }
  }
  __syncthreads();
  if (threadIdx.x <= digit_of.mask)
    counts[int64_t(threadIdx.x) * blocks + blockIdx.x] = histogram[threadIdx.x];
}

// A block a digit: its counts become the sums of those of the blocks before, totals[digit] of all.
SNOW_INLINE void scan_counts(int64_t blocks, uint32_t* counts, uint32_t* totals) {
  uint32_t* row = counts + int64_t(blockIdx.x) * blocks;
  uint32_t carry = 0;
  for (int64_t first = 0; first < blocks; first += kThreads * kScanItems) {
    const int64_t mine = first + int64_t(threadIdx.x) * kScanItems;
    uint32_t value[kScanItems], sum = 0;
#pragma unroll
    for (int k = 0; k < kScanItems; k++) {
      value[k] = mine + k < blocks ? row[mine + k] : 0;
      sum += value[k];
    }
    const BlockScan<uint32_t> scan = block_scan<kThreads>(sum);
    uint32_t before = carry + scan.before;
#pragma unroll
    for (int k = 0; k < kScanItems; k++) {
      if (mine + k < blocks) row[mine + k] = before;
      before += value[k];
    }
    carry += scan.total;
  }
  if (threadIdx.x == 0) totals[blockIdx.x] = carry;
}

// Each warp has kItems × 32 keys in a row. It goes through them 32 at a time and ranks them among
// those of its own with the same digit; from the tallies of all warps follows the place of a key in
// the block's keys in the order of their digits. In this order they go to shared memory and from
// there out, so that neighbouring threads write to neighbouring addresses; the values follow. What
// is not valid is at the end and has the last digit, so that it stays at the end.
// One block alone has no others to add, so that sort_offsets may be left out: its counts are the
// totals.
template <class Key>
SNOW_INLINE void scatter_block(int64_t first, int valid, const Key* keys, const uint32_t* values,
                               Key* keys_out, uint32_t* values_out, Digit digit_of, int64_t blocks,
                               const uint32_t* counts, const uint32_t* totals) {
  constexpr int kItems = kSortItems<Key>, kWarps = kThreads / kWarp, kAll = kThreads * kItems;
  constexpr int kWords = kAll * int(sizeof(Key) == 8 ? 2 : 1) / 2;
  SNOW_SHARED(uint16_t, tally, kWarps* kDigits);
  SNOW_SHARED(uint32_t, run_start, kDigits);  // where a digit's keys go, less their place here
  SNOW_SHARED(uint64_t, staged, kWords);
  Key* const staged_keys = reinterpret_cast<Key*>(staged);
  uint32_t* const staged_values = reinterpret_cast<uint32_t*>(staged);

  const int thread = int(threadIdx.x), lane = lane_id();
  const int mine = warp_id() * (kItems * kWarp) + lane;
  uint16_t* const own = tally + warp_id() * kDigits;

  Key key[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = mine + k * kWarp;
    key[k] = at < valid ? keys[first + at] : Key(~Key(0));
  }
#pragma unroll
  for (int w = 0; w < kWarps; w++) tally[w * kDigits + thread] = 0;
  __syncthreads();

  int place[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int digit = digit_of(key[k]);
    const uint32_t same = lanes_with(digit), below = same & lanes_below();
    const int before = own[digit];
    __syncwarp();
    if (below == 0) own[digit] = uint16_t(before + __popc(same));
    __syncwarp();
    place[k] = before + __popc(below);
  }
  __syncthreads();

  {
    const bool is_digit = uint32_t(thread) <= digit_of.mask;
    uint32_t sum = 0;
#pragma unroll
    for (int w = 0; w < kWarps; w++) {
      const uint32_t c = tally[w * kDigits + thread];
      tally[w * kDigits + thread] = uint16_t(sum);
      sum += c;
    }
    // Two scans in one: of the digits of this block, and above them of those of all.
    const uint64_t both = uint64_t(is_digit ? totals[thread] : 0) << 32 | sum;
    const uint64_t before = block_scan<kThreads>(both).before;
    const uint32_t here = uint32_t(before);
#pragma unroll
    for (int w = 0; w < kWarps; w++)
      tally[w * kDigits + thread] = uint16_t(tally[w * kDigits + thread] + here);
    uint32_t other_blocks = 0;
    if (is_digit && blocks > 1) other_blocks = counts[int64_t(thread) * blocks + blockIdx.x];
    run_start[thread] = uint32_t(before >> 32) + other_blocks - here;
  }
  __syncthreads();

#pragma unroll
  for (int k = 0; k < kItems; k++) {
    place[k] += own[digit_of(key[k])];
    staged_keys[place[k]] = key[k];
  }
  __syncthreads();

  uint32_t target[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = k * kThreads + thread;
    const Key moved = staged_keys[at];
    target[k] = run_start[digit_of(moved)] + uint32_t(at);
    if (at < valid) keys_out[target[k]] = moved;
  }
  __syncthreads();

#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = mine + k * kWarp;
    if (at < valid) staged_values[place[k]] = values ? values[first + at] : uint32_t(first + at);
  }
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = k * kThreads + thread;
    if (at < valid) values_out[target[k]] = staged_values[at];
  }
}

template <class Key>
SNOW_INLINE void scatter(int64_t n, const Key* keys, const uint32_t* values, Key* keys_out,
                         uint32_t* values_out, Digit digit_of, int64_t blocks,
                         const uint32_t* counts, const uint32_t* totals, const int64_t* count) {
  constexpr int kAll = kThreads * kSortItems<Key>;
  const int64_t first = int64_t(blockIdx.x) * kAll, left = valid_items(n, count) - first;
  if (left > 0)
    scatter_block(first, left < kAll ? int(left) : kAll, keys, values, keys_out, values_out,
                  digit_of, blocks, counts, totals);
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(scan_sums, 256, (int64_t n, const uint32_t* values, uint64_t* sums)) {
  sum_blocks(n, values, sums);
}
SNOW_KERNEL(scan_of_sums, 256, (int64_t n, uint64_t* sums, int64_t* total)) {
  scan_blocks(n, sums, total);
}
SNOW_KERNEL(scan_apply, 256,
            (int64_t n, const uint32_t* values, const uint64_t* sums, uint32_t* out)) {
  apply_scan(n, values, sums, out);
}
SNOW_KERNEL(sort_offsets, 256, (int64_t blocks, uint32_t* counts, uint32_t* totals)) {
  scan_counts(blocks, counts, totals);
}

// `count` (how many of the n there are) and `values` (the rows' numbers then) may be null.
#define SNOW_SORT_KERNELS(SUFFIX, KEY)                                                            \
  SNOW_KERNEL(sort_count_##SUFFIX, 256,                                                           \
              (int64_t n, const KEY* keys, int64_t shift, int64_t bits, int64_t blocks,           \
               uint32_t* counts, const int64_t* count)) {                                         \
    count_digits(n, keys, digit_at(shift, bits), blocks, counts, count);                          \
  }                                                                                               \
  SNOW_KERNEL(sort_scatter_##SUFFIX, 256,                                                         \
              (int64_t n, const KEY* keys, const uint32_t* values, KEY* keys_out,                 \
               uint32_t* values_out, int64_t shift, int64_t bits, int64_t blocks,                 \
               const uint32_t* counts, const uint32_t* totals, const int64_t* count)) {           \
    scatter(n, keys, values, keys_out, values_out, digit_at(shift, bits), blocks, counts, totals, \
            count);                                                                               \
  }

SNOW_SORT_KERNELS(u16, uint16_t)
SNOW_SORT_KERNELS(u32, uint32_t)
SNOW_SORT_KERNELS(u64, uint64_t)
