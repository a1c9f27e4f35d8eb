// The layout of a struct of parameters as a text, from which Python learns how to fill the struct
// (util/native_layout.py): the structs are defined here only.
//
//   struct ExampleParams {
//     int64_t n;
//     const float* values;
//     CameraParams<float> camera;
//     SNOW_FIELDS(n, values, camera)  // every member, in order
//   };
//
// layout_of<ExampleParams>() is "tile=16;…|n:i;values:p;camera{width:d;…}": the constants that
// Python and C++ share, then the name and the kind of each field (p: pointer, i: int64_t, d: double,
// {…}: nested struct). Every field has 8 bytes; the compiler checks that the list is complete.
#pragma once

#include "portable.h"

namespace snow {

constexpr int kTile = 16;            // edge of a tile in pixels
constexpr int kGroupChannels = 4;    // maximum number of channels of one rasterization pass
constexpr int kSlotWidth = 16;       // numbers of an instance's gradient: ≤ 4 colours, 6 moments
constexpr int kSegment = 256;        // instances of a tile that a block of rasterize_bwd processes
constexpr int kPackedHeader = 8;     // columns of Splats2D before the colours
constexpr int kPackedStride = 16;    // columns of Splats2D with three colours
constexpr int kPoseSums = 16;        // 9 rotation, 3 translation, 3 position, 1 focal length
constexpr int kMaxNeighbours = 64;   // largest k of `neighbours`
constexpr int kAlignmentRadius = 7;  // of the window of `align_patches`, in pixels
constexpr int kMaxSweepSources = 8;  // of `plane_sweep`
constexpr int kMaxSweepRadius = 7;   // of the window of `plane_sweep`, in pixels

// A text that ends with a zero, of a struct with `fields` fields.
template <int Capacity>
struct LayoutText {
  char characters[Capacity] = {};
  int size = 0;
  int fields = 0;
  bool is_complete = true;

  constexpr void text(const char* more) {
    for (; *more; more++) characters[size++] = *more;
  }
  constexpr void number(int n) {
    if (n >= 10) number(n / 10);
    characters[size++] = char('0' + n % 10);
  }
  constexpr void constant(const char* name, int n) { text(name), text("="), number(n), text(";"); }
  constexpr void field(const char* kind) { text(kind), fields++; }
};

// The kind of a nested struct; the specialisations are for single fields.
template <class Field>
struct FieldKind {
  template <class Text>
  static constexpr void describe(Text& layout) {
    layout.text("{"), Field::template describe<Field>(layout), layout.text("}");
  }
};
template <class Pointee>
struct FieldKind<Pointee*> {
  template <class Text>
  static constexpr void describe(Text& layout) {
    layout.field(":p;");
  }
};
template <>
struct FieldKind<int64_t> {
  template <class Text>
  static constexpr void describe(Text& layout) {
    layout.field(":i;");
  }
};
template <>
struct FieldKind<double> {
  template <class Text>
  static constexpr void describe(Text& layout) {
    layout.field(":d;");
  }
};

template <class Params, int Capacity>
constexpr LayoutText<Capacity> layout_in() {
  LayoutText<Capacity> layout;
  layout.constant("tile", kTile);
  layout.constant("group_channels", kGroupChannels);
  layout.constant("slot_width", kSlotWidth);
  layout.constant("segment", kSegment);
  layout.constant("packed_header", kPackedHeader);
  layout.constant("packed_stride", kPackedStride);
  layout.constant("pose_sums", kPoseSums);
  layout.constant("max_neighbours", kMaxNeighbours);
  layout.constant("alignment_radius", kAlignmentRadius);
  layout.constant("max_sweep_sources", kMaxSweepSources);
  layout.constant("max_sweep_radius", kMaxSweepRadius);
  layout.text("|");
  Params::template describe<Params>(layout);
  return layout;
}

template <class Params>
constexpr auto layout_of() {
  constexpr int kSize = layout_in<Params, 4096>().size;
  static_assert(layout_in<Params, 4096>().is_complete, "SNOW_FIELDS lists every member, in order");
  return layout_in<Params, kSize + 1>();
}

}  // namespace snow

#if defined(__CUDACC_RTC__)  // NVRTC has neither <cstddef> nor the builtin
#define SNOW_OFFSET_OF(STRUCT, NAME) __INTADDR__(&(static_cast<STRUCT*>(0)->NAME))
#else
#define SNOW_OFFSET_OF(STRUCT, NAME) __builtin_offsetof(STRUCT, NAME)
#endif

// Used within a struct: lists its members, in order.
#define SNOW_FIELDS(...)                                                     \
  template <class Self, class Text>                                          \
  static constexpr void describe(Text& layout) {                             \
    const int first = layout.fields;                                         \
    SNOW_FOR_EACH(SNOW_DESCRIBE_FIELD, __VA_ARGS__)                          \
    layout.is_complete &= sizeof(Self) == 8 * size_t(layout.fields - first); \
  }
#define SNOW_DESCRIBE_FIELD(NAME)                                                        \
  layout.is_complete &= SNOW_OFFSET_OF(Self, NAME) == 8 * size_t(layout.fields - first); \
  layout.text(#NAME);                                                                    \
  snow::FieldKind<decltype(Self::NAME)>::describe(layout);

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
