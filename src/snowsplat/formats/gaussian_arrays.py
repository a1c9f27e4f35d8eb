"""Gaussians as NumPy arrays: the representation from which scene files are written and read.

The modules of the formats use NumPy only, so that a program that inspects a file does not wait
for the import of torch.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from snowsplat.scene.gaussians import Gaussians

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)  # `==` of arrays has no truth value
class GaussianArrays:
    """N Gaussians: the parameters of `snowsplat.Gaussians` as float32 arrays, in its order.

    ``antialiased``: see `snowsplat.Gaussians`. Iterating yields the six arrays.
    """

    means: np.ndarray  # (N, 3) world units
    log_scales: np.ndarray  # (N, 3) natural logarithm of the standard deviations
    quats: np.ndarray  # (N, 4) wxyz
    opacity_logits: np.ndarray  # (N,)
    sh_dc: np.ndarray  # (N, 1, 3)
    sh_rest: np.ndarray  # (N, K, 3), K = 0, 3, 8 or 15
    antialiased: bool = field(default=False, kw_only=True)

    def __iter__(self) -> Iterator[np.ndarray]:
        yield from (self.means, self.log_scales, self.quats)
        yield from (self.opacity_logits, self.sh_dc, self.sh_rest)

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianArrays:
        """The parameters without their gradients; shares memory where they are float32 on the
        CPU.
        """
        tensors = gaussians.parameters().values()
        arrays = (tensor.detach().cpu().float().numpy() for tensor in tensors)
        return cls(*arrays, antialiased=gaussians.antialiased)

    @classmethod
    def empty(cls, rest: int = 0) -> GaussianArrays:
        """An empty set of Gaussians, with ``rest`` SH coefficients beyond the constant one."""
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, rest, 3))
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))

    @staticmethod
    def cat(parts: Sequence[GaussianArrays]) -> GaussianArrays:
        """All rows of ``parts`` in order, at the highest SH degree among them.

        They are marked as the first part.
        """
        parts = parts or [GaussianArrays.empty()]
        most = max(part.sh_rest.shape[1] for part in parts)
        rest = [np.pad(p.sh_rest, ((0, 0), (0, most - p.sh_rest.shape[1]), (0, 0))) for p in parts]
        padded = [replace(part, sh_rest=each) for part, each in zip(parts, rest, strict=True)]
        columns = (np.concatenate(arrays) for arrays in zip(*padded, strict=True))
        return GaussianArrays(*columns, antialiased=parts[0].antialiased)

    def to_gaussians(self) -> Gaussians:
        """As tensors on the CPU, which share memory with the arrays."""
        import torch

        from snowsplat.scene.gaussians import Gaussians

        return Gaussians(*map(torch.from_numpy, self), antialiased=self.antialiased)

    def select(self, index: np.ndarray | slice) -> GaussianArrays:
        """The rows ``index``: (M,) integers in any order, an (N,) bool mask, or a slice."""
        return GaussianArrays(*(array[index] for array in self), antialiased=self.antialiased)

    def finite_rows(self) -> np.ndarray:
        """(N,) bool: Gaussians whose parameters are all finite."""
        finite = np.ones(len(self.means), bool)
        for array in self:
            finite &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        return finite


def decoded(path: Path, *arrays: np.ndarray, antialiased: bool = False) -> GaussianArrays:
    """The six arrays read from ``path``, as float32; rows that are not finite are skipped."""
    as_float32 = (np.array(array, np.float32) for array in arrays)
    return skip_nonfinite(path, GaussianArrays(*as_float32, antialiased=antialiased))


def skip_nonfinite(path: Path, gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians whose parameters are all finite; logs a warning if ``path`` has others."""
    # In most files all values are finite. Then all sums are finite, which is a much faster test.
    with np.errstate(all="ignore"):
        if all(np.isfinite(array.sum()) for array in gaussians):
            return gaussians
    finite = gaussians.finite_rows()
    count = int((~finite).sum())
    if not count:
        return gaussians
    logger.warning("%s: %d Gaussians are not finite; skipped", path, count)
    return gaussians.select(finite)
