"""Fewer Gaussians that look the same: neighbours are merged, two at a time.

Two Gaussians are replaced by one with the mean and the covariance of both together. In every pass,
the pairs that lose least are merged, at most a third of the scene; a merged Gaussian can be merged
again in the next pass.

The cost of a merge is measured in the image. A renderer blurs a Gaussian that is smaller than a
pixel to the size of a pixel, so areas are measured after this blur. Without the blur, a merge of
small Gaussians would lose most of their opacity. From the cameras, if they are known, follow the
size of a pixel at each Gaussian, the directions from which the Gaussian is seen, and the part of
the Gaussian that is not hidden (`sight`).

The candidates for a partner are close in a Morton order. In every pass the grid of this order has
another orientation, so two neighbours that are on different sides of a border meet in another pass.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from snowsplat.ops.reference import LOW_PASS
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import morton_order, quat_from_rotation, rotation_from_quat
from snowsplat.scene.sight import ENTRIES, sight

# Candidates for a partner: this number of Gaussians after it in the Morton order, and before it.
_NEIGHBOURS = 8
# Largest share of the Gaussians that one pass removes.
_SHARE = 1 / 3
# The weight of a squared difference of the SH coefficients, relative to the growth of the area.
_COLOR = 0.3
# Gaussians that are compared at a time, so that the intermediate results fit into the cache.
_CHUNK = 1 << 15
# The rotation of the grid between two passes. Its axis is not parallel to x, y or z.
_TURN = rotation_from_quat(torch.tensor([[0.9, 0.25, -0.31, 0.17]], dtype=torch.float64))[0]
# Largest opacity of a merged Gaussian: its logit is finite.
_MAX_OPACITY = 0.9999
# What replaces an infinite logit, and −inf as the logarithm of a scale, relative to the others.
_LARGEST_LOGIT = 12.0
_FLAT = math.log(1e-4)
_LEAST_LOG_SCALE = -27.0
_TINY = torch.finfo(torch.float64).tiny


@torch.no_grad()
def simplify(
    gaussians: Gaussians, count: int, cameras: Sequence[Camera] = (), *, farther: float = 1.0
) -> Gaussians:
    """``count`` Gaussians that look like ``gaussians``; neighbours are merged.

    Let A be the area of a Gaussian in the views, blurred as by the renderer, up to a factor:
    A² = tr(D adj Σ), with the mean D of d dᵀ over the viewing directions d. The means and
    covariances of a pair are merged by their moments, with the weights w = opacity × A, and the SH
    coefficients are the weighted mean. The pair and its replacement cover equal areas:
    opacity × A of both, less their overlap. The cost of a pair is

        (log A − w₁ log A₁ − w₂ log A₂ + 0.3 |c₁ − c₂|²) · √(min(o₁, o₂) · v)

    with the SH coefficients c, the opacities o and the weight v of both together in the views. The
    growth of log A has no unit, so small and large Gaussians are merged alike. Gaussians that are
    not merged do not change.

    Args:
        gaussians: N Gaussians on the CPU. Those that are not usable are removed first, and infinite
            logits of opacities become finite, because the result may be trained.
        count: how many to keep. If it is at least N, the result is ``gaussians``.
        cameras: the cameras of the photos, see `sight`. They make the result better.
        farther: the factor by which a pixel becomes larger where two Gaussians are merged. 1: the
            result is for views from the same distance; 3: with a quarter of the Gaussians, it is
            for views from three times the distance.

    References:
        Runnalls 2007, Kullback-Leibler approach to Gaussian mixture reduction (greedy merging).
        Kerbl et al. 2024, A hierarchical 3D Gaussian representation (the weights).
    """
    if count >= len(gaussians):
        return gaussians
    if count <= 0:
        return gaussians.select(torch.empty(0, dtype=torch.int64))
    gaussians = _trainable(gaussians.select(gaussians.usable_rows()))
    mixture, turn = _Mixture.from_gaussians(gaussians, cameras), torch.eye(3, dtype=torch.float64)
    while len(mixture) > count:
        mixture = mixture.select(morton_order(mixture.means.T @ turn))
        surplus = min(len(mixture) - count, max(1, int(_SHARE * len(mixture))))
        mixture = _merge(mixture, *_cheapest_pairs(_costs(mixture), surplus), farther)
        turn = turn @ _TURN
    return mixture.gaussians(gaussians)


def _trainable(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with finite parameters: opacities in (0, 1), flat axes of a small size."""
    logits = gaussians.opacity_logits.nan_to_num(posinf=_LARGEST_LOGIT, neginf=-_LARGEST_LOGIT)
    scales = gaussians.log_scales
    least = scales.amax(dim=1, keepdim=True).clamp_min(_LEAST_LOG_SCALE) + _FLAT
    log_scales = torch.where(scales == -torch.inf, least, scales)
    return replace(gaussians, opacity_logits=logits, log_scales=log_scales)


