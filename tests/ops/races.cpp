// tests/nightly/sanitize_native.py runs this program under ThreadSanitizer. `frame` calls the
// kernels of a training step on random Gaussians: forward pass, backward pass and Adam. Three
// threads call `frame` at the same time. The kernels share a pool of threads, and the test is
// repeated with pools of different sizes. The results must always be bit-identical.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <random>
#include <thread>
#include <vector>

#include "params.h"

using namespace snow;
using F = float;
using U = uint32_t;

#define ENTRY(NAME, ...) extern "C" int64_t NAME(const __VA_ARGS__&)
extern "C" int64_t set_num_threads(int64_t);
ENTRY(neighbours, NeighboursParams<F>);
ENTRY(plane_sweep, PlaneSweepParams<F>);
ENTRY(project_cull, ProjectCullParams<F>);
ENTRY(project_fwd, ProjectForwardParams<F>);
ENTRY(splat_record_bytes, SizeQueryParams);
ENTRY(splats_prepare, SplatsPrepareParams<F>);
ENTRY(splats_sort, SplatsSortParams<F>);
ENTRY(tiles_parts, SizeQueryParams);
ENTRY(tiles_workspace_bytes, SizeQueryParams);
ENTRY(tiles_count, TilesCountParams<F>);
ENTRY(tiles_fill, TilesFillParams<F>);
ENTRY(rasterize_block_bytes, SizeQueryParams);
ENTRY(rasterize_fwd, RasterizeForwardParams<F>);
ENTRY(rasterize_bwd, RasterizeBackwardParams<F>);
ENTRY(photometric, PhotometricParams<F, F>);
ENTRY(adam_step, AdamStepParams<F>);

