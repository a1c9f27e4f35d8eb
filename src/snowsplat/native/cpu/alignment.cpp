// align_patches: for each pair of patches the affine transform that maps the window of the first one
// onto the second one, with a gain and an offset of the grey values.
//
// This is the inverse compositional algorithm of Baker and Matthews, "Lucas-Kanade 20 years on: a
// unifying framework", IJCV 2004: the gradients are those of the first patch, so the normal
// equations are the same in all iterations. Pairs are independent, so the number of threads does not
// change the result.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int kRadius = kAlignmentRadius, kWindow = 2 * kRadius + 1, kPixels = kWindow * kWindow;
constexpr int kUnknowns = 8;  // two rows of the change of the transform, gain, offset
constexpr int kGain = 6;
constexpr float kSigma = 0.5f * kRadius;  // of the Gaussian weights in the window
constexpr int kIterations = 10;
constexpr float kTolerance = 0.005f;  // pixels; smaller changes of the corners end the iterations
constexpr float kLargestStretch = 100;
constexpr float kLeastGain = 0.3f, kLargestGain = 3.0f;
constexpr double kDamping = 1e-4, kSmallest = 1e-3;  // relative to, and added to, the diagonal
constexpr int64_t kBlock = 64;                       // pairs of a task

// Maps (u, v) in the window of the first patch to a position in the second patch, both relative to
// the centres: (a u + b v + c, d u + e v + f).
struct Affine {
  float a = 1, b = 0, c = 0, d = 0, e = 1, f = 0;
};

// Coordinates of the pixels of the window, and their weights.
struct Window {
  float u[kPixels], v[kPixels], weight[kPixels];

  Window() {
    float sum = 0;
    for (int i = 0; i < kPixels; i++) {
      u[i] = float(i % kWindow - kRadius), v[i] = float(i / kWindow - kRadius);
      weight[i] = std::exp(-(u[i] * u[i] + v[i] * v[i]) / (2 * kSigma * kSigma));
      sum += weight[i];
    }
    for (float& w : weight) w /= sum;
  }
};

// The Cholesky factorisation of a symmetric positive definite matrix.
class Cholesky {
 public:
  template <class Matrix>
  explicit Cholesky(const Matrix& matrix) {
    for (int i = 0; i < kUnknowns; i++)
      for (int j = 0; j <= i; j++) {
        double sum = matrix[i][j];
        for (int k = 0; k < j; k++) sum -= l_[i][k] * l_[j][k];
        l_[i][j] = i == j ? std::sqrt(sum) : sum / l_[j][j];
      }
  }

  void solve(double (&x)[kUnknowns]) const {
    for (int i = 0; i < kUnknowns; i++) {
      for (int k = 0; k < i; k++) x[i] -= l_[i][k] * x[k];
      x[i] /= l_[i][i];
    }
    for (int i = kUnknowns - 1; i >= 0; i--) {
      for (int k = i + 1; k < kUnknowns; k++) x[i] -= l_[k][i] * x[k];
      x[i] /= l_[i][i];
    }
  }

 private:
  double l_[kUnknowns][kUnknowns] = {};
};

// The window of a first patch, which is aligned with several second ones.
class Template {
 public:
  Template(const Window& window, const uint8_t* first, int side) : window_(window), side_(side) {
    const uint8_t* start = first + (side / 2 - kRadius) * (side + 1);
    for (int i = 0; i < kPixels; i++) {
      const uint8_t* at = start + i / kWindow * side + i % kWindow;
      const float gx = 0.5f * float(at[1] - at[-1]), gy = 0.5f * float(at[side] - at[-side]);
      const float column[kUnknowns] = {gx * window.u[i],
                                       gx * window.v[i],
                                       gx,
                                       gy * window.u[i],
                                       gy * window.v[i],
                                       gy,
                                       float(*at),
                                       1.0f};
      for (int k = 0; k < kUnknowns; k++) jacobian_[k][i] = column[k];
    }
    normal_.emplace(normal_matrix());
  }

  // The transform; returns the weighted correlation of the window and the ``second`` patch.
  float align(const float* second, Affine& affine) const {
    float values[kPixels];
    for (int i = 0; i < kIterations; i++) {
      sample(second, affine, values);
      double x[kUnknowns];
      for (int k = 0; k < kUnknowns; k++) x[k] = dot(jacobian_[k], values);
      normal_->solve(x);
      const float gain = std::clamp(float(x[kGain]), kLeastGain, kLargestGain);
      float change[6];
      for (int k = 0; k < 6; k++) change[k] = float(x[k]) / gain;
      compose_with_inverse(affine, change);
      if (!is_valid(affine)) return affine = Affine(), -1.0f;
      const float* q = change;
      const float moved = std::max(kRadius * (std::abs(q[0]) + std::abs(q[1])) + std::abs(q[2]),
                                   kRadius * (std::abs(q[3]) + std::abs(q[4])) + std::abs(q[5]));
      if (!(moved >= kTolerance)) break;
    }
    sample(second, affine, values);
    return correlation(values);
  }

