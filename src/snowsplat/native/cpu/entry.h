// Entry points of this library, called by Python.
//
//   SNOW_ENTRY(name, Params) { … }
//
// defines int64_t name(const Params& p), and name_layout(). With the latter, Python checks that its
// struct has the layout of `Params` (see layout.h).
#pragma once

#include "params.h"

#if defined(_WIN32)
#define SNOW_EXPORT extern "C" __declspec(dllexport)
#else
#define SNOW_EXPORT extern "C" __attribute__((visibility("default")))
#endif

#define SNOW_ENTRY(NAME, ...)                                   \
  SNOW_EXPORT uint64_t NAME##_layout() {                        \
    constexpr uint64_t layout = snow::layout_of<__VA_ARGS__>(); \
    return layout;                                              \
  }                                                             \
  SNOW_EXPORT int64_t NAME(const __VA_ARGS__& p)
