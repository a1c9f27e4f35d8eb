"""The lenses of other programs, in the camera models of COLMAP.

Pixels are those of `Camera`: the centre of the first pixel is at (0.5, 0.5). Coefficients of
tangential distortion are in the order of OpenCV: x += 2 p₁ x y + p₂ (r² + 2 x²).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np

from snowsplat.data.imports.values import damaged, size_of
from snowsplat.data.lens.model import LensModel

logger = logging.getLogger(__name__)

#: fx, fy, cx, cy in pixels.
Intrinsics = tuple[float, float, float, float]

# Pixels: a lens is fitted with a larger error only with a warning.
_FIT_ERROR = 0.05
_SAMPLES = 400  # radii at which a lens is fitted


def perspective(
    where: object,
    width: float,
    height: float,
    intrinsics: Intrinsics,
    radial: Sequence[float] = (),
    tangential: Sequence[float] = (0.0, 0.0),
) -> LensModel:
    """A lens of Brown's model: x (1 + k₁ r² + k₂ r⁴ + k₃ r⁶ + k₄ r⁸), with x = X / Z.

    COLMAP's models have no r⁸. If k₄ is not 0, the radial part is fitted by the ratio of two
    polynomials of FULL_OPENCV, and a warning tells an error above a twentieth of a pixel.

    Args:
        where: the start of error messages.
        radial: k₁, k₂ …, at most four.
        tangential: p₁, p₂.

    Raises:
        UserError: the size or a focal length is not valid, or the lens cannot be fitted.
    """
    size = _checked(where, width, height, intrinsics)
    k1, k2, k3, k4 = [*radial, 0.0, 0.0, 0.0, 0.0][:4]
    p1, p2 = tangential
    if not any((k1, k2, k3, k4, p1, p2)):
        return LensModel("PINHOLE", *size, intrinsics)
    if not (k3 or k4):
        return LensModel("OPENCV", *size, (*intrinsics, k1, k2, p1, p2))
    divisor = (0.0, 0.0, 0.0)
    if k4:
        (k1, k2, k3), divisor = _without_r8(where, size, intrinsics, (k1, k2, k3, k4))
    return LensModel("FULL_OPENCV", *size, (*intrinsics, k1, k2, p1, p2, k3, *divisor))


def fisheye(
    where: object,
    width: float,
    height: float,
    intrinsics: Intrinsics,
    radial: Sequence[float] = (),
    tangential: Sequence[float] = (0.0, 0.0),
) -> LensModel:
    """An equidistant lens: θ (1 + k₁ θ² + k₂ θ⁴ + k₃ θ⁶ + k₄ θ⁸); arguments of `perspective`."""
    size = _checked(where, width, height, intrinsics)
    k1, k2, k3, k4 = [*radial, 0.0, 0.0, 0.0, 0.0][:4]
    p1, p2 = tangential
    if p1 or p2:
        params = (*intrinsics, k1, k2, p1, p2, k3, k4, 0.0, 0.0)
        return LensModel("THIN_PRISM_FISHEYE", *size, params)
    return LensModel("OPENCV_FISHEYE", *size, (*intrinsics, k1, k2, k3, k4))


def equirectangular(where: object, width: float, height: float) -> LensModel:
    """A panorama of the whole sphere."""
    size = size_of(where, width, height)
    return LensModel("EQUIRECTANGULAR", *size, (float(size[0]), float(size[1])))


def centred(width: float, height: float, focal: float) -> Intrinsics:
    """One focal length, and the principal point in the middle."""
    return focal, focal, width / 2, height / 2


def _checked(where: object, width: float, height: float, intrinsics: Intrinsics) -> tuple[int, int]:
    size = size_of(where, width, height)
    fx, fy, _, _ = intrinsics
    if not (0 < fx < 1e9 and 0 < fy < 1e9):
        raise damaged(where, f"the focal lengths {fx:g} and {fy:g} pixels are not valid")
    return size


def _without_r8(
    where: object,
    size: tuple[int, int],
    intrinsics: Intrinsics,
    radial: tuple[float, float, float, float],
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Three coefficients of the numerator and three of the divisor that act as the four given.

    Least squares of N(r) − g(r) D(r), which is linear, over the radii that the photo shows.
    """
    fx, fy, cx, cy = intrinsics
    corner = math.hypot(max(cx, size[0] - cx) / fx, max(cy, size[1] - cy) / fy)

    def factor(r: np.ndarray) -> np.ndarray:
        return np.polynomial.polynomial.polyval(r * r, (1.0, *radial))

    # The directions of the corners: the smallest radius that is distorted to that of the corner.
    r = np.linspace(0.0, 4.0 * corner, 8 * _SAMPLES)
    with np.errstate(over="ignore", invalid="ignore"):
        outside = np.flatnonzero(~(r * factor(r) < corner))
        limit = r[outside[0]] if len(outside) else r[-1]
        r = np.linspace(0.0, limit, _SAMPLES)[1:]
        g, s = factor(r), (r / limit) ** 2  # scaled, so that the matrix is well conditioned
    powers = np.column_stack([s, s**2, s**3])
    matrix = np.column_stack([powers, -g[:, None] * powers]) * r[:, None]
    if not (np.isfinite(matrix).all() and limit > 0):
        raise damaged(where, "the lens distortion is not valid")
    scaled = np.linalg.lstsq(matrix, (g - 1.0) * r, rcond=1e-12)[0].reshape(2, 3)
    divided = 1.0 + powers @ scaled[1]
    error = max(fx, fy) * np.abs(((1.0 + powers @ scaled[0]) / divided - g) * r).max()
    if not (divided > 0).all() or not error < 0.01 * max(size):
        raise damaged(where, "the lens distortion (k4) fits none of the supported lenses")
    if error > _FIT_ERROR:
        logger.warning(
            "%s: the lens distortion has a term r^8, which is approximated with an error of up to "
            "%.2g pixels; align the photos again without k4 if that matters",
            *(where, error),
        )
    numerator, divisor = (scaled / limit ** (2 * np.arange(1, 4))).tolist()
    return tuple(numerator), tuple(divisor)
