// The layout of a struct of parameters as one number. Python fills these structs (ops/params.py)
// and computes the number of its own definition. When it loads a library, it compares the two
// numbers.
//
//   struct ExampleParams {
//     int64_t n;
//     const float* values;
//     SNOW_FIELDS(n, values)  // every member, in order
//   };
//
// layout_of<ExampleParams>() is a hash of the text "n:i@0;values:p@8;#16": for each field the name,
// the kind (p: pointer, i: int64_t, d: double, {…}: nested struct) and the offset in bytes, and at
// the end the size of the struct. The text begins with the constants that Python and C++ share.
#pragma once

#include "portable.h"

namespace snow {

constexpr int kTile = 16;            // edge of a tile in pixels
constexpr int kGroupChannels = 4;    // maximum number of channels of one rasterization pass
constexpr int kSlotWidth = 16;       // numbers of an instance's gradient: ≤ 4 colours, 6 moments
constexpr int kPackedHeader = 8;     // columns of Splats2D before the colours
constexpr int kPackedStride = 16;    // columns of Splats2D with three colours
constexpr int kPoseSums = 16;        // 9 rotation, 3 translation, 3 position, 1 focal length
constexpr int kMaxNeighbours = 64;   // largest k of `neighbours`
constexpr int kAlignmentRadius = 7;  // of the window of `align_patches`, in pixels
constexpr int kMaxSweepSources = 8;  // of `plane_sweep`
constexpr int kMaxSweepRadius = 7;   // of the window of `plane_sweep`, in pixels

class LayoutHash {
 public:
  constexpr void text(const char* characters) {
    for (; *characters; characters++)
      value = (value ^ uint64_t(*characters)) * 1099511628211ull;  // FNV-1a
  }
  constexpr void number(int64_t n) {
    if (n >= 10) number(n / 10);
    const char digit[2] = {char('0' + n % 10), 0};
    text(digit);
  }
  constexpr void constant(const char* name, int n) { text(name), text("="), number(n), text(";"); }

  uint64_t value = 14695981039346656037ull;
};

// The kind of a nested struct; the specialisations are for single fields.
template <class Field>
struct FieldKind {
  static constexpr void describe(LayoutHash& hash) {
    hash.text("{"), Field::template describe<Field>(hash), hash.text("}");
  }
};
template <class Pointee>
struct FieldKind<Pointee*> {
  static constexpr void describe(LayoutHash& hash) { hash.text("p"); }
};
template <>
struct FieldKind<int64_t> {
  static constexpr void describe(LayoutHash& hash) { hash.text("i"); }
};
template <>
struct FieldKind<double> {
  static constexpr void describe(LayoutHash& hash) { hash.text("d"); }
};

template <class Params>
constexpr uint64_t layout_of() {
  LayoutHash hash;
  hash.constant("tile", kTile);
  hash.constant("group_channels", kGroupChannels);
  hash.constant("slot_width", kSlotWidth);
  hash.constant("packed_header", kPackedHeader);
  hash.constant("packed_stride", kPackedStride);
  hash.constant("pose_sums", kPoseSums);
  hash.constant("max_neighbours", kMaxNeighbours);
  hash.constant("alignment_radius", kAlignmentRadius);
  hash.constant("max_sweep_sources", kMaxSweepSources);
  hash.constant("max_sweep_radius", kMaxSweepRadius);
  Params::template describe<Params>(hash);
  return hash.value;
}

}  // namespace snow

#if defined(__CUDACC_RTC__)  // NVRTC has neither <cstddef> nor the builtin
#define SNOW_OFFSET_OF(STRUCT, NAME) __INTADDR__(&(static_cast<STRUCT*>(0)->NAME))
#else
#define SNOW_OFFSET_OF(STRUCT, NAME) __builtin_offsetof(STRUCT, NAME)
#endif

// Used within a struct: lists its members, in order.
#define SNOW_FIELDS(...)                                   \
  template <class Self>                                    \
  static constexpr void describe(snow::LayoutHash& hash) { \
    SNOW_FOR_EACH(SNOW_DESCRIBE_FIELD, __VA_ARGS__)        \
    hash.text("#"), hash.number(int64_t(sizeof(Self)));    \
  }