 private:
  using Matrix = std::array<std::array<double, kUnknowns>, kUnknowns>;

  Matrix normal_matrix() const {
    Matrix matrix;
    for (int i = 0; i < kUnknowns; i++)
      for (int j = 0; j <= i; j++) matrix[i][j] = dot(jacobian_[i], jacobian_[j]);
    for (int i = 0; i < kUnknowns; i++) matrix[i][i] += kDamping * matrix[i][i] + kSmallest;
    return matrix;
  }

  float dot(const float* a, const float* b) const {
    constexpr int lanes = 16;  // partial sums, which the compiler keeps in vectors
    float sums[lanes] = {};
    for (int i = 0; i + lanes <= kPixels; i += lanes)
      for (int l = 0; l < lanes; l++) sums[l] += window_.weight[i + l] * a[i + l] * b[i + l];
    for (int i = kPixels / lanes * lanes; i < kPixels; i++)
      sums[0] += window_.weight[i] * a[i] * b[i];
    float sum = 0;
    for (float s : sums) sum += s;
    return sum;
  }

  // The grey values of the second patch at the transformed positions, bilinear. Outside of the
  // patch, those at its border. They are float, so that compilers use vectors.
  void sample(const float* __restrict second, const Affine& t, float* __restrict values) const {
    const float middle = float(side_ / 2), last = float(side_ - 1);
    for (int i = 0; i < kPixels; i++) {
      const float u = window_.u[i], v = window_.v[i];
      const float x = std::min(std::max(t.a * u + t.b * v + t.c + middle, 0.0f), last);
      const float y = std::min(std::max(t.d * u + t.e * v + t.f + middle, 0.0f), last);
      const int column = std::min(int(x), side_ - 2), row = std::min(int(y), side_ - 2);
      const float p = x - float(column), q = y - float(row);
      const int at = row * side_ + column;
      const float upper = second[at] + p * (second[at + 1] - second[at]);
      const float lower = second[at + side_] + p * (second[at + side_ + 1] - second[at + side_]);
      values[i] = upper + q * (lower - upper);
    }
  }

  // affine ∘ (identity + change)⁻¹
  static void compose_with_inverse(Affine& t, const float (&q)[6]) {
    const float a = 1 + q[0], b = q[1], d = q[3], e = 1 + q[4];
    const float scale = 1 / (a * e - b * d);
    const float ia = e * scale, ib = -b * scale, id = -d * scale, ie = a * scale;
    const float ic = -(ia * q[2] + ib * q[5]), jf = -(id * q[2] + ie * q[5]);
    t = {t.a * ia + t.b * id, t.a * ib + t.b * ie, t.a * ic + t.b * jf + t.c,
         t.d * ia + t.e * id, t.d * ib + t.e * ie, t.d * ic + t.e * jf + t.f};
  }

  // Whether the centre of the window is inside of the second patch, and the window is not stretched
  // very much. False if a number is NaN.
  bool is_valid(const Affine& t) const {
    const float half = float(side_ / 2);
    bool valid = std::abs(t.c) <= half && std::abs(t.f) <= half;
    for (float x : {t.a, t.b, t.d, t.e}) valid = valid && std::abs(x) <= kLargestStretch;
    return valid;
  }

  float correlation(const float* values) const {
    const float *first = jacobian_[kGain], *ones = jacobian_[kGain + 1];
    const float mean1 = dot(first, ones), mean2 = dot(values, ones);
    const float variance1 = dot(first, first) - mean1 * mean1;
    const float variance2 = dot(values, values) - mean2 * mean2;
    const float product = variance1 * variance2;
    return product > 0 ? (dot(first, values) - mean1 * mean2) / std::sqrt(product) : -1.0f;
  }

  const Window& window_;
  const int side_;
  float jacobian_[kUnknowns][kPixels];
  std::optional<Cholesky> normal_;
};

}  // namespace
}  // namespace snow

using namespace snow;

SNOW_ENTRY(align_patches, AlignPatchesParams) {
  const Window window;
  const int64_t size = p.side * p.side;
  parallel_for((p.n + kBlock - 1) / kBlock, [&](int64_t block) {
    std::vector<float> second(size);
    std::optional<Template> first;
    for (int64_t i = block * kBlock; i < std::min(p.n, (block + 1) * kBlock); i++) {
      if (!first || p.pairs[2 * i] != p.pairs[2 * i - 2])
        first.emplace(window, p.patches + size * p.pairs[2 * i], int(p.side));
      std::copy_n(p.patches + size * p.pairs[2 * i + 1], size, second.begin());
      Affine t;
      p.correlation[i] = first->align(second.data(), t);
      const float values[6] = {t.a, t.b, t.c, t.d, t.e, t.f};
      std::copy_n(values, 6, p.transform + 6 * i);
    }
  });
  return 0;
}
