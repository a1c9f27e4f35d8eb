// For ThreadSanitizer, by tests/nightly/sanitize_native.py: a frame forward and backward and an Adam
// step on random Gaussians, by several threads, while other threads do the same and the number of threads
// changes. The results must be bit-identical each time.
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <random>
#include <thread>
#include <vector>

#define ENTRY extern "C" int64_t
using F = float;
using U = uint32_t;
ENTRY set_num_threads(int64_t);
ENTRY neighbours(int64_t, const F*, int64_t, F*);
ENTRY project_cull(int64_t, const F*, const F*, const F*, const F*, const F*, double, double,
                   double, double, double, double, double, int32_t*);
ENTRY project_fwd(int64_t, const int32_t*, const F*, const F*, const F*, const F*, const F*,
                  const F*, int64_t, int64_t, const F*, double, double, double, double, double,
                  double, double, F*);
ENTRY splat_record_bytes(int64_t);
ENTRY splats_prepare(int64_t, const F*, int64_t, double, double, const int64_t*, void*, U*);
ENTRY splats_sort(int64_t, U*, U*, U*, U*);
ENTRY tiles_parts(int64_t);
ENTRY tiles_workspace_bytes(int64_t, int64_t, int64_t);
ENTRY tiles_count(int64_t, const U*, const F*, int64_t, const void*, int64_t, int64_t, int64_t,
                  void*, U*, int64_t, int64_t*);
ENTRY tiles_fill(int64_t, const U*, const F*, int64_t, const void*, int64_t, int64_t, int64_t,
                 void*, U*, int64_t, U*, U*, U*);
ENTRY blend_block_bytes(int64_t);
ENTRY blend_fwd(int64_t, int64_t, int64_t, const F*, int64_t, const int64_t*, const void*, const U*,
                U*, const U*, void*, int64_t, const F*, F*, F*);
ENTRY blend_bwd(int64_t, int64_t, int64_t, const F*, int64_t, const int64_t*, const void*, const U*,
                U*, const U*, void*, int64_t, const U*, const F*, const F*, const F*, const F*, F*,
                F*);
ENTRY splats_reduce(int64_t, const F*, const U*, const F*, int64_t, int64_t, const int64_t*,
                    int64_t, F*);
ENTRY photometric(int64_t, int64_t, int64_t, const F*, const F*, double, double, F*, double*);

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

std::vector<F> frame(const Scene& s) {
  const F pose[12] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};
  const double w = kWidth, h = kHeight, f = 150;
  std::vector<int32_t> ids(kCount);
  const int64_t m = project_cull(kCount, s.means.data(), s.log_scales.data(), s.quats.data(),
                                 s.logits.data(), pose, w, h, f, f, w / 2, h / 2, 0.2, ids.data());
  std::vector<F> packed(size_t(m * kStride)), grad(packed.size());
  project_fwd(m, ids.data(), s.means.data(), s.log_scales.data(), s.quats.data(), s.logits.data(),
              s.dc.data(), s.rest.data(), 15, 3, pose, w, h, f, f, w / 2, h / 2, 0.2,
              packed.data());
  const int64_t columns[4] = {8, 9, 10, -1};
  std::vector<double> aligned(size_t(splat_record_bytes(0) * m / 8 + 8));  // 64 bytes, see below
  void* records = (void*)(((uintptr_t)aligned.data() + 63) & ~uintptr_t(63));
  std::vector<U> keys(size_t(m), 0), keys2(keys), order(keys), order2(keys);
  splats_prepare(m, packed.data(), kStride, w, h, columns, records, keys.data());
  splats_sort(m, keys.data(), keys2.data(), order.data(), order2.data());
  const int64_t tx = (kWidth + 15) / 16, ty = (kHeight + 15) / 16, tiles = tx * ty;
  const int64_t parts = tiles_parts(m);
  std::vector<double> workspace(size_t(tiles_workspace_bytes(m, tiles, parts) / 8 + 1));
  std::vector<U> start(size_t(tiles + 1)), end(size_t(tiles), 0), range(size_t(2 * m));
  int64_t needed = 0;
  const int64_t n = tiles_count(m, order.data(), packed.data(), kStride, records, tx, ty, parts,
                                workspace.data(), start.data(), -1, &needed);
  std::vector<U> splat(size_t(n), 0), slot(splat);
  tiles_fill(m, order.data(), packed.data(), kStride, records, tx, ty, parts, workspace.data(),
             start.data(), n, splat.data(), slot.data(), range.data());
  std::vector<double> blocks(size_t(n * blend_block_bytes(0) / 8 + 1));
  const int64_t pixels = kWidth * kHeight;
  std::vector<F> image(size_t(3 * pixels)), alpha(image.size() / 3), d_image(image.size());
  const F background[4] = {0, 0, 0, 0};
  blend_fwd(tiles, kWidth, kHeight, packed.data(), kStride, columns, records, start.data(),
            end.data(), splat.data(), blocks.data(), 3, background, image.data(), alpha.data());
  double means[2];
  photometric(3, kWidth, kHeight, image.data(), s.target.data(), 0.8, -0.2, d_image.data(), means);
  std::vector<F> slots(size_t(16 * n + 16));
  F* aligned_slots = (F*)(((uintptr_t)slots.data() + 63) & ~uintptr_t(63));
  blend_bwd(tiles, kWidth, kHeight, packed.data(), kStride, columns, records, start.data(),
            end.data(), splat.data(), blocks.data(), 3, slot.data(), image.data(), d_image.data(),
            alpha.data(), nullptr, aligned_slots, nullptr);
  splats_reduce(m, aligned_slots, range.data(), packed.data(), kStride, 3, columns, 0, grad.data());
  std::vector<F> near(size_t(3 * kCount));
  neighbours(kCount, s.means.data(), 3, near.data());
  grad.insert(grad.end(), image.begin(), image.end());
  grad.insert(grad.end(), near.begin(), near.end());
  return grad;
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
