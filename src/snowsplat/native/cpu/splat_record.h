// The data of a splat that the rasterizer reads: one cache line (in float), prepared once per frame.
#pragma once

#include "rasterize.h"

namespace snow {

template <class T>
struct alignas(64) SplatRecord {
  SplatTerms<T> terms;
  T color[kGroupChannels];
  uint16_t tile_x0, tile_y0, tile_x1, tile_y1;  // inclusive; x1 < x0 if the splat is not visible
};
static_assert(sizeof(SplatRecord<float>) == 64, "one cache line");

}  // namespace snow
