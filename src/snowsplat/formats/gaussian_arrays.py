"""Gaussians as NumPy arrays: the representation from which scene files are written and read.

The modules of the formats use NumPy only, so that a program that inspects a file does not wait
for the import of torch.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from snowsplat.scene.origin import HERE, Origin, origin_of
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from snowsplat.scene.gaussians import Gaussians

logger = logging.getLogger(__name__)

_ARRAYS = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
_SAMPLE = 1 << 16  # Gaussians from which the usual size is estimated


@dataclass(frozen=True, eq=False)  # `==` of arrays has no truth value
class GaussianArrays:
    """N Gaussians: the parameters of `snowsplat.Gaussians` as float32 arrays, in its order.

    ``antialiased``, ``origin`` and ``metres_per_unit``: see `snowsplat.Gaussians`. Iterating yields
    the six arrays.
    """

    means: np.ndarray  # (N, 3) world units
    log_scales: np.ndarray  # (N, 3) natural logarithm of the standard deviations
    quats: np.ndarray  # (N, 4) wxyz
    opacity_logits: np.ndarray  # (N,)
    sh_dc: np.ndarray  # (N, 1, 3)
    sh_rest: np.ndarray  # (N, K, 3), K = 0, 3, 8 or 15
    antialiased: bool = field(default=False, kw_only=True)
    origin: Origin = field(default=HERE, kw_only=True)
    metres_per_unit: float | None = field(default=None, kw_only=True)

    def __iter__(self) -> Iterator[np.ndarray]:
        yield from (self.means, self.log_scales, self.quats)
        yield from (self.opacity_logits, self.sh_dc, self.sh_rest)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianArrays:
        """The parameters without gradients; shares memory where they are float32 on the CPU."""
        tensors = gaussians.parameters().values()
        arrays = (tensor.detach().cpu().float().numpy() for tensor in tensors)
        return cls(
            *arrays,
            antialiased=gaussians.antialiased,
            origin=gaussians.origin,
            metres_per_unit=gaussians.metres_per_unit,
        )

    @classmethod
    def empty(cls, rest: int = 0) -> GaussianArrays:
        """An empty set of Gaussians, with ``rest`` SH coefficients beyond the constant one."""
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, rest, 3))
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))

    @staticmethod
    def cat(parts: Sequence[GaussianArrays]) -> GaussianArrays:
        """All rows of ``parts`` in order, at the highest SH degree among them.

        They are marked as the first part, whose origin is that of all.
        """
        parts = parts or [GaussianArrays.empty()]
        most = max(part.sh_rest.shape[1] for part in parts)
        rest = [np.pad(p.sh_rest, ((0, 0), (0, most - p.sh_rest.shape[1]), (0, 0))) for p in parts]
        padded = [replace(part, sh_rest=each) for part, each in zip(parts, rest, strict=True)]
        moved = [part.seen_from(parts[0].origin) for part in padded]
        columns = (np.concatenate(arrays) for arrays in zip(*moved, strict=True))
        return parts[0]._with(*columns)

    def to_gaussians(self) -> Gaussians:
        """As tensors on the CPU, which share memory with the arrays."""
        import torch

        from snowsplat.scene.gaussians import Gaussians

        tensors = map(torch.from_numpy, self)
        return Gaussians(
            *tensors,
            antialiased=self.antialiased,
            origin=self.origin,
            metres_per_unit=self.metres_per_unit,
        )

    def select(self, index: np.ndarray | slice) -> GaussianArrays:
        """The rows ``index``: (M,) integers in any order, an (N,) bool mask, or a slice."""
        return self._with(*(array[index] for array in self))

    def world_means(self) -> np.ndarray:
        """(N, 3) float64: the positions in the world."""
        return self.means.astype(np.float64) + self.origin

    def seen_from(self, origin: Origin) -> GaussianArrays:
        """The same Gaussians in the world, with positions relative to another origin."""
        if origin == self.origin:
            return self
        means = (self.world_means() - origin).astype(np.float32)
        return replace(self, means=means, origin=origin)

    def usable_rows(self) -> np.ndarray:
        """(N,) bool: see `snowsplat.Gaussians.usable_rows`."""
        return ~np.any(list(self._unusable().values()), axis=0)

    def _unusable(self) -> dict[Message, np.ndarray]:
        """(N,) bool by what is wrong."""
        rows = {
            message("positions"): ~np.isfinite(self.means).all(1),
            message("scales"): (np.isnan(self.log_scales) | (self.log_scales == np.inf)).any(1),
            message("rotations"): ~np.isfinite(self.quats).all(1),
            message("opacities"): np.isnan(self.opacity_logits),
        }
        sh = np.isfinite(self.sh_dc).all((1, 2)) & np.isfinite(self.sh_rest).all((1, 2))
        return rows | {message("colours"): ~sh}

    def _with(self, *arrays: np.ndarray) -> GaussianArrays:
        own: dict[str, Any] = dict(zip(_ARRAYS, arrays, strict=True))
        return replace(self, **own)


def usable_gaussians(path: Path, *arrays: np.ndarray, antialiased: bool = False) -> GaussianArrays:
    """The six arrays read from ``path``, as float32; rows that are not usable are left out.

    Positions in float64 are stored relative to an origin if float32 would lose precision.
    """
    return without_unusable(path, float32_gaussians(*arrays, antialiased=antialiased))


def float32_gaussians(*arrays: np.ndarray, antialiased: bool = False) -> GaussianArrays:
    """The six arrays as float32. Positions in float64 get an origin if they need one."""
    means, log_scales, *others = arrays
    origin = HERE
    if means.dtype == np.float64:
        sizes = log_scales[:: -(-len(log_scales) // _SAMPLE) or 1]
        size = float(np.exp(np.median(sizes))) if sizes.size else 0.0
        origin = origin_of(means, size)
        means = means - origin if any(origin) else means
    as_float32 = (np.array(array, np.float32) for array in (means, log_scales, *others))
    return GaussianArrays(*as_float32, antialiased=antialiased, origin=origin)


def without_unusable(path: Path, gaussians: GaussianArrays) -> GaussianArrays:
    """The usable Gaussians; a warning names ``path``, the number of the others, and the reason."""
    problem = unusable(gaussians)
    if problem is None:
        return gaussians
    logger.warning("%s: %s; left out", path, problem)
    return gaussians.select(gaussians.usable_rows())


def unusable(gaussians: GaussianArrays) -> Message | None:
    """How many Gaussians are not usable, and why; None if all are."""
    # In most files all values are finite. Then all sums are finite, which is a much faster test.
    with np.errstate(all="ignore"):
        if all(np.isfinite(array.sum()) for array in gaussians):
            return None
    count = int((~gaussians.usable_rows()).sum())
    if not count:
        return None
    found = [
        message("{what} of {n:,}", what=what, n=int(rows.sum()))
        for what, rows in gaussians._unusable().items()
        if rows.any()
    ]
    return message(
        "{count:,} of {all:,} Gaussians are not finite ({found})",
        count=count,
        all=len(gaussians.means),
        found=found,
    )
