// Prefix sums and a radix sort of any length, used by the other operations. No block waits for
// another block: each step that needs the results of all blocks is a separate kernel (see
// ops/cuda/tiling.py).
//
//   scan_sums, scan_of_sums, scan_apply   an exclusive prefix sum
//   sort_count, sort_offsets, sort_scatter   one pass of the sort, by one digit of at most 8 bits;
//                                            few blocks need no sort_offsets
//
// Keys are unsigned integers of 16, 32 or 64 bits; values have 32 bits. The sort is stable.
#include "cuda/scan.h"

namespace snow {
namespace {

constexpr int kThreads = 256;

// An exclusive prefix sum. scan_of_sums has as many items as scan_sums has blocks.
struct ScanParams {
  int64_t n;               // items
  const uint32_t* values;  // (n,)
  uint64_t* sums;  // one per block of 1024 values; after the scan, that of the blocks before
  uint32_t* out;   // (n,) may be `values`
  int64_t* total;  // out, (1,)
  SNOW_FIELDS(n, values, sums, out, total)
};

// One pass of the sort. The digit has `bits` bits (at most 8), from bit `shift` on.
template <class Key>
struct SortPassParams {
  int64_t n;               // pairs that memory is allocated for
  const Key* keys;         // (n,)
  const uint32_t* values;  // (n,), or null: 0, 1, …
  Key* keys_out;           // out, (n,)
  uint32_t* values_out;    // out, (n,)
  int64_t shift, bits;
  int64_t blocks;          // of sort_count and sort_scatter
  uint32_t* counts;        // (2^bits, blocks); without `totals`: (blocks, 256)
  const uint32_t* totals;  // (2^bits,), or null: sort_scatter adds the counts itself
  const int64_t* count;    // (1,) the number of pairs, or null: n
  SNOW_FIELDS(n, keys, values, keys_out, values_out, shift, bits, blocks, counts, totals, count)
};

// sort_offsets, between sort_count and sort_scatter: sums of the counts of the preceding blocks.
struct SortOffsetsParams {
  int64_t n;         // blocks
  uint32_t* counts;  // (digits, n)
  uint32_t* totals;  // out, (digits,)
  SNOW_FIELDS(n, counts, totals)
};

// ---- Prefix sum ---------------------------------------------------------------------------------

constexpr int kScanItems = 4;  // consecutive items of a thread

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

// One block. Replaces each sum with the sum of the preceding ones.
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

// A sum that does not fit into 32 bits becomes 2³² − 1, which is larger than any capacity.
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

// Keys per thread. Few keys are sorted by more blocks, because the time of one block decides.
constexpr int kManyItems = 16, kFewItems = 4, kWideItems = 8;  // kWideItems: keys of 64 bits

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

// The number of valid items among n, which may be known only on the GPU.
SNOW_INLINE int64_t valid_items(int64_t n, const int64_t* count) {
  return count && *count < n ? *count : n;
}

// The lanes that have the same digit, by one vote per bit. The time does not depend on the number
// of different digits; that of the instruction for complete values (match) does.
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

// How often each digit is in the keys of a block.
template <int kItems, class Key>
SNOW_INLINE void count_digits(const SortPassParams<Key>& p) {
  const Digit digit_of = digit_at(p.shift, p.bits);
  SNOW_SHARED(uint32_t, histogram, kDigits);
  histogram[threadIdx.x] = 0;
  __syncthreads();
  const int64_t valid = valid_items(p.n, p.count);
  const int64_t first = int64_t(blockIdx.x) * (kThreads * kItems);
  if (first < valid) {
    const int64_t left = valid - first;
#pragma unroll
    for (int k = 0; k < kItems; k++) {
      const int at = k * kThreads + int(threadIdx.x);
      const bool is_valid = at < left;
      const int digit = is_valid ? digit_of(p.keys[first + at]) : 0;
      // One lane adds the count for all lanes with the same digit, because often most lanes have
      // the same digit.
      const uint32_t same = lanes_with(digit) & __ballot_sync(kAllLanes, is_valid);
      if (is_valid && (same & lanes_below()) == 0) atomicAdd(&histogram[digit], __popc(same));
    }
  }
  __syncthreads();
  if (threadIdx.x <= digit_of.mask) {
    const int64_t thread = threadIdx.x, block = blockIdx.x;
    p.counts[p.totals ? thread * p.blocks + block : block * kDigits + thread] = histogram[thread];
  }
}

// The occurrences of a digit in the keys of the preceding blocks, and of all blocks.
struct Occurrences {
  uint32_t before = 0, total = 0;

