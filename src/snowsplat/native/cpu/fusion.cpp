// fuse_depth: adds a depth map to a truncated signed distance field, or photos to coloured points.
//
// A task is some cubes of samples, so each sum has one thread. The positions of a cube are linear in
// the indices of its samples; this loop is vectorised by the compiler. The loop after it reads the
// depth map at other places for every sample.
#include "fusion.h"

#include <algorithm>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kSamplesPerTask = 4096;

// K [R | t] at a cube: a sample (i, j, k) is at (u z, v z, z) = first + i x + j y + k z.
template <class T>
struct Cube {
  T first[3], step[3][3];

  Cube(const FuseDepthParams<T>& p, int64_t cube) {
    const T* origin = p.origins + 3 * cube;
    for (int c = 0; c < 3; c++) {
      const T* row = p.to_image + 4 * c;
      first[c] = row[0] * origin[0] + row[1] * origin[1] + row[2] * origin[2] + row[3];
      for (int axis = 0; axis < 3; axis++) step[axis][c] = row[axis] * T(p.spacing);
    }
  }

  // Whether all samples are on the outer side of one of the planes around the view.
  bool is_outside(const FuseDepthParams<T>& p) const {
    const T width = T(p.width), height = T(p.height), last = T(p.side - 1);
    const T planes[5][3] = {
        {1, 0, 0}, {-1, 0, width}, {0, 1, 0}, {0, -1, height}, {0, 0, 1}};  // inside: n · q > 0
    for (const T* n : planes) {
      const auto side = [&](const T* q) { return n[0] * q[0] + n[1] * q[1] + n[2] * q[2]; };
      T most = side(first);
      for (int axis = 0; axis < 3; axis++) most += max(T(0), side(step[axis])) * last;
      if (!(most > T(0))) return true;
    }
    return false;
  }
};

template <class T>
void fuse_cube(const FuseDepthParams<T>& p, int64_t index, std::vector<T>& buffer) {
  const Cube<T> cube(p, index);
  if (cube.is_outside(p)) return;
  const int side = int(p.side), samples = side * side * side;
  T *u = buffer.data(), *v = u + samples, *z = v + samples;
  for (int k = 0, at = 0; k < side; k++)
    for (int j = 0; j < side; j++, at += side) {
      T row[3];
      for (int c = 0; c < 3; c++)
        row[c] = cube.first[c] + T(j) * cube.step[1][c] + T(k) * cube.step[2][c];
      for (int i = 0; i < side; i++) {
        z[at + i] = row[2] + T(i) * cube.step[0][2];
        u[at + i] = (row[0] + T(i) * cube.step[0][0]) / z[at + i];
        v[at + i] = (row[1] + T(i) * cube.step[0][1]) / z[at + i];
      }
    }
  const T width = T(p.width), height = T(p.height);
  T* sums = p.sums + index * samples * (2 + p.channels);
  for (int i = 0; i < samples; i++, sums += 2 + p.channels)
    if (z[i] > T(0) && u[i] >= T(0) && v[i] >= T(0) && u[i] < width && v[i] < height)
      fuse_sample(p, u[i], v[i], z[i], sums);
}

template <class T>
int64_t fuse(const FuseDepthParams<T>& p) {
  const int64_t samples = p.side * p.side * p.side, cubes = p.n / samples;
  const int64_t per_task = std::max<int64_t>(1, kSamplesPerTask / samples);
  parallel_for((cubes + per_task - 1) / per_task, [&](int64_t task) {
    std::vector<T> buffer(size_t(3 * samples));
    const int64_t end = std::min(cubes, (task + 1) * per_task);
    for (int64_t i = task * per_task; i < end; i++) fuse_cube(p, i, buffer);
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(fuse_depth, FuseDepthParams<float>) { return fuse(p); }
SNOW_ENTRY(fuse_depth_f64, FuseDepthParams<double>) { return fuse(p); }
