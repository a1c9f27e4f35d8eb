// Entry points of this library, called by Python.
//
//   SNOW_ENTRY(name, Params) { … }
//
// defines int64_t name(const Params& p), and name_fields(): the text from which Python learns the
// layout of `Params` (see layout.h).
#pragma once

#include "params.h"

#if defined(_WIN32)
#define SNOW_EXPORT extern "C" __declspec(dllexport)
#else
#define SNOW_EXPORT extern "C" __attribute__((visibility("default")))
#endif

#define SNOW_ENTRY(NAME, ...)                                      \
  SNOW_EXPORT const char* NAME##_fields() {                        \
    static constexpr auto layout = snow::layout_of<__VA_ARGS__>(); \
    return layout.characters;                                      \
  }                                                                \
  SNOW_EXPORT int64_t NAME(const __VA_ARGS__& p)
