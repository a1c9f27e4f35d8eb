"""Conversions that the compact formats share: opacity and colour as bytes, rotations in few bits.

Arrays are NumPy, float32 unless stated otherwise, one row per Gaussian, with the meaning of the
fields of `GaussianArrays`.
"""

import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from snowsplat.formats.damage import Unsupported
from snowsplat.formats.gaussian_arrays import GaussianArrays, without_unusable
from snowsplat.scene.sh_constants import SH_C0
from snowsplat.util.messages import Message, message

logger = logging.getLogger(__name__)

#: A file of any size may declare this many Gaussians.
ALWAYS_ALLOWED = 1 << 16
#: The logit of a fully opaque Gaussian: its opacity is 1 in float32.
OPAQUE_LOGIT = 30.0
#: Logarithm of the thickness of a flat Gaussian relative to its other axes.
FLAT = float(np.log(1e-4))
#: Signs that convert between x right, y down, z forward (our frame, and that of most scene files)
#: and x right, y up, z back (OpenGL, three.js, glTF), in both directions.
UP_BACK = (1, -1, -1)
#: Logarithms of the scales that float32 can store.
LOG_SCALES = -87.0, 88.0
_RARE = 0.001  # share of Gaussians, see `Cut`
_SMALLEST_SCALE = 1e-12  # replaces a standard deviation of 0, which has no logarithm


def check_count(count: int, file_size: int) -> None:
    """Compare the number of Gaussians that a compressed file declares with its size in bytes.

    This is done before memory is allocated. Real scenes take five bytes per Gaussian or more in
    any format. A few bytes can declare millions of equal Gaussians, and each takes up to 600 bytes
    of memory while the file is read.

    Raises: Unsupported: more Gaussians than bytes, and more than `ALWAYS_ALLOWED`.
    """
    if count > max(ALWAYS_ALLOWED, file_size):
        raise Unsupported(
            "a file of {file_size} bytes declares {count} Gaussians; it is damaged or malicious",
            file_size=file_size,
            count=count,
        )


def packable(path: Path, gaussians: GaussianArrays) -> GaussianArrays:
    """The usable Gaussians with finite values and unit quaternions, as compact formats need them.

    Gaussians that are not usable are left out, with a warning that names ``path``. The opacities 0
    and 1 get finite logits, flat axes a scale that is small enough (`flat_log_scales`). The zero
    quaternion becomes the identity.
    """
    usable = without_unusable(path, gaussians)
    return replace(
        usable,
        log_scales=flat_log_scales(usable.log_scales),
        quats=unit_quats(usable.quats),
        opacity_logits=np.nan_to_num(
            usable.opacity_logits, posinf=OPAQUE_LOGIT, neginf=-OPAQUE_LOGIT
        ),
    )


class Cut:
    """What a format cannot hold of a scene, for one line after writing."""

    def __init__(self, path: Path, format: str, count: int) -> None:
        self._path, self._format, self._count = path, format, count
        self._found: list[Message] = []

    def note(self, what: Message, rows: Any, details: Message, *, rare: bool = False) -> None:
        """Note values that were cut.

        Args:
            what: the kind of values.
            rows: (N,) bool: the Gaussians with such values.
            details: the values, and what they became.
            rare: the values hardly change the picture if less than 0.1% of the Gaussians have them;
                then they are not named.
        """
        count = int(np.count_nonzero(rows))
        if count > (_RARE * self._count if rare else 0):
            self._found.append(
                message("{what} of {n:,} ({details})", what=what, n=count, details=details)
            )

    def report(self, advice: str) -> None:
        """Log what was noted, and what to do."""
        if self._found:
            logger.warning(
                "%s: cut to the range of %s: %s of %s Gaussians; %s",
                self._path,
                self._format,
                message("{found}", found=self._found),
                f"{self._count:,}",
                advice,
            )


def cut_scales(cut: Cut, log_scales: np.ndarray, low: float, high: float, step: float) -> None:
    """Note the log scales (N, 3) beyond ``low`` … ``high`` that change the picture.

    A thin axis may become thicker without a visible change, as long as the Gaussian stays ten times
    as long. ``step``: the usual rounding, which does not count.
    """
    if not len(log_scales):
        return
    longest = log_scales.max(1)
    largest, smallest = float(np.exp(longest.max())), float(np.exp(longest.min()))
    details = message("up to {found:.4g}, at most {limit:.4g}", found=largest, limit=math.exp(high))
    cut.note(message("the large scales"), longest > high + step, details)
    thick = (log_scales.min(1) < low - step) & (longest < low + math.log(10))
    details = message(
        "down to {found:.4g}, at least {limit:.4g}", found=smallest, limit=math.exp(low)
    )
    cut.note(message("the small scales"), thick, details, rare=True)


