// fuse_depth: adds a depth map to a truncated signed distance field, or photos to coloured points.
//
// A task is some batches of samples, so each sum has one thread. A batch is a cube, or as many single
// points. A cube is skipped if the view does not show it, or if all of it is hidden: the depth map is
// reduced to the largest depth of each patch of pixels for this. In a group of samples, positions and
// distances are vectorised; only the loads of pixels are at other places for every sample.
#include "fusion.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"
#include "simd.h"

namespace snow {
namespace {

constexpr int64_t kSamplesPerTask = 8192;
constexpr int kGroup = 64;  // samples; a multiple of every vector
constexpr int kPatch = 16;  // pixels along each side
constexpr int kPointBatch = 512;
constexpr double kSlack = 1e-4;  // relative, and pixels: more than the rounding of positions

template <class T>
T infinity() {
  return std::numeric_limits<T>::infinity();
}

// The largest depth of each patch of the depth map.
template <class T>
class Farthest {
 public:
  explicit Farthest(const FuseDepthParams<T>& p)
      : columns_(int(p.width + kPatch - 1) / kPatch), patches_(size_t(columns_) * rows(p), T(0)) {
    for (int64_t y = 0; y < p.height; y++)
      for (int64_t x = 0; x < p.width; x += kPatch) {
        const T* depth = p.depth + y * p.width + x;
        T most = 0;
        for (int i = 0; i < std::min<int64_t>(kPatch, p.width - x); i++)
          most = std::max(most, depth[i]);
        T& patch = patches_[size_t(y / kPatch * columns_ + x / kPatch)];
        patch = std::max(patch, most);
      }
  }
  // In a rectangle of pixels, which are inside of the depth map.
  T in(int left, int top, int right, int bottom) const {
    T most = 0;
    for (int y = top / kPatch; y <= bottom / kPatch; y++)
      for (int x = left / kPatch; x <= right / kPatch; x++)
        most = std::max(most, patches_[size_t(y * columns_ + x)]);
    return most;
  }

 private:
  static int rows(const FuseDepthParams<T>& p) { return int(p.height + kPatch - 1) / kPatch; }
  int columns_;
  std::vector<T> patches_;
};

// Positions of samples in the image, and z.
template <class T>
struct Positions {
  std::vector<T> u, v, z;
  explicit Positions(int64_t count) : u(size_t(count)), v(size_t(count)), z(size_t(count)) {}

  SNOW_INLINE void set(int i, T x, T y, T depth) {
    u[size_t(i)] = x / depth, v[size_t(i)] = y / depth, z[size_t(i)] = depth;
  }
};

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

  // Whether a sample may be in the image and not behind its surface.
  bool may_count(const FuseDepthParams<T>& p, const Farthest<T>& farthest) const {
    const T last = T(p.side - 1), slack = T(kSlack);
    T left = infinity<T>(), right = -left, top = left, bottom = -left, near = left, far = -left;
    for (int corner = 0; corner < 8; corner++) {
      T at[3];
      for (int c = 0; c < 3; c++)
        at[c] = first[c] + last * (T(corner & 1) * step[0][c] + T(corner >> 1 & 1) * step[1][c] +
                                   T(corner >> 2) * step[2][c]);
      const T u = at[0] / at[2], v = at[1] / at[2];
      left = std::min(left, u), right = std::max(right, u);
      top = std::min(top, v), bottom = std::max(bottom, v);
      near = std::min(near, at[2]), far = std::max(far, at[2]);
    }
    if (!(far > T(0))) return false;
    if (!(near > slack * far)) return true;  // around the camera, corners say nothing
    const T width = T(p.width), height = T(p.height);
    left -= slack * width, right += slack * width, top -= slack * height, bottom += slack * height;
    if (!(right >= T(0) && bottom >= T(0) && left < width && top < height)) return false;
    const int x = int(std::max(left, T(0))), y = int(std::max(top, T(0)));
    const T most =
        farthest.in(x, y, int(std::min(right, width - 1)), int(std::min(bottom, height - 1)));
    return near - slack * far - most < T(p.truncation);
  }