@dataclass
class _Mixture:
    """N Gaussians by their moments; the last dimension of each tensor is N.

    ===========  ==================  ==========================================================
    means        (3, N) float64
    covariances  (6, N) float64      the entries `ENTRIES`
    opacities    (N,) float64
    colors       (3 + 3 K, N)        all SH coefficients
    origins      (N,) int64          the row in the original scene; −1 for a merged Gaussian
    blurs        (N,) float64        the variance of the blur of the renderer, in world units
    directions   (6, N) float64      see `Sight`
    weights      (N,) float64        see `Sight`
    ===========  ==================  ==========================================================
    """

    means: Tensor
    covariances: Tensor
    opacities: Tensor
    colors: Tensor
    origins: Tensor
    blurs: Tensor
    directions: Tensor
    weights: Tensor

    @staticmethod
    def from_gaussians(gaussians: Gaussians, cameras: Sequence[Camera]) -> _Mixture:
        seen = sight(gaussians, cameras)
        axes = rotation_from_quat(gaussians.rotations.double()) * gaussians.scales.double()[:, None]
        return _Mixture(
            gaussians.means.double().T.contiguous(),
            torch.stack([(axes[:, i] * axes[:, j]).sum(1) for i, j in ENTRIES]),
            gaussians.opacities.double(),
            torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1).flatten(1).T.contiguous(),
            torch.arange(len(gaussians)),
            LOW_PASS * seen.pixels,
            seen.directions,
            seen.weights,
        )

    def __len__(self) -> int:
        return len(self.opacities)

    def select(self, index: Tensor | slice) -> _Mixture:
        return _Mixture(*(getattr(self, field.name)[..., index] for field in fields(self)))

    def append(self, other: _Mixture) -> _Mixture:
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return _Mixture(*(torch.cat(pair, -1) for pair in pairs))

    def areas(self) -> Tensor:
        """(N,) A, see `simplify`."""
        adjugate = _adjugate(_blur(self.covariances, self.blurs))
        return _product(self.directions, adjugate).clamp_min(_TINY).sqrt()

    def masses(self) -> Tensor:
        """(N,) opacity × A."""
        return self.opacities * self.areas()

    def gaussians(self, original: Gaussians) -> Gaussians:
        """The Gaussians of this mixture; those with an origin are rows of ``original``."""
        merged = self.select(self.origins < 0)
        matrices = torch.empty(len(merged), 3, 3, dtype=torch.float64)
        for (i, j), entry in zip(ENTRIES, merged.covariances, strict=True):
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
        made = original.with_parameters({n: v.to(dtype).contiguous() for n, v in values.items()})
        return kept.append(made)


def _costs(mixture: _Mixture) -> Tensor:
    """(`_NEIGHBOURS`, N) float32: what is lost by merging Gaussian i with Gaussian i + 1 + row."""
    count = len(mixture)
    costs = torch.full((min(_NEIGHBOURS, count - 1), count), torch.inf)
    masses, sizes = mixture.masses(), mixture.areas().log()
    for row in range(len(costs)):
        for start in range(0, count - row - 1, _CHUNK):
            a = slice(start, min(start + _CHUNK, count - row - 1))
            b = slice(a.start + row + 1, a.stop + row + 1)
            first, second = mixture.select(a), mixture.select(b)
            share = _share(masses[b], masses[a])
            both = _together(first, second, share)
            growth = both.areas().log() - torch.lerp(sizes[a], sizes[b], share)
            color = (second.colors - first.colors).square().sum(0)
            seen = torch.minimum(first.opacities, second.opacities) * both.weights
            costs[row, a] = ((growth + _COLOR * color) * seen.sqrt()).float()
    return costs


