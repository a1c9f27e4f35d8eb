// neighbours: the exact distances from each point to its k nearest other points, by a k-d tree.
//
// The tree is implicit: the points are reordered so that each node is a range of points. A range is
// split at its median along the widest axis, until it has at most 16 points. Every query starts at
// the root and skips nodes that are too far away, by the distance to the splitting planes.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "cpu/entry.h"
#include "cpu/pool.h"

namespace snow {
namespace {

constexpr int64_t kLeaf = 16;
constexpr int64_t kBlock = 1024;

template <class T>
class Tree {
 public:
  Tree(const T* points, int64_t n) : order_(size_t(n)), nodes_(size_t(node_count(n))) {
    for (int64_t i = 0; i < n; i++) order_[size_t(i)] = int32_t(i);
    // The top of the tree is built serially, until there are enough subtrees for all threads. The
    // subtrees are built in parallel.
    std::vector<Job> jobs = {{0, 0, n}};
    while (!jobs.empty() && int64_t(jobs.size()) < 4 * pool_size()) {
      std::vector<Job> next;
      for (const Job& j : jobs)
        if (j.end - j.begin > kLeaf) {
          const int64_t middle = cut(points, j);
          next.push_back({2 * j.node + 1, j.begin, middle});
          next.push_back({2 * j.node + 2, middle, j.end});
        }
      jobs = next;
    }
    parallel_for(int64_t(jobs.size()), [&](int64_t i) { build(points, jobs[size_t(i)]); });
    xyz_.resize(size_t(3 * n));
    parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
      for (int64_t i = block * kBlock; i < std::min(n, (block + 1) * kBlock); i++)
        for (int k = 0; k < 3; k++)
          xyz_[size_t(3 * i + k)] = points[3 * int64_t(order_[size_t(i)]) + k];
    });
  }

  void query_all(int64_t n, int k, T* distances) const {
    parallel_for((n + kBlock - 1) / kBlock, [&](int64_t block) {
      for (int64_t i = block * kBlock; i < std::min(n, (block + 1) * kBlock); i++) {
        Query q = {&xyz_[size_t(3 * i)], i, k, {}};
        std::fill(q.best, q.best + k, std::numeric_limits<T>::infinity());
        const T offset[3] = {0, 0, 0};
        search(q, {0, 0, n}, 0, offset);
        T* out = distances + int64_t(order_[size_t(i)]) * k;
        for (int j = 0; j < k; j++) out[j] = std::sqrt(q.best[j]);
      }
    });
  }

 private:
  struct Job {
    int64_t node, begin, end;
  };
  struct Node {
    T at;
    int axis;
  };
  struct Query {
    const T* point;
    int64_t self;
    int k;
    T best[kMaxNeighbours];  // squared, ascending
  };

  static int64_t node_count(int64_t n) {
    int64_t nodes = 1;
    for (int64_t width = n; width > kLeaf; width = (width + 1) / 2) nodes = 2 * nodes + 1;
    return nodes;
  }

  int64_t cut(const T* points, const Job& j) {
    T low[3], high[3];
    for (int k = 0; k < 3; k++) low[k] = high[k] = points[3 * int64_t(order_[size_t(j.begin)]) + k];
    for (int64_t i = j.begin; i < j.end; i++)
      for (int k = 0; k < 3; k++) {
        const T x = points[3 * int64_t(order_[size_t(i)]) + k];
        low[k] = std::min(low[k], x), high[k] = std::max(high[k], x);
      }
    int axis = 0;
    for (int k = 1; k < 3; k++)
      if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    const int64_t middle = (j.begin + j.end) / 2;
    std::nth_element(order_.begin() + j.begin, order_.begin() + middle, order_.begin() + j.end,
                     [&](int32_t a, int32_t b) {
                       return points[3 * int64_t(a) + axis] < points[3 * int64_t(b) + axis];
                     });
    nodes_[size_t(j.node)] = {points[3 * int64_t(order_[size_t(middle)]) + axis], axis};
    return middle;
  }
  void build(const T* points, const Job& j) {
    if (j.end - j.begin <= kLeaf) return;
    const int64_t middle = cut(points, j);
    build(points, {2 * j.node + 1, j.begin, middle});
    build(points, {2 * j.node + 2, middle, j.end});
  }

  // `away` = Σ offset² is the squared distance from the point to the node's cell.
  void search(Query& q, const Job& j, T away, const T* offset) const {
    if (away >= q.best[q.k - 1]) return;
    if (j.end - j.begin <= kLeaf) {
      for (int64_t i = j.begin; i < j.end; i++) {
        if (i == q.self) continue;
        const T* p = &xyz_[size_t(3 * i)];
        const T dx = p[0] - q.point[0], dy = p[1] - q.point[1], dz = p[2] - q.point[2];
        const T d = dx * dx + dy * dy + dz * dz;
        if (d >= q.best[q.k - 1]) continue;
        int at = q.k - 1;
        for (; at > 0 && q.best[at - 1] > d; at--) q.best[at] = q.best[at - 1];
        q.best[at] = d;
      }
      return;
    }
    const Node& node = nodes_[size_t(j.node)];
    const int64_t middle = (j.begin + j.end) / 2;
    const Job left = {2 * j.node + 1, j.begin, middle}, right = {2 * j.node + 2, middle, j.end};
    const T to_plane = q.point[node.axis] - node.at;
    T far_offset[3] = {offset[0], offset[1], offset[2]};
    far_offset[node.axis] = to_plane;
    const T far_away = far_offset[0] * far_offset[0] + far_offset[1] * far_offset[1] +
                       far_offset[2] * far_offset[2];
    search(q, to_plane < 0 ? left : right, away, offset);
    search(q, to_plane < 0 ? right : left, far_away, far_offset);
  }

  std::vector<int32_t> order_;
  std::vector<Node> nodes_;
  std::vector<T> xyz_;
};

}  // namespace
}  // namespace snow

using namespace snow;

template <class T>
static int64_t find(const NeighboursParams<T>& p) {
  if (p.n > 0) Tree<T>(p.points, p.n).query_all(p.n, int(p.k), p.distances);
  return 0;
}

SNOW_ENTRY(neighbours, NeighboursParams<float>) { return find(p); }
SNOW_ENTRY(neighbours_f64, NeighboursParams<double>) { return find(p); }