#define SNOW_DESCRIBE_FIELD(NAME)                        \
  hash.text(#NAME), hash.text(":");                      \
  snow::FieldKind<decltype(Self::NAME)>::describe(hash); \
  hash.text("@"), hash.number(int64_t(SNOW_OFFSET_OF(Self, NAME))), hash.text(";");

// MACRO(a) MACRO(b) … for up to 40 arguments.
#define SNOW_FOR_EACH(MACRO, ...)                                                                  \
  SNOW_AFTER_40(__VA_ARGS__, SNOW_EACH_40, SNOW_EACH_39, SNOW_EACH_38, SNOW_EACH_37, SNOW_EACH_36, \
                SNOW_EACH_35, SNOW_EACH_34, SNOW_EACH_33, SNOW_EACH_32, SNOW_EACH_31,              \
                SNOW_EACH_30, SNOW_EACH_29, SNOW_EACH_28, SNOW_EACH_27, SNOW_EACH_26,              \
                SNOW_EACH_25, SNOW_EACH_24, SNOW_EACH_23, SNOW_EACH_22, SNOW_EACH_21,              \
                SNOW_EACH_20, SNOW_EACH_19, SNOW_EACH_18, SNOW_EACH_17, SNOW_EACH_16,              \
                SNOW_EACH_15, SNOW_EACH_14, SNOW_EACH_13, SNOW_EACH_12, SNOW_EACH_11,              \
                SNOW_EACH_10, SNOW_EACH_9, SNOW_EACH_8, SNOW_EACH_7, SNOW_EACH_6, SNOW_EACH_5,     \
                SNOW_EACH_4, SNOW_EACH_3, SNOW_EACH_2, SNOW_EACH_1)(MACRO, __VA_ARGS__)
#define SNOW_AFTER_40(A1, A2, A3, A4, A5, A6, A7, A8, A9, A10, A11, A12, A13, A14, A15, A16, A17, \
                      A18, A19, A20, A21, A22, A23, A24, A25, A26, A27, A28, A29, A30, A31, A32,  \
                      A33, A34, A35, A36, A37, A38, A39, A40, FOUND, ...)                         \
  FOUND
#define SNOW_EACH_1(MACRO, FIRST) MACRO(FIRST)
#define SNOW_EACH_2(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_1(MACRO, __VA_ARGS__)
#define SNOW_EACH_3(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_2(MACRO, __VA_ARGS__)
#define SNOW_EACH_4(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_3(MACRO, __VA_ARGS__)
#define SNOW_EACH_5(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_4(MACRO, __VA_ARGS__)
#define SNOW_EACH_6(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_5(MACRO, __VA_ARGS__)
#define SNOW_EACH_7(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_6(MACRO, __VA_ARGS__)
#define SNOW_EACH_8(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_7(MACRO, __VA_ARGS__)
#define SNOW_EACH_9(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_8(MACRO, __VA_ARGS__)
#define SNOW_EACH_10(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_9(MACRO, __VA_ARGS__)
#define SNOW_EACH_11(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_10(MACRO, __VA_ARGS__)
#define SNOW_EACH_12(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_11(MACRO, __VA_ARGS__)
#define SNOW_EACH_13(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_12(MACRO, __VA_ARGS__)
#define SNOW_EACH_14(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_13(MACRO, __VA_ARGS__)
#define SNOW_EACH_15(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_14(MACRO, __VA_ARGS__)
#define SNOW_EACH_16(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_15(MACRO, __VA_ARGS__)
#define SNOW_EACH_17(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_16(MACRO, __VA_ARGS__)
#define SNOW_EACH_18(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_17(MACRO, __VA_ARGS__)
#define SNOW_EACH_19(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_18(MACRO, __VA_ARGS__)
#define SNOW_EACH_20(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_19(MACRO, __VA_ARGS__)
#define SNOW_EACH_21(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_20(MACRO, __VA_ARGS__)
#define SNOW_EACH_22(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_21(MACRO, __VA_ARGS__)
#define SNOW_EACH_23(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_22(MACRO, __VA_ARGS__)
#define SNOW_EACH_24(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_23(MACRO, __VA_ARGS__)
#define SNOW_EACH_25(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_24(MACRO, __VA_ARGS__)
#define SNOW_EACH_26(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_25(MACRO, __VA_ARGS__)
#define SNOW_EACH_27(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_26(MACRO, __VA_ARGS__)
#define SNOW_EACH_28(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_27(MACRO, __VA_ARGS__)
#define SNOW_EACH_29(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_28(MACRO, __VA_ARGS__)
#define SNOW_EACH_30(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_29(MACRO, __VA_ARGS__)
#define SNOW_EACH_31(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_30(MACRO, __VA_ARGS__)
#define SNOW_EACH_32(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_31(MACRO, __VA_ARGS__)
#define SNOW_EACH_33(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_32(MACRO, __VA_ARGS__)
#define SNOW_EACH_34(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_33(MACRO, __VA_ARGS__)
#define SNOW_EACH_35(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_34(MACRO, __VA_ARGS__)
#define SNOW_EACH_36(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_35(MACRO, __VA_ARGS__)
#define SNOW_EACH_37(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_36(MACRO, __VA_ARGS__)
#define SNOW_EACH_38(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_37(MACRO, __VA_ARGS__)
#define SNOW_EACH_39(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_38(MACRO, __VA_ARGS__)
#define SNOW_EACH_40(MACRO, FIRST, ...) MACRO(FIRST) SNOW_EACH_39(MACRO, __VA_ARGS__)