def linear_values(cut: Cut, gaussians: GaussianArrays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scales (N, 3), opacities (N,) and SH (N, 1 + K, 3), as glTF and USD store them.

    Scales that float32 cannot store are noted in ``cut``.
    """
    cut_scales(cut, gaussians.log_scales, *LOG_SCALES, step=0)
    scales = np.exp(np.clip(gaussians.log_scales, *LOG_SCALES))
    opacities = (1 / (1 + np.exp(-gaussians.opacity_logits))).astype(np.float32)
    return scales, opacities, np.concatenate([gaussians.sh_dc, gaussians.sh_rest], 1)


def logits(opacities: np.ndarray) -> np.ndarray:
    """(N,) float64 logits of opacities from 0 to 1, which are limited to those that have one."""
    opacities = np.clip(opacities.astype(np.float64), 1e-12, 1 - 2.0**-25)
    return np.log(opacities / (1 - opacities))


def quats_of_xyzw(xyzw: np.ndarray) -> np.ndarray:
    """(N, 4) wxyz; the quaternion of length 0 becomes the identity."""
    quats = xyzw[:, [3, 0, 1, 2]]
    quats[(quats == 0).all(1)] = 1, 0, 0, 0
    return quats


def fitting_factor(log_scales: np.ndarray, low: float, high: float) -> float | None:
    """The factor next to 1 that brings all scales between ``low`` and ``high``; None: none does.

    A power of ten if one fits.
    """
    longest = log_scales.max(1)
    least = low + math.log(10) - float(np.quantile(longest, _RARE))
    most = high - float(longest.max())
    if least > most:
        return None
    nearest = min(max(0.0, least), most)
    tens = (math.ceil if nearest > 0 else math.floor)(nearest / math.log(10)) * math.log(10)
    return float(f"{math.exp(tens if least <= tens <= most else nearest):.3g}")


def flat_log_scales(log_scales: np.ndarray) -> np.ndarray:
    """(N, 3) finite: −inf, of a flat axis, becomes 10⁻⁴ of the thinnest other axis.

    A Gaussian without any other axis, a point, gets axes of 1e-12.
    """
    flat = log_scales == -np.inf
    if not flat.any():
        return log_scales
    thinnest = np.where(flat, np.inf, log_scales).min(1, keepdims=True)
    thin = np.where(thinnest == np.inf, np.log(_SMALLEST_SCALE), thinnest + FLAT)
    return np.where(flat, thin, log_scales).astype(np.float32)


def spatial_order(means: np.ndarray) -> np.ndarray:
    """(N,) the permutation that sorts ``means`` (N, 3) along a Morton curve."""
    import torch  # only writers need it

    from snowsplat.scene.geometry import morton_order

    return morton_order(torch.from_numpy(means)).numpy()


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) scaled to unit length; those of length 0 become the identity."""
    # Quaternions are first divided by the largest entry, because squares of float32 values may
    # overflow or underflow.
    largest = np.abs(quats).max(1, keepdims=True)
    scaled = quats / np.where(largest == 0, 1, largest)
    scaled[largest[:, 0] == 0, 0] = 1
    return scaled / np.sqrt((scaled * scaled).sum(1, keepdims=True))


def opacity_bytes(opacity_logits: np.ndarray) -> np.ndarray:
    """(N,) uint8: 255 · opacity."""
    with np.errstate(over="ignore"):
        return to_bytes(255 / (1 + np.exp(-opacity_logits)))


def opacity_logits(alpha: np.ndarray) -> np.ndarray:
    """(N,) float32 logits of uint8 opacities.

    0 and 255 have no logit: they are moved by a quarter of a step towards the middle. The result
    renders the same, is written back as the same byte, and can still be trained.
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
    """Rounded and clamped to 0 … 255, as uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def log_scales(scales: np.ndarray) -> np.ndarray:
    """Logarithms of standard deviations; values up to 0, of flat Gaussians, count as 1e-12."""
    return np.log(np.where(scales <= 0, np.float32(_SMALLEST_SCALE), scales))  # NaN stays NaN


def largest_of_four(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The "smallest three" encoding of unit quaternions (N, 4).

    Returns the index (N,) of the largest entry and the three other entries (N, 3) in their order,
    each within ±1/√2. The sign is chosen such that the largest entry is positive. So it can be
    computed from the three others.
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


def flip_axes(gaussians: GaussianArrays, signs: tuple[int, int, int] = UP_BACK) -> GaussianArrays:
    """The Gaussians with each axis multiplied by its sign, ±1; float64 positions stay float64.

    A rotation R becomes M R M, where M is the diagonal matrix of the signs. That is a rotation
    again, even if M is a reflection.
    """
    x, y, z = signs
    quat_signs = (1, y * z, x * z, x * y)
    # The sign change of each real spherical harmonic: up to even polynomials, they are products of
    # x, y, z in the order y z x | xy yz 1 xz 1 | y xyz y z x z x.
    sh_signs = (y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x)
    rest = np.array(sh_signs[: gaussians.sh_rest.shape[1]], np.float32)[:, None]
    return replace(
        gaussians,
        means=gaussians.means * np.array(signs, np.float32),
        quats=gaussians.quats * np.array(quat_signs, np.float32),
        sh_rest=gaussians.sh_rest * rest,
    )
