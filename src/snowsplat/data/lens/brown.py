"""`as_colmap`: a lens of the model "BROWN" in the nearest model of COLMAP, for files of COLMAP."""

from __future__ import annotations

import math

import numpy as np

from snowsplat.data.lens.lens import Lens
from snowsplat.data.lens.models import lens_of

_SAMPLES = 400  # radii at which a lens is fitted
_GRID = 33  # pixels of the photo along each side, at which the error is measured


def as_colmap(lens: Lens) -> tuple[Lens, float]:
    """The lens in a model of COLMAP, and the largest difference in the photo, in pixels.

    COLMAP has neither r⁸ nor skew. The radial part is fitted by the ratio of two polynomials of
    FULL_OPENCV; the skew is left out. Other models are returned as they are.
    """
    if lens.model != "BROWN":
        return lens, 0.0
    fx, fy, cx, cy, *radial, p1, p2, _ = lens.params
    (k1, k2, k3), divisor = _ratio(lens, radial)
    params = (fx, fy, cx, cy, k1, k2, p1, p2, k3, *divisor)
    made = lens_of("FULL_OPENCV", lens.width, lens.height, params)
    x, y = np.meshgrid(np.linspace(0, lens.width, _GRID), np.linspace(0, lens.height, _GRID))
    rays = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], -1)
    at, there = lens.project(rays), made.project(rays)
    inside = ((at >= 0) & (at <= (lens.width, lens.height))).all(-1)
    error = np.linalg.norm(there - at, axis=-1)[inside]
    return made, float(error.max(initial=0.0)) if np.isfinite(error).all() else math.inf


def _ratio(lens: Lens, radial: list[float]) -> tuple[list[float], list[float]]:
    """Coefficients of r², r⁴ and r⁶ of a numerator and of a divisor that act as r² … r⁸. Least
    squares of N(r) − g(r) D(r), which is linear, over the radii that the photo shows."""
    fx, fy, cx, cy = lens.params[:4]
    corner = math.hypot(max(cx, lens.width - cx) / fx, max(cy, lens.height - cy) / fy)
    # The smallest radius that is distorted to that of the corner.
    r = np.linspace(0.0, 4.0 * corner, 8 * _SAMPLES)
    outside = np.flatnonzero(~(r * _polynomial(r, radial) < corner))
    limit = r[outside[0]] if len(outside) else r[-1]
    r = np.linspace(0.0, limit, _SAMPLES)[1:]
    g, s = _polynomial(r, radial), (r / limit) ** 2  # scaled, for a well conditioned matrix
    powers = np.column_stack([s, s**2, s**3])
    matrix = np.column_stack([powers, -g[:, None] * powers]) * r[:, None]
    scaled = np.linalg.lstsq(matrix, (g - 1.0) * r, rcond=1e-12)[0].reshape(2, 3)
    numerator, divisor = (scaled / limit ** (2 * np.arange(1, 4))).tolist()
    return numerator, divisor


def _polynomial(r: np.ndarray, radial: list[float]) -> np.ndarray:
    return np.polynomial.polynomial.polyval(r * r, (1.0, *radial))