namespace {

constexpr int64_t kCount = 20000, kWidth = 200, kHeight = 120, kStride = 16;

struct Scene {
  std::vector<F> means, log_scales, quats, logits, dc, rest, target;
  explicit Scene(unsigned seed) {
    std::mt19937 random(seed);
    std::uniform_real_distribution<F> u(-1, 1);
    auto fill = [&](std::vector<F>& v, int64_t n, F scale, F shift) {
      v.resize(size_t(n));
      for (F& x : v) x = scale * u(random) + shift;
    };
    fill(means, 3 * kCount, 1, 0), fill(log_scales, 3 * kCount, 1, -4),
        fill(quats, 4 * kCount, 1, 0);
    fill(logits, kCount, 3, 0), fill(dc, 3 * kCount, 1, 0), fill(rest, 45 * kCount, F(0.1), 0);
    fill(target, 3 * kWidth * kHeight, F(0.5), F(0.5));
    for (int64_t i = 0; i < kCount; i++) means[size_t(3 * i + 2)] += 3;
  }
};

// An array that begins at a multiple of 64 bytes, like the tensors that PyTorch allocates.
template <class T>
struct Aligned {
  std::vector<char> bytes;
  T* data;
  explicit Aligned(int64_t n) : bytes(size_t(n) * sizeof(T) + 64) {
    data = (T*)(((uintptr_t)bytes.data() + 63) & ~uintptr_t(63));
  }
};

// A copy of a parameter tensor, and the two moments that Adam stores for it.
struct Tensor {
  std::vector<F> value, m, v;
  explicit Tensor(const std::vector<F>& from) : value(from), m(from.size()), v(from.size()) {}
  AdamTensor<F> with_rate(double rate) { return {value.data(), m.data(), v.data(), nullptr, rate}; }
};

std::vector<F> frame(const Scene& s) {
  const F pose[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
  const double f = 150;
  const CameraParams<F> camera = {pose, kWidth, kHeight, f, f, kWidth / 2.0, kHeight / 2.0, 0.2, 1};
  const GaussianTensors<F> gaussians = {s.means.data(),
                                        s.log_scales.data(),
                                        s.quats.data(),
                                        s.logits.data(),
                                        s.dc.data(),
                                        s.rest.data(),
                                        15,
                                        3};
  std::vector<int32_t> ids(kCount);
  const int64_t m = project_cull({kCount, gaussians, camera, ids.data()});
  std::vector<F> packed(size_t(m * kStride)), grad(packed.size()), abs_grad(size_t(2 * m));
  project_fwd({m, ids.data(), gaussians, camera, packed.data()});

  const int64_t columns[4] = {8, 9, 10, -1};
  Aligned<char> memory(splat_record_bytes({0, 0, 0}) * m);
  auto* records = (SplatRecord<F>*)memory.data;
  std::vector<U> keys(size_t(m), 0), keys2(keys), order(keys), order2(keys);
  splats_prepare({m, packed.data(), kStride, kWidth, kHeight, columns, records, keys.data()});
  splats_sort({m, keys.data(), keys2.data(), order.data(), order2.data()});

  const int64_t tx = (kWidth + 15) / 16, ty = (kHeight + 15) / 16, tiles = tx * ty;
  const int64_t parts = tiles_parts({m, 0, 0});
  Aligned<char> workspace(tiles_workspace_bytes({m, tiles, parts}));
  std::vector<U> start(size_t(tiles + 1)), end(size_t(tiles), 0);
  int64_t needed = 0;
  const TileBinning<F> binning = {order.data(), packed.data(), kStride,        records,     tx,
                                  ty,           parts,         workspace.data, start.data()};
  const int64_t n = tiles_count({m, binning, -1, &needed});
  std::vector<U> splat(size_t(n), 0);
  tiles_fill({m, binning, n, splat.data(), nullptr, nullptr});

  Aligned<char> blocks(n * rasterize_block_bytes({0, 0, 0}));
  const FrameParams<F> sorted = {kWidth,  kHeight,      packed.data(), kStride,      columns,
                                 records, start.data(), end.data(),    splat.data(), blocks.data,
                                 0};
  const int64_t pixels = kWidth * kHeight;
  std::vector<F> image(size_t(3 * pixels)), alpha(image.size() / 3), d_image(image.size());
  const F background[4] = {0, 0, 0, 0};
  rasterize_fwd({tiles, sorted, 3, background, image.data(), alpha.data(), nullptr});
  double means[2];
  photometric(
      {3, kWidth, kHeight, image.data(), s.target.data(), 0.8, -0.2, d_image.data(), means});
  rasterize_bwd({tiles, sorted, 3, nullptr, image.data(), d_image.data(), nullptr, alpha.data(),
                 nullptr, nullptr, grad.data(), abs_grad.data()});

  Tensor centres(s.means), scales(s.log_scales), quats(s.quats), logits(s.logits), dc(s.dc);
  Tensor rest(s.rest);
  int32_t nonfinite[6] = {};
  adam_step({kCount,
             m,
             ids.data(),
             grad.data(),
             camera,
             15,
             3,
             centres.with_rate(1e-3),
             scales.with_rate(1e-3),
             quats.with_rate(1e-3),
             logits.with_rate(1e-3),
             dc.with_rate(1e-3),
             rest.with_rate(1e-3),
             0.9,
             0.999,
             1000,
             1e-30,
             0,
             nullptr,
             nonfinite});
  std::vector<F> near(size_t(3 * kCount));
  neighbours({kCount, s.means.data(), 3, near.data()});
  // The three channels of the target are the view and two sources.
  const F from_pixel[24] = {1, 0, 0, 9, 0, 1, 0, 0, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 9, 0, 0, 1, 0};
  std::vector<F> swept(size_t(2 * pixels));
  const F* view = s.target.data();
  plane_sweep({2, kWidth, kHeight, kWidth, kHeight, view, view + pixels, from_pixel, nullptr, 0,
               0.25, 5, 3, swept.data(), swept.data() + pixels});

  std::vector<F> results = grad;
  for (const Tensor* t : {&centres, &scales, &quats, &logits, &dc, &rest})
    results.insert(results.end(), t->value.begin(), t->value.end());
  results.insert(results.end(), abs_grad.begin(), abs_grad.end());
  results.insert(results.end(), image.begin(), image.end());
  results.insert(results.end(), near.begin(), near.end());
  results.insert(results.end(), swept.begin(), swept.end());
  return results;
}

}  // namespace

int main() {
  const Scene scene(1);
  set_num_threads(1);
  const std::vector<F> expected = frame(scene);
  int frames = 0, wrong = 0;
  for (int threads : {2, 4, 3, 1, 4}) {
    set_num_threads(threads);
    std::vector<std::vector<F>> found(3);
    std::vector<std::thread> callers;
    for (auto& result : found) callers.emplace_back([&] { result = frame(scene); });
    for (auto& caller : callers) caller.join();
    for (const auto& result : found) {
      frames++;
      wrong += result.size() != expected.size() ||
               std::memcmp(result.data(), expected.data(), sizeof(F) * expected.size()) != 0;
    }
  }
  std::printf("%d frames by 1 to 4 threads for 3 callers at once, %d differ", frames, wrong);
  return wrong != 0;
}
