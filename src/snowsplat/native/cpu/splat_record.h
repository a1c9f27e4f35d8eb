// The data of a splat for the rasterizer. It is prepared once per frame, and has the size of one
// cache line in float.
#pragma once

#include "rasterize.h"

namespace snow {

template <class T>
struct alignas(64) SplatRecord {
  SplatTerms<T> terms;
  T color[kGroupChannels], opacity;
  uint16_t tile_x0, tile_y0, tile_x1, tile_y1;  // inclusive; x1 < x0 if the splat is not visible
};
static_assert(sizeof(SplatRecord<float>) == 64, "one cache line");

}  // namespace snow