  template <class Key>
  SNOW_INLINE Occurrences(const SortPassParams<Key>& p, int digit) {
    if (p.totals) {
      before = p.counts[int64_t(digit) * p.blocks + blockIdx.x], total = p.totals[digit];
      return;
    }
    const int blocks = int(p.blocks), block = int(blockIdx.x);
#pragma unroll 8
    for (int b = 0; b < blocks; b++) {
      const uint32_t count = p.counts[b * kDigits + digit];
      total += count;
      if (b < block) before += count;
    }
  }
  SNOW_INLINE Occurrences() {}
};

// One block per digit. Replaces each count of the digit with the sum of the counts of the preceding
// blocks, and writes the sum of all counts to totals[digit].
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

// Each warp has kItems × 32 consecutive keys. It computes the rank of each key among its keys with
// the same digit, 32 keys at a time. The histograms of all warps then give the position of each key
// in the keys of the block, sorted by digit. The keys are written to shared memory in this order,
// and from there to global memory, so that neighbouring threads write to neighbouring addresses.
// Then the values are written in the same way. Invalid items are at the end and have the last
// digit, so they stay at the end.
template <int kItems, class Key>
SNOW_INLINE void scatter_block(const SortPassParams<Key>& p, int64_t first, int valid) {
  constexpr int kWarps = kThreads / kWarp, kAll = kThreads * kItems;
  constexpr int kWords = kAll * int(sizeof(Key) == 8 ? 2 : 1) / 2;
  SNOW_SHARED(uint16_t, histograms, kWarps* kDigits);
  // For each digit, the position of its first key in the output, minus that in the block:
  SNOW_SHARED(uint32_t, run_start, kDigits);
  SNOW_SHARED(uint64_t, staged, kWords);
  Key* const staged_keys = reinterpret_cast<Key*>(staged);
  uint32_t* const staged_values = reinterpret_cast<uint32_t*>(staged);

  const Key* const keys = p.keys;
  const uint32_t* const values = p.values;
  const Digit digit_of = digit_at(p.shift, p.bits);
  const int thread = int(threadIdx.x), lane = lane_id();
  const int mine = warp_id() * (kItems * kWarp) + lane;
  uint16_t* const histogram = histograms + warp_id() * kDigits;

  Key key[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = mine + k * kWarp;
    key[k] = at < valid ? keys[first + at] : Key(~Key(0));
  }
#pragma unroll
  for (int w = 0; w < kWarps; w++) histograms[w * kDigits + thread] = 0;
  __syncthreads();

  int position[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int digit = digit_of(key[k]);
    const uint32_t same = lanes_with(digit), below = same & lanes_below();
    const int before = histogram[digit];
    __syncwarp();
    if (below == 0) histogram[digit] = uint16_t(before + __popc(same));
    __syncwarp();
    position[k] = before + __popc(below);
  }
  __syncthreads();

  {
    const bool is_digit = uint32_t(thread) <= digit_of.mask;
    uint32_t sum = 0;
#pragma unroll
    for (int w = 0; w < kWarps; w++) {
      const uint32_t c = histograms[w * kDigits + thread];
      histograms[w * kDigits + thread] = uint16_t(sum);
      sum += c;
    }
    // Two scans in one: of the counts of this block in the low half, and of the counts of all
    // blocks in the high half.
    const Occurrences of_digit = is_digit ? Occurrences(p, thread) : Occurrences();
    const uint64_t both = uint64_t(of_digit.total) << 32 | sum;
    const uint64_t before = block_scan<kThreads>(both).before;
    const uint32_t here = uint32_t(before);
#pragma unroll
    for (int w = 0; w < kWarps; w++)
      histograms[w * kDigits + thread] = uint16_t(histograms[w * kDigits + thread] + here);
    run_start[thread] = uint32_t(before >> 32) + of_digit.before - here;
  }
  __syncthreads();

#pragma unroll
  for (int k = 0; k < kItems; k++) {
    position[k] += histogram[digit_of(key[k])];
    staged_keys[position[k]] = key[k];
  }
  __syncthreads();

  uint32_t target[kItems];
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = k * kThreads + thread;
    const Key moved = staged_keys[at];
    target[k] = run_start[digit_of(moved)] + uint32_t(at);
    if (at < valid) p.keys_out[target[k]] = moved;
  }
  __syncthreads();

#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = mine + k * kWarp;
    if (at < valid) staged_values[position[k]] = values ? values[first + at] : uint32_t(first + at);
  }
  __syncthreads();
#pragma unroll
  for (int k = 0; k < kItems; k++) {
    const int at = k * kThreads + thread;
    if (at < valid) p.values_out[target[k]] = staged_values[at];
  }
}

template <int kItems, class Key>
SNOW_INLINE void scatter(const SortPassParams<Key>& p) {
  constexpr int kAll = kThreads * kItems;
  const int64_t first = int64_t(blockIdx.x) * kAll, left = valid_items(p.n, p.count) - first;
  if (left > 0) scatter_block<kItems>(p, first, left < kAll ? int(left) : kAll);
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_KERNEL(scan_sums, kThreads, ScanParams) { sum_blocks(p.n, p.values, p.sums); }
SNOW_KERNEL(scan_of_sums, kThreads, ScanParams) { scan_blocks(p.n, p.sums, p.total); }
SNOW_KERNEL(scan_apply, kThreads, ScanParams) { apply_scan(p.n, p.values, p.sums, p.out); }

#define SNOW_SORT_KERNELS(SUFFIX, KEY, ITEMS)                                                \
  SNOW_KERNEL(sort_count##SUFFIX, kThreads, SortPassParams<KEY>) { count_digits<ITEMS>(p); } \
  SNOW_KERNEL(sort_scatter##SUFFIX, kThreads, SortPassParams<KEY>) { scatter<ITEMS>(p); }

SNOW_SORT_KERNELS(_u16, uint16_t, kManyItems)
SNOW_SORT_KERNELS(_u32, uint32_t, kManyItems)
SNOW_SORT_KERNELS(_u64, uint64_t, kWideItems)
SNOW_SORT_KERNELS(_few_u16, uint16_t, kFewItems)
SNOW_SORT_KERNELS(_few_u32, uint32_t, kFewItems)
SNOW_KERNEL(sort_offsets, kThreads, SortOffsetsParams) { scan_counts(p.n, p.counts, p.totals); }