  void positions(int side, Positions<T>& to) const {
    for (int k = 0, at = 0; k < side; k++)
      for (int j = 0; j < side; j++, at += side) {
        T row[3];
        for (int c = 0; c < 3; c++) row[c] = first[c] + T(j) * step[1][c] + T(k) * step[2][c];
        for (int i = 0; i < side; i++)
          to.set(at + i, row[0] + T(i) * step[0][0], row[1] + T(i) * step[0][1],
                 row[2] + T(i) * step[0][2]);
      }
  }
};

template <class T>
void positions_of_points(const FuseDepthParams<T>& p, int64_t begin, int count, Positions<T>& to) {
  T m[12];
  std::copy_n(p.to_image, 12, m);
  const T* point = p.origins + 3 * begin;
  for (int i = 0; i < count; i++) {
    const T x = point[3 * i], y = point[3 * i + 1], z = point[3 * i + 2];
    to.set(i, m[0] * x + m[1] * y + m[2] * z + m[3], m[4] * x + m[5] * y + m[6] * z + m[7],
           m[8] * x + m[9] * y + m[10] * z + m[11]);
  }
}

// Adds to the sums of `count` ≤ kGroup samples.
template <class V, class T = typename V::Scalar>
void fuse_group(const FuseDepthParams<T>& p, const T* u, const T* v, const T* z, int count,
                T* sums) {
  struct Samples {
    T z[kGroup], fx[kGroup], fy[kGroup], weight[kGroup], pixel[4][kGroup];
    int32_t first[kGroup], nearest[kGroup];
  };
  alignas(64) Samples g;
  const int width = int(p.width), height = int(p.height);
  const T right_end = T(width), bottom = T(height);
  int shown = 0;
  for (int i = 0; i < count; i++) {
    const bool inside =
        (z[i] > T(0)) & (u[i] >= T(0)) & (v[i] >= T(0)) & (u[i] < right_end) & (v[i] < bottom);
    const PixelIndex<T> at(width, height, inside ? u[i] : T(0), inside ? v[i] : T(0));
    g.first[i] = at.first, g.nearest[i] = at.nearest(), g.fx[i] = at.fx, g.fy[i] = at.fy;
    g.z[i] = inside ? z[i] : infinity<T>();  // infinitely far away, it is hidden
    shown += inside;
  }
  if (!shown) return;
  const int right = width > 1, below = height > 1 ? width : 0;
  for (int i = 0; i < count; i++) {
    const T* depth = p.depth + g.first[i];
    g.pixel[0][i] = depth[0], g.pixel[1][i] = depth[right];
    g.pixel[2][i] = depth[below], g.pixel[3][i] = depth[below + right];
    g.weight[i] = p.weight[g.nearest[i]];
  }
  for (int i = count; i < kGroup; i++)
    g.z[i] = infinity<T>(), g.weight[i] = 0;  // the rest of the last vector
  const V truncation(p.truncation);
  uint32_t any = 0;
  for (int i = 0; i < count; i += V::width) {
    const FourPixels<V> depths{V::load(g.pixel[0] + i), V::load(g.pixel[1] + i),
                               V::load(g.pixel[2] + i), V::load(g.pixel[3] + i),
                               V::load(g.fx + i),       V::load(g.fy + i)};
    V s;
    const V w = weight_of_sample(depths, V::load(g.z + i), V::load(g.weight + i), truncation,
                                 p.channels > 0, s);
    any |= V::bits(w > V(0.f));
    w.store(g.weight + i), s.store(g.z + i);
  }
  if (!any) return;
  if (p.channels == 0) {
    for (int i = 0; i < count; i++)
      sums[2 * i] += g.weight[i], sums[2 * i + 1] += g.weight[i] * g.z[i];
    return;
  }
  for (int i = 0; i < count; i++, sums += 2 + p.channels) {
    const T w = g.weight[i];
    if (!(w > T(0))) continue;
    sums[0] += w, sums[1] += w * g.z[i];
    add_colours(p, PixelIndex<T>(width, height, u[i], v[i]), w, sums + 2);
  }
}

template <class V, class T = typename V::Scalar>
int64_t fuse(const FuseDepthParams<T>& p) {
  const int64_t samples = p.side * p.side * p.side;
  const int64_t batch = samples > 1 ? samples : kPointBatch;
  const int64_t batches = (p.n + batch - 1) / batch;
  const int64_t per_task = std::max<int64_t>(1, kSamplesPerTask / batch);
  const Farthest<T> farthest(p);
  parallel_for((batches + per_task - 1) / per_task, [&](int64_t task) {
    Positions<T> at(batch);
    const int64_t end = std::min(batches, (task + 1) * per_task);
    for (int64_t i = task * per_task; i < end; i++) {
      const int64_t begin = i * batch, count = std::min(batch, p.n - begin);
      if (samples > 1) {
        const Cube<T> cube(p, i);
        if (!cube.may_count(p, farthest)) continue;
        cube.positions(int(p.side), at);
      } else {
        positions_of_points(p, begin, int(count), at);
      }
      for (int64_t k = 0; k < count; k += kGroup)
        fuse_group<V>(p, &at.u[size_t(k)], &at.v[size_t(k)], &at.z[size_t(k)],
                      int(std::min<int64_t>(kGroup, count - k)),
                      p.sums + (begin + k) * (2 + p.channels));
    }
  });
  return 0;
}

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(fuse_depth, FuseDepthParams<float>) { return fuse<VecF>(p); }
SNOW_ENTRY(fuse_depth_f64, FuseDepthParams<double>) { return fuse<VecD>(p); }
