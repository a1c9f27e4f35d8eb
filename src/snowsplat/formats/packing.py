"""What the compact formats share: the file as bytes, parameters as bytes.

They hold opacity and colour in bytes and rotations in a few, and none of them can hold what is not
finite. Arrays here are numpy, float32 where nothing else is said, one row a Gaussian, in the order
and with the meaning of `Gaussians.parameters`.
"""

import logging
from pathlib import Path

import numpy as np
import torch

from snowsplat.scene.gaussians import SH_C0, Gaussians
from snowsplat.util.errors import UserError

logger = logging.getLogger(__name__)

#: means, log_scales, quats, opacity_logits, sh_dc, sh_rest.
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]

#: Gaussians that a file of any size may hold.
ALWAYS_ALLOWED = 1 << 16
_FLAT = 1e-12  # instead of a standard deviation of 0, which has no logarithm


def read_file(path: Path) -> bytes:
    """The whole file.

    Raises:
        UserError: not readable.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror or error})") from None


def check_count(path: Path, count: int, file_size: int) -> None:
    """Hold what a packed file promises against its size, before memory is taken for it.

    Real scenes take five bytes a Gaussian or more in any format; of equal ones a few bytes can be
    millions, and each takes up to 600 bytes of memory while it is read.

    Raises:
        UserError: more Gaussians than bytes, and than a file may always have.
    """
    if count > max(ALWAYS_ALLOWED, file_size):
        raise UserError(
            f"{path}: a file of {file_size} bytes that promises {count} Gaussians; it is damaged "
            "or made to do harm"
        )


def to_arrays(path: Path, gaussians: Gaussians) -> Arrays:
    """The parameters to be written to ``path``; rows that are not finite left out with a warning.

    Quaternions are of unit length; the zero quaternion is the identity.
    """
    kept = _finite(path, gaussians.detach().to("cpu", torch.float32))
    means, log_scales, quats, opacity_logits, sh_dc, sh_rest = (
        tensor.numpy() for tensor in kept.parameters().values()
    )
    return means, log_scales, unit_quats(quats), opacity_logits, sh_dc, sh_rest


def to_gaussians(path: Path, *arrays: np.ndarray) -> Gaussians:
    """The six arrays read from ``path``; rows that are not finite left out with a warning."""
    tensors = (torch.from_numpy(np.array(array, np.float32)) for array in arrays)
    return _finite(path, Gaussians(*tensors))


def _finite(path: Path, gaussians: Gaussians) -> Gaussians:
    # Nearly always all of them are, which the sums say much faster.
    if all(bool(tensor.sum().isfinite()) for tensor in gaussians.parameters().values()):
        return gaussians
    finite = gaussians.finite_rows()
    count = int((~finite).sum())
    if not count:
        return gaussians
    logger.warning("%s: %d Gaussians are not finite; left out", path, count)
    return gaussians.select(finite)


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) at unit length; the identity for those of length 0."""
    # By the largest entry first: the squares of float32 over- and underflow.
    largest = np.abs(quats).max(1, keepdims=True)
    scaled = quats / np.where(largest == 0, 1, largest)
    scaled[largest[:, 0] == 0, 0] = 1
    return scaled / np.sqrt((scaled * scaled).sum(1, keepdims=True))


def opacity_bytes(opacity_logits: np.ndarray) -> np.ndarray:
    """(N,) uint8: 255 · opacity."""
    with np.errstate(over="ignore"):
        return to_bytes(255 / (1 + np.exp(-opacity_logits)))


def opacity_logits(alpha: np.ndarray) -> np.ndarray:
    """(N,) float32 of uint8 opacities.

    0 and 255 have no logit: they become a quarter of a step inside, which renders the same, is
    written back as the same byte, and can still be trained.
    """
    steps = np.arange(256, dtype=np.float64)
    steps[[0, 255]] = 0.25, 254.75
    return np.log(steps / (255 - steps)).astype(np.float32)[alpha]


def color_bytes(sh_dc: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 of (N, 1, 3): 255 · (0.5 + C0 · sh_dc), clamped."""
    return to_bytes(255 * (0.5 + SH_C0 * sh_dc[:, 0]))


def color_sh(colors: np.ndarray) -> np.ndarray:
    """(N, 1, 3) float32 constant SH coefficients of (N, 3) uint8 colours."""
    table = (np.arange(256) / 255 - 0.5) / SH_C0
    return table.astype(np.float32)[colors][:, None]


def to_bytes(values: np.ndarray) -> np.ndarray:
    """The nearest of 0 to 255, as uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def log_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms of standard deviations; 0 and less, of a flat Gaussian, as of 1e-12."""
    return np.log(np.where(scales <= 0, np.float32(_FLAT), scales))  # NaN stays NaN


def largest_of_four(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which entry of each unit quaternion (N, 4) is largest; the three others (N, 3) in order.

    The sign is the one with which the largest is positive, so that the three say all: each lies
    within ± 1/√2.
    """
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    signed = np.where(quats[rows, largest][:, None] < 0, -quats, quats)
    others = np.arange(4) != largest[:, None]
    return largest, signed[others].reshape(-1, 3)


def from_largest_of_four(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Unit quaternions (N, 4) float32: the inverse of `largest_of_four`."""
    quats = np.empty((len(others), 4), np.float32)
    quats[np.arange(4) != largest[:, None]] = others.reshape(-1)
    rest = 1 - (others.astype(np.float32) ** 2).sum(1)
    quats[np.arange(len(quats)), largest] = np.sqrt(np.maximum(rest, 0))
    return unit_quats(quats)