def _cheapest_pairs(costs: Tensor, most: int) -> tuple[Tensor, Tensor]:
    """At most ``most`` disjoint pairs (i, j): the greedy choice in the order of their costs.

    ``costs``: (W, N), of i and i + 1 + row; inf: no pair.
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


def _merge(mixture: _Mixture, first: Tensor, second: Tensor, farther: float = 1.0) -> _Mixture:
    """The mixture with each pair replaced by one Gaussian; the pairs are disjoint."""
    a, b = mixture.select(first), mixture.select(second)
    mass_a, mass_b = a.masses(), b.masses()
    both = _together(a, b, _share(mass_b, mass_a))
    covered = mass_a + mass_b - _overlap(a, b, mass_a, mass_b)
    both.blurs *= farther
    both.opacities = (covered / both.areas()).clamp(1.0 - _MAX_OPACITY, _MAX_OPACITY)
    alone = torch.ones(len(mixture), dtype=torch.bool)
    alone[first] = alone[second] = False
    return mixture.select(alone).append(both)


def _together(a: _Mixture, b: _Mixture, share: Tensor) -> _Mixture:
    """Merge row i of ``a`` and row i of ``b``, whose share is ``share`` (N,); without opacities."""
    offset = b.means - a.means
    spread = torch.stack([offset[i] * offset[j] for i, j in ENTRIES])
    return _Mixture(
        a.means + share * offset,
        torch.lerp(a.covariances, b.covariances, share) + share * (1.0 - share) * spread,
        torch.empty_like(share),
        torch.lerp(a.colors, b.colors, share.to(a.colors.dtype)),
        torch.full_like(a.origins, -1),
        torch.lerp(a.blurs, b.blurs, share),
        torch.lerp(a.directions, b.directions, share),
        a.weights + b.weights,
    )


def _overlap(a: _Mixture, b: _Mixture, mass_a: Tensor, mass_b: Tensor) -> Tensor:
    """(N,) the integral of α₁ α₂ in the views, in the unit of the masses: the product of two
    Gaussians is o₁ o₂ A₁ A₂ / A(Σ₁ + Σ₂) · exp(−½ Δᵀ (Σ₁ + Σ₂)⁻¹ Δ)."""
    sums = _blur(a.covariances + b.covariances, a.blurs + b.blurs)
    adjugate = _adjugate(sums)
    determinant = sums[0] * adjugate[0] + sums[3] * adjugate[3] + sums[4] * adjugate[4]
    offset = b.means - a.means
    square = torch.stack([offset[i] * offset[j] for i, j in ENTRIES])
    distance = _product(square, adjugate) / determinant.clamp_min(_TINY)
    area = _product((a.directions + b.directions) / 2, adjugate).clamp_min(_TINY).sqrt()
    return mass_a * mass_b / area * (-0.5 * distance).exp()


def _share(mass: Tensor, other: Tensor) -> Tensor:
    """The share of ``mass`` in both masses."""
    return mass / (mass + other).clamp_min(_TINY)


def _blur(covariances: Tensor, variances: Tensor) -> Tensor:
    """(6, N) Σ + variance · I."""
    return torch.cat([covariances[:3] + variances, covariances[3:]])


def _adjugate(matrices: Tensor) -> Tensor:
    """(6, N) the adjugates of symmetric matrices (6, N)."""
    xx, yy, zz, xy, xz, yz = matrices
    return torch.stack(
        [
            yy * zz - yz * yz,
            xx * zz - xz * xz,
            xx * yy - xy * xy,
            xz * yz - xy * zz,
            xy * yz - xz * yy,
            xy * xz - xx * yz,
        ]
    )


def _product(a: Tensor, b: Tensor) -> Tensor:
    """(N,) tr(A B) of symmetric matrices (6, N)."""
    products = a * b
    return products[:3].sum(0) + 2.0 * products[3:].sum(0)
