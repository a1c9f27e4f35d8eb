// match_descriptors: for each descriptor of one image the two descriptors of another image with the
// largest dot products, and the same in the other direction, in one pass over the product matrix.
// Each row of the matrix may be restricted to a range of the columns.
//
// The matrix is computed in tiles that stay in registers, and is never stored. All numbers are
// integers, so the result is exact for every instruction set and number of threads.
#include <algorithm>
#include <cstdint>
#include <cstring>
#include <utility>
#include <vector>

#include "cpu/entry.h"
#include "cpu/isa.h"
#include "cpu/pool.h"

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace snow {
namespace {

constexpr int kValues = 128;          // of a descriptor
constexpr int64_t kMostTasks = 64;    // bounds the memory: each task has its own results of columns
constexpr int64_t kFewestTiles = 16;  // rows of tiles of a task, at least

#if defined(SNOWSPLAT_ISA_AVX512)
typedef int32_t Lanes __attribute__((vector_size(64)));
#elif defined(SNOWSPLAT_ISA_AVX2)
typedef int32_t Lanes __attribute__((vector_size(32)));
#else
typedef int32_t Lanes __attribute__((vector_size(16)));
#endif
constexpr int kLanes = sizeof(Lanes) / sizeof(int32_t);

SNOW_INLINE Lanes all(int32_t x) { return x - Lanes{}; }
SNOW_INLINE Lanes larger(Lanes a, Lanes b) { return a > b ? a : b; }
SNOW_INLINE Lanes smaller(Lanes a, Lanes b) { return a < b ? a : b; }

// How 32-bit words, each with several values, are multiplied. Each lane holds one word.
// `multiply_add` adds to each lane of `sum` the dot product of the word in this lane of `column`
// and the word in this lane of `row`.
//
// Two 16-bit values per word. Works everywhere.
struct Pairs {
  using Value = int16_t;
#if defined(SNOWSPLAT_ISA_AVX512)
  static constexpr int rows = 6, columns = 3;  // of a tile; columns are counted in vectors
#else
  static constexpr int rows = 4, columns = 2;
#endif
  static Value of_row(uint8_t x) { return x; }
  static Value of_column(uint8_t x) { return x; }
  static constexpr int32_t offset = 0;

  SNOW_INLINE static void multiply_add(Lanes& sum, Lanes column, Lanes row) {
#if defined(SNOWSPLAT_ISA_AVX512)
    sum += Lanes(_mm512_madd_epi16(__m512i(column), __m512i(row)));
#elif defined(SNOWSPLAT_ISA_AVX2)
    sum += Lanes(_mm256_madd_epi16(__m256i(column), __m256i(row)));
#elif defined(__SSE2__)
    sum += Lanes(_mm_madd_epi16(__m128i(column), __m128i(row)));
#else
    sum += (column & 0xffff) * (row & 0xffff) + (column >> 16) * (row >> 16);  // no value is < 0
#endif
  }
};

#if defined(SNOWSPLAT_ISA_AVX512)
// Four 8-bit values per word. The instruction multiplies unsigned by signed values, so 128 is
// subtracted from those of the rows; 128 times the sum of the column is added again.
struct Quads {
  using Value = uint8_t;
  static constexpr int rows = 6, columns = 4;
  static Value of_row(uint8_t x) { return x ^ 0x80; }  // the bits of int8_t(x - 128)
  static Value of_column(uint8_t x) { return x; }
  static constexpr int32_t offset = 128;

  // Assembly, because the intrinsic needs a flag of the compiler that would allow it to use
  // AVX512-VNNI everywhere in this file. The library also runs on machines without it.
  SNOW_INLINE static void multiply_add(Lanes& sum, Lanes column, Lanes row) {
    asm("vpdpbusd %2, %1, %0" : "+v"(sum) : "v"(column), "v"(row));
  }
};
#endif

// The largest and the second largest of the values seen so far, and the index of the largest, in
// each lane. Of equal values, the one seen first counts as the largest.
struct TopTwo {
  Lanes best = all(-1), second = all(0), index = all(-1);

  SNOW_INLINE void add(Lanes value, Lanes at) {
    second = larger(second, smaller(value, best));
    index = value > best ? at : index;
    best = larger(value, best);
  }
  SNOW_INLINE void add(const TopTwo& later) {
    second = larger(larger(second, later.second), smaller(later.best, best));
    index = later.best > best ? later.index : index;
    best = larger(later.best, best);
  }
};

// Where a result is written.
struct Out {
  int32_t *index, *best, *second;
};

// Of equal values in several lanes, the one with the smallest index wins.
SNOW_INLINE void write_over_lanes(const TopTwo& top, const Out& out, int64_t at) {
  int winner = 0;
  for (int l = 1; l < kLanes; l++)
    if (top.best[l] > top.best[winner] ||
        (top.best[l] == top.best[winner] && top.index[l] < top.index[winner]))
      winner = l;
  int32_t second = 0;
  for (int l = 0; l < kLanes; l++)
    second = std::max(second, l == winner ? int32_t(top.second[l]) : int32_t(top.best[l]));
  out.index[at] = top.index[winner], out.best[at] = top.best[winner], out.second[at] = second;
}

template <class Words>
class Matcher {
 public:
  explicit Matcher(const MatchDescriptorsParams& p) : p_(p) {
    blocks_ = (p.m + kWidth - 1) / kWidth;
    columns_.resize(size_t(blocks_));
    parallel_for(blocks_, [&](int64_t block) { pack_columns(block); });
  }

  void run() {
    const int64_t tiles = (p_.n + kRows - 1) / kRows;
    const int64_t rows = kRows * std::max(kFewestTiles, (tiles + kMostTasks - 1) / kMostTasks);
    const int64_t tasks = (p_.n + rows - 1) / rows;
    found_.resize(size_t(tasks * blocks_ * kColumns));
    parallel_for(tasks, [&](int64_t task) {
      const int64_t end = std::min(p_.n, (task + 1) * rows);
      TopTwo* found = found_.data() + task * blocks_ * kColumns;
      for (int64_t row = task * rows; row < end; row += kRows)
        match_rows(row, int(std::min<int64_t>(kRows, end - row)), found);
    });
    parallel_for(blocks_, [&](int64_t block) {
      for (int64_t vector = block * kColumns; vector < (block + 1) * kColumns; vector++) {
        TopTwo top;
        for (int64_t task = 0; task < tasks; task++)
          top.add(found_[size_t(task * blocks_ * kColumns + vector)]);
        for (int64_t l = 0; l < kLanes && vector * kLanes + l < p_.m; l++) {
          const int64_t column = vector * kLanes + l;
          p_.column_index[column] = top.index[l];
          p_.column_best[column] = top.best[l];
          p_.column_second[column] = top.second[l];
        }
      }
    });
  }

 private:
  using Value = typename Words::Value;
  static constexpr int kRows = Words::rows, kColumns = Words::columns;
  static constexpr int kWidth = kColumns * kLanes;  // columns of a tile
  static constexpr int kPerWord = sizeof(int32_t) / sizeof(Value);
  static constexpr int kWords = kValues / kPerWord;

  // The columns of a tile, in the order in which `multiply` reads them.
  struct Columns {
    Lanes start[kColumns];  // the initial sums
    Lanes words[kWords][kColumns];
  };

  // Columns beyond the last are 0. They are in no range, so they are never found.
  void pack_columns(int64_t block) {
    Columns& packed = columns_[size_t(block)];
    for (int column = 0; column < kWidth; column++) {
      const int vector = column / kLanes, lane = column % kLanes;
      const int64_t at = block * kWidth + column;
      int32_t sum = 0;
      for (int word = 0; word < kWords; word++) {
        Value values[kPerWord] = {};
        for (int k = 0; k < kPerWord && at < p_.m; k++) {
          const uint8_t x = p_.second[at * kValues + word * kPerWord + k];
          values[k] = Words::of_column(x);
          sum += x;
        }
        int32_t bits;
        std::memcpy(&bits, values, sizeof bits);
        packed.words[word][vector][lane] = bits;
      }
      packed.start[vector][lane] = Words::offset * sum;
    }
  }

  void match_rows(int64_t row, int rows, TopTwo* found) const {
    int32_t words[kRows][kWords] = {};
    for (int r = 0; r < rows; r++)
      for (int word = 0; word < kWords; word++) {
        Value values[kPerWord];
        for (int k = 0; k < kPerWord; k++)
          values[k] = Words::of_row(p_.first[(row + r) * kValues + word * kPerWord + k]);
        std::memcpy(&words[r][word], values, sizeof values);
      }
    TopTwo tops[kRows];
    Lanes lane;
    for (int l = 0; l < kLanes; l++) lane[l] = l;
    // Columns in the ranges of some of these rows, and in the ranges of all of them.
    int64_t some_begin = p_.m, some_end = 0, every_begin = 0, every_end = p_.m;
    for (int64_t at = row; at < row + rows; at++) {
      const int64_t begin = p_.begin[at], end = p_.end[at];
      if (begin < end) some_begin = std::min(some_begin, begin), some_end = std::max(some_end, end);
      every_begin = std::max(every_begin, begin), every_end = std::min(every_end, end);
    }
    const int64_t common_blocks = (p_.common + kWidth - 1) / kWidth;
    const int64_t last_block = (some_end + kWidth - 1) / kWidth;
    for (int64_t block = common_blocks > 0 ? 0 : some_begin / kWidth;
         block < std::max(common_blocks, last_block); block++) {
      if (block == common_blocks) block = std::max(block, some_begin / kWidth);
      const int64_t begin = block * kWidth, end = begin + kWidth;
      Lanes tile[kRows * kColumns];
      multiply(words, block, tile, std::make_index_sequence<kRows * kColumns>());
      if (end > p_.common && !(every_begin <= begin && end <= every_end))
        for (int r = 0; r < rows; r++)
          for (int c = 0; c < kColumns; c++) {
            const Lanes column = lane + int32_t(begin + c * kLanes);
            const Lanes searched =
                (column < all(int32_t(p_.common))) |
                ((column >= all(p_.begin[row + r])) & (column < all(p_.end[row + r])));
            Lanes& values = tile[r * kColumns + c];
            values = searched ? values : all(-1);
          }
      for (int r = 0; r < rows; r++) {
        TopTwo top = tops[r];
        for (int c = 0; c < kColumns; c++)
          top.add(tile[r * kColumns + c], lane + int32_t(begin + c * kLanes));
        tops[r] = top;
      }
      for (int c = 0; c < kColumns; c++) {
        TopTwo top = found[block * kColumns + c];
        for (int r = 0; r < rows; r++) top.add(tile[r * kColumns + c], all(int32_t(row + r)));
        found[block * kColumns + c] = top;
      }
    }
    for (int r = 0; r < rows; r++)
      write_over_lanes(tops[r], {p_.row_index, p_.row_best, p_.row_second}, row + r);
  }

  // The products of the rows of a tile with the columns of a block. `I` are the numbers of the
  // vectors of the tile: with constant indices instead of loops, compilers keep the sums in
  // registers.
  template <size_t... I>
  __attribute__((noinline)) void multiply(const int32_t (&words)[kRows][kWords], int64_t block,
                                          Lanes* tile, std::index_sequence<I...>) const {
    const Columns& packed = columns_[size_t(block)];
    Lanes sums[kRows * kColumns] = {packed.start[I % kColumns]...};
    for (int word = 0; word < kWords; word++)
      (Words::multiply_add(sums[I], packed.words[word][I % kColumns],
                           all(words[I / kColumns][word])),
       ...);
    ((tile[I] = sums[I]), ...);
  }

  const MatchDescriptorsParams& p_;
  int64_t blocks_;                // tiles beside each other
  std::vector<Columns> columns_;  // (blocks,)
  std::vector<TopTwo> found_;     // (tasks, blocks, vectors of a tile)
};

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(match_descriptors, MatchDescriptorsParams) {
#if defined(SNOWSPLAT_ISA_AVX512)
  if (has_avx512_vnni()) return Matcher<Quads>(p).run(), 0;
#endif
  Matcher<Pairs>(p).run();
  return 0;
}
