"""Gaussians as NumPy arrays: the representation from which scene files are written and read.

The modules of the formats use NumPy only, so that a program that inspects a file does not wait
for the import of torch.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from snowsplat.scene.gaussians import Gaussians

logger = logging.getLogger(__name__)


class GaussianArrays(NamedTuple):
    """N Gaussians: the parameters of `snowsplat.Gaussians` as float32 arrays, in its order."""

    means: np.ndarray  # (N, 3) world units
    log_scales: np.ndarray  # (N, 3) natural logarithm of the standard deviations
    quats: np.ndarray  # (N, 4) wxyz
    opacity_logits: np.ndarray  # (N,)
    sh_dc: np.ndarray  # (N, 1, 3)
    sh_rest: np.ndarray  # (N, K, 3), K = 0, 3, 8 or 15

    @classmethod
    def from_gaussians(cls, gaussians: Gaussians) -> GaussianArrays:
        """The parameters without their gradients; shares memory where they are float32 on the
        CPU.
        """
        tensors = gaussians.parameters().values()
        return cls(*(tensor.detach().cpu().float().numpy() for tensor in tensors))

    @classmethod
    def empty(cls, rest: int = 0) -> GaussianArrays:
        """An empty set of Gaussians, with ``rest`` SH coefficients beyond the constant one."""
        shapes = ((0, 3), (0, 3), (0, 4), (0,), (0, 1, 3), (0, rest, 3))
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))

    def to_gaussians(self) -> Gaussians:
        """As tensors on the CPU, which share memory with the arrays."""
        import torch

        from snowsplat.scene.gaussians import Gaussians

        return Gaussians(*(torch.from_numpy(array) for array in self))

    def select(self, index: np.ndarray | slice) -> GaussianArrays:
        """The rows ``index``: (M,) integers in any order, an (N,) bool mask, or a slice."""
        return GaussianArrays(*(array[index] for array in self))

    def finite_rows(self) -> np.ndarray:
        """(N,) bool: Gaussians whose parameters are all finite."""
        finite = np.ones(len(self.means), bool)
        for array in self:
            finite &= np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        return finite


def decoded(path: Path, *arrays: np.ndarray) -> GaussianArrays:
    """The six arrays read from ``path``, as float32; rows that are not finite are skipped."""
    return skip_nonfinite(path, GaussianArrays(*(np.array(array, np.float32) for array in arrays)))


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
