"""Fewer Gaussians that look the same: neighbours are merged, two at a time.

Two Gaussians are replaced by one with the mean and the covariance of both together. In every pass,
the pairs that lose least are merged, at most a quarter of the scene; a merged Gaussian can be
merged again in the next pass.

The candidates for a partner are close in a Morton order. In every pass the grid of this order has
another orientation, so two neighbours that are on different sides of a border meet in another pass.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, quat_from_rotation, rotation_from_quat

# Candidates for a partner: so many that follow in the Morton order, and as many before.
_NEIGHBOURS = 8
# Largest share of the Gaussians that one pass removes.
_SHARE = 0.25
# The cost considers a Gaussian as at least this thick, relative to its largest extent. The cost
# depends on volumes, and would otherwise protect thin Gaussians, although nobody sees a thickness.
_THICKNESS = 0.001
# Gaussians that are compared at a time, so that the intermediate results fit into the cache.
_CHUNK = 1 << 15
# The rotation of the grid between two passes, about an axis that is no axis of the grid.
_TURN = rotation_from_quat(torch.tensor([[0.9, 0.25, -0.31, 0.17]], dtype=torch.float64))[0]
# Largest opacity of a merged Gaussian: its logit is finite.
_MAX_OPACITY = 0.9999
# The entries of a symmetric matrix that are stored.
_ENTRIES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@torch.no_grad()
def simplify(gaussians: Gaussians, count: int) -> Gaussians:
    """``count`` Gaussians that look like ``gaussians``; neighbours are merged.

    The means and covariances of a pair are merged by their moments, with the weights w = opacity ×
    area. The opacity preserves opacity × area, and the SH coefficients are the weighted mean. The
    cost of a pair is the increase of the entropy, ½ (log |Σ| − w₁ log |Σ₁| − w₂ log |Σ₂|), plus the
    squared difference of the SH coefficients. It has no unit, so small and large Gaussians are
    merged alike. Gaussians that are not merged do not change.

    Args:
        gaussians: N Gaussians on the CPU. Those that are not finite are removed first.
        count: how many to keep. If it is at least N, the result is ``gaussians``.

    References:
        Runnalls 2007, Kullback-Leibler approach to Gaussian mixture reduction (the cost).
        Kerbl et al. 2024, A hierarchical 3D Gaussian representation (the weights).
    """
    if count >= len(gaussians):
        return gaussians
    if count <= 0:
        return gaussians.select(torch.empty(0, dtype=torch.int64))
    gaussians = gaussians.select(gaussians.finite_rows())
    mixture, turn = _Mixture.of(gaussians), torch.eye(3, dtype=torch.float64)
    while len(mixture) > count:
        mixture = mixture.select(morton_order(mixture.means.T @ turn))
        surplus = min(len(mixture) - count, max(1, int(_SHARE * len(mixture))))
        mixture = _merge(mixture, *_cheapest_pairs(_costs(mixture), surplus))
        turn = turn @ _TURN
    return mixture.gaussians(gaussians)


@dataclass
class _Mixture:
    """N Gaussians by their moments; the last dimension of each tensor is N.

    ===========  ==================  ==========================================================
    means        (3, N) float64
    covariances  (6, N) float64      as in `_ENTRIES`
    opacities    (N,) float64
    colors       (3 + 3 K, N)        all SH coefficients
    origins      (N,) int64          the row in the original scene; −1 for a merged Gaussian
    ===========  ==================  ==========================================================
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    origins: Tensor

    @staticmethod
    def of(gaussians: Gaussians) -> _Mixture:
        axes = rotation_from_quat(gaussians.rotations.double()) * gaussians.scales.double()[:, None]
        return _Mixture(
            gaussians.means.double().T.contiguous(),
            torch.stack([(axes[:, i] * axes[:, j]).sum(1) for i, j in _ENTRIES]),
            gaussians.opacities.double(),
            torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1).flatten(1).T.contiguous(),
            torch.arange(len(gaussians)),
        )

    def __len__(self) -> int:
        return len(self.opacities)

    def select(self, index: Tensor | slice) -> _Mixture:
        return _Mixture(*(getattr(self, field.name)[..., index] for field in fields(self)))

    def append(self, other: _Mixture) -> _Mixture:
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return _Mixture(*(torch.cat(pair, -1) for pair in pairs))

    def areas(self) -> Tensor:
        """(N,) a mean area of the projections: the root of λ₁λ₂ + λ₂λ₃ + λ₃λ₁, eigenvalues of Σ."""
        xx, yy, zz, xy, xz, yz = self.covariances
        return (xx * yy + yy * zz + zz * xx - xy * xy - xz * xz - yz * yz).clamp_min(0.0).sqrt()

    def gaussians(self, original: Gaussians) -> Gaussians:
        """The Gaussians of this mixture; those with an origin are rows of ``original``."""
        merged = self.select(self.origins < 0)
        matrices = torch.empty(len(merged), 3, 3, dtype=torch.float64)
        for (i, j), entry in zip(_ENTRIES, merged.covariances, strict=True):
            matrices[:, i, j] = matrices[:, j, i] = entry
        variances, axes = torch.linalg.eigh(matrices)
        axes = axes * torch.linalg.det(axes).sign()[:, None, None]  # a rotation, no reflection
        # Rounding can make the smallest eigenvalue of a flat Gaussian negative.
        variances = variances.clamp_min(1e-12 * variances[:, 2:]).clamp_min(1e-30)
        coefficients = merged.colors.T.reshape(len(merged), len(merged.colors) // 3, 3)
        values = {
            "means": merged.means.T,
            "log_scales": variances.log() / 2,
            "quats": quat_from_rotation(axes),
            "opacity_logits": merged.opacities.logit(),
            "sh_dc": coefficients[:, :1],
            "sh_rest": coefficients[:, 1:],
        }
        dtype = original.means.dtype
        kept = original.select(self.origins[self.origins >= 0])
        return kept.append(Gaussians(**{n: v.to(dtype).contiguous() for n, v in values.items()}))


def _costs(mixture: _Mixture) -> Tensor:
    """(`_NEIGHBOURS`, N) float32: what is lost by merging Gaussian i with Gaussian i + 1 + row."""
    count = len(mixture)
    costs = torch.full((min(_NEIGHBOURS, count - 1), count), torch.inf)
    masses = mixture.opacities * mixture.areas()
    entropies = _entropy(mixture.covariances)
    for row in range(len(costs)):
        for start in range(0, count - row - 1, _CHUNK):
            a = slice(start, min(start + _CHUNK, count - row - 1))
            b = slice(a.start + row + 1, a.stop + row + 1)
            weight = _weight(masses[b], masses[a])
            offset = mixture.means[:, b] - mixture.means[:, a]
            both = _covariance(mixture.covariances[:, a], mixture.covariances[:, b], offset, weight)
            shape = _entropy(both) - torch.lerp(entropies[a], entropies[b], weight)
            color = (mixture.colors[:, b] - mixture.colors[:, a]).square().sum(0)
            costs[row, a] = (shape + color).float()
    return costs


def _cheapest_pairs(costs: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """At most ``most`` disjoint pairs (i, j): the greedy choice in the order of their costs.

    Args:
        costs: (W, N), of i and i + 1 + row; inf: no pair.
    """
    count = costs.shape[1]
    # Ranks are distinct, so two Gaussians that are each other's cheapest partner always exist.
    order = costs.flatten().argsort(stable=True)
    order = order[: int(costs.isfinite().sum())]
    first = order % count
    second = first + order // count + 1
    ranks = torch.arange(len(order))
    chosen = []
    while len(ranks):
        best = torch.full((count,), len(order))
        best.scatter_reduce_(0, first, ranks, "amin").scatter_reduce_(0, second, ranks, "amin")
        mutual = (best[first] == ranks) & (best[second] == ranks)
        chosen.append(torch.stack([ranks[mutual], first[mutual], second[mutual]]))
        free = torch.ones(count, dtype=torch.bool)
        free[first[mutual]] = free[second[mutual]] = False
        left = free[first] & free[second]
        ranks, first, second = ranks[left], first[left], second[left]
    pairs = torch.cat(chosen, 1)
    _, first, second = pairs[:, pairs[0].argsort()[:most]]
    return first, second


def _merge(mixture: _Mixture, first: Tensor, second: Tensor) -> _Mixture:
    """The mixture with each pair replaced by one Gaussian; the pairs are disjoint."""
    a, b = mixture.select(first), mixture.select(second)
    mass_a, mass_b = a.opacities * a.areas(), b.opacities * b.areas()
    weight = _weight(mass_b, mass_a)
    offset = b.means - a.means
    both = _Mixture(
        a.means + weight * offset,
        _covariance(a.covariances, b.covariances, offset, weight),
        mass_a + mass_b,
        torch.lerp(a.colors, b.colors, weight.to(a.colors.dtype)),
        torch.full_like(first, -1),
    )
    both.opacities = (both.opacities / both.areas()).clamp(1.0 - _MAX_OPACITY, _MAX_OPACITY)
    alone = torch.ones(len(mixture), dtype=torch.bool)
    alone[first] = alone[second] = False
    return mixture.select(alone).append(both)


def _weight(mass: Tensor, other: Tensor) -> Tensor:
    """The share of ``mass`` in both masses."""
    return mass / (mass + other).clamp_min(torch.finfo(mass.dtype).tiny)


def _covariance(a: Tensor, b: Tensor, offset: Tensor, weight: Tensor) -> Tensor:
    """(6, N) covariances of two Gaussians together, which are ``offset`` (3, N) apart.

    ``weight`` (N,) is that of b.
    """
    spread = torch.stack([offset[i] * offset[j] for i, j in _ENTRIES])
    return torch.lerp(a, b, weight) + weight * (1.0 - weight) * spread


def _entropy(covariances: Tensor) -> Tensor:
    """(N,) ½ log |Σ|, where no standard deviation is below `_THICKNESS` of the largest."""
    xx, yy, zz, xy, xz, yz = covariances
    floor = _THICKNESS * _THICKNESS * (xx + yy + zz)
    xx, yy, zz = xx + floor, yy + floor, zz + floor
    determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    return determinant.clamp_min(torch.finfo(torch.float64).tiny).log() / 2
