"""The scene: N Gaussians, their optimised parameters, and their activations.

`Gaussians` holds only data. Optimisers and density control take a `Gaussians` and return another.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from snowsplat import ops
from snowsplat.ops.scratch import take_rows
from snowsplat.scene.origin import HERE, Origin
from snowsplat.scene.sh_constants import SH_C0, SH_REST_COUNTS


class ColoredPoints(Protocol):
    """The point cloud that `Gaussians.from_points` needs, for example `snowsplat.data.Points`."""

    xyz: Tensor  # (P, 3) float32, world
    rgb: Tensor  # (P, 3) uint8


@dataclass(eq=False)  # `==` of tensors has no truth value
class Gaussians:
    """N anisotropic Gaussians in the world frame. All tensors share a floating dtype and a device.

    ==================  ===========  ======================================================
    means               (N, 3)       centres, in world units
    log_scales          (N, 3)       natural logarithm of the standard deviations
    quats               (N, 4)       rotation, wxyz; need not be normalised
    opacity_logits      (N,)         opacity = sigmoid(logit)
    sh_dc               (N, 1, 3)    constant SH coefficient of each colour channel
    sh_rest             (N, K, 3)    other SH coefficients, K = (degree + 1)² − 1: 0, 3, 8, 15
    ==================  ===========  ======================================================

    Attributes:
        antialiased: whether the Gaussians were trained for the 2D mip filter, and must be rendered
            with it: see `ops.project`. Scene files call this mode "mip" or "antialiased".
        origin: what is added to the means to get positions in the world, see `scene.origin`.
            Rendering and training do not use it: cameras are relative to the origin, too.
        metres_per_unit: the true length of a world unit; None: unknown. See `scene.length`.

    Raises:
        ValueError: shapes, dtypes or devices do not match.
    """

    means: Tensor
    log_scales: Tensor
    quats: Tensor
    opacity_logits: Tensor
    sh_dc: Tensor
    sh_rest: Tensor
    antialiased: bool = field(default=False, kw_only=True)
    origin: Origin = field(default=HERE, kw_only=True)
    metres_per_unit: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else 0
        rest = self.sh_rest.shape[1] if self.sh_rest.ndim == 3 else 0
        if rest not in SH_REST_COUNTS:
            raise ValueError(f"sh_rest has {rest} coefficients per channel; expected 0, 3, 8 or 15")
        expected = {
            "means": (n, 3),
            "log_scales": (n, 3),
            "quats": (n, 4),
            "opacity_logits": (n,),
            "sh_dc": (n, 1, 3),
            "sh_rest": (n, rest, 3),
        }
        for name, tensor in self.parameters().items():
            if tuple(tensor.shape) != expected[name]:
                shapes = f"shape {tuple(tensor.shape)}, expected {expected[name]}"
                raise ValueError(f"{name} has {shapes}")
            if not tensor.is_floating_point() or tensor.dtype != self.means.dtype:
                raise ValueError(f"{name} is {tensor.dtype}, means is {self.means.dtype}")
            if tensor.device != self.means.device:
                raise ValueError(f"{name} is on {tensor.device}, means on {self.means.device}")

    def __len__(self) -> int:
        return self.means.shape[0]

    def parameters(self) -> dict[str, Tensor]:
        """The six tensors by name, always in the order of the table above."""
        return {
            "means": self.means,
            "log_scales": self.log_scales,
            "quats": self.quats,
            "opacity_logits": self.opacity_logits,
            "sh_dc": self.sh_dc,
            "sh_rest": self.sh_rest,
        }

    # Activations

    @property
    def scales(self) -> Tensor:
        """(N, 3) standard deviations in world units, exp(log_scales)."""
        return self.log_scales.exp()

    @property
    def rotations(self) -> Tensor:
        """(N, 4) unit quaternions wxyz."""
        return torch.nn.functional.normalize(self.quats, dim=1)

    @property
    def opacities(self) -> Tensor:
        """(N,) in (0, 1), sigmoid(opacity_logits)."""
        return self.opacity_logits.sigmoid()

    @property
    def base_colors(self) -> Tensor:
        """(N, 3) colour without the view-dependent part: 0.5 + C0 · sh_dc, not clamped."""
        return 0.5 + SH_C0 * self.sh_dc[:, 0]

    @property
    def sh_degree(self) -> int:
        """0 to 3: the SH degree, from the size of ``sh_rest``."""
        return SH_REST_COUNTS.index(self.sh_rest.shape[1])

    # Sets of Gaussians

    def usable_rows(self) -> Tensor:
        """(N,) bool: whether a Gaussian can be shown.

        Infinite opacity logits are the opacities 0 and 1, and the log scale −inf is a flat axis.
        All other infinite values, and NaN, have no meaning.
        """
        usable = ~self.opacity_logits.isnan() & (self.log_scales < torch.inf).all(dim=1)
        for finite in (self.means, self.quats, self.sh_dc, self.sh_rest):
            usable &= finite.isfinite().flatten(1).all(dim=1)
        return usable

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Apply one function to every parameter tensor."""
        return self.with_parameters({n: function(t) for n, t in self.parameters().items()})

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Gaussians:
        """Other Gaussians, by the names of `parameters`, that are rendered as these."""
        own: dict[str, Any] = {name: parameters[name] for name in self.parameters()}
        return replace(self, **own)

    def select(self, index: Tensor) -> Gaussians:
        """The rows ``index``: (M,) integers in any order, or an (N,) bool mask."""
        return self.map(lambda tensor: take_rows(tensor, index))

    def select_(self, index: Tensor) -> None:
        """`select` in place, one tensor at a time, so that only one tensor is copied at once."""
        for name in tuple(self.parameters()):
            setattr(self, name, take_rows(getattr(self, name), index))

    def append(self, other: Gaussians) -> Gaussians:
        """The rows of this set, then those of ``other``."""
        return Gaussians.cat([self, other])

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """The rows of all ``parts`` in order; needs at least one part, and equal SH degrees.

        They are rendered as the first part. Their origins must be equal.
        """
        rows = [part.parameters() for part in parts]
        return parts[0].with_parameters({n: torch.cat([r[n] for r in rows]) for n in rows[0]})

    def to(
        self, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Gaussians:
        """These Gaussians on ``device`` and with ``dtype``; tensors are copied only if needed."""
        return self.map(lambda tensor: tensor.to(device=device, dtype=dtype))

    def detach(self) -> Gaussians:
        """The same storage, detached from the autograd graph."""
        return self.map(Tensor.detach)

    def clone(self) -> Gaussians:
        """A copy of all tensors."""
        return self.map(Tensor.clone)

    # Initialisation

    @staticmethod
    def from_points(
        points: ColoredPoints, sh_degree: int = 3, initial_opacity: float = 0.1
    ) -> Gaussians:
        """One isotropic Gaussian per point, as in the paper (section 5.1).

        The standard deviation is the mean distance to the three nearest other points. The colour is
        that of the point and does not depend on the view. The rotation is the identity.

        Args:
            points: at least one.
            sh_degree: 0 to 3.
            initial_opacity: in (0, 1).

        Raises:
            ValueError: there are no points.
        """
        means = points.xyz.to(torch.float32).contiguous()
        n = means.shape[0]
        if n == 0:
            raise ValueError("from_points needs at least one point")
        sh_dc = (points.rgb.to(torch.float32) / 255.0 - 0.5) / SH_C0
        logit = math.log(initial_opacity / (1.0 - initial_opacity))
        return Gaussians(
            means=means.clone(),
            log_scales=_spacing(means).log()[:, None].repeat(1, 3),
            quats=means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
            opacity_logits=means.new_full((n,), logit),
            sh_dc=sh_dc[:, None, :].contiguous(),
            sh_rest=means.new_zeros(n, SH_REST_COUNTS[sh_degree], 3),
        )


def _spacing(points: Tensor) -> Tensor:
    """(N,) mean distance of each point to its 3 nearest other points (to all if fewer exist)."""
    k = min(3, points.shape[0] - 1)
    if k == 0:
        return points.new_ones(1)
    spacing = ops.neighbours(points, k=k).mean(dim=1)
    # Coincident points would become Gaussians of size 0, whose logarithm is -inf. The minimum is
    # relative to the point cloud, so it does not depend on the unit of length.
    floor = 1e-3 * float(spacing.median())
    return spacing.clamp_min(floor if floor > 0.0 else 1e-6)
