// What tiling and blending read of a splat: one cache line (in float), prepared once a frame.
#pragma once

#include <cstdint>

#include "blend.h"

namespace snow {

template <class T>
struct alignas(64) SplatRecord {
  SplatTerms<T> terms;
  T color[kGroupChannels];
  uint16_t tile_x0, tile_y0, tile_x1, tile_y1;  // inclusive; x1 < x0 when the splat is nowhere
};
static_assert(sizeof(SplatRecord<float>) == 64, "one cache line");

}  // namespace snow
