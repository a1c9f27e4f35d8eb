"""The table of all camera models with their equations, `lens_of`, which finds one by its name, and
`as_colmap`, the nearest model for files of COLMAP.

https://colmap.github.io/cameras.html describes the models. u and v are positions in an image with
the focal length 1; r² = u² + v².
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from snowsplat.data.lens.lens import Equation, Image, Lens, Model

if TYPE_CHECKING:
    from snowsplat.scene.camera import Camera

_TINY = 1e-12
_RADII = 400  # at which a lens of Brown is fitted
_GRID = 33  # pixels of the photo along each side, at which the error of that is measured


def _tangents(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
    """u, v and r² of a pinhole camera."""
    depth = np.where(z > 0, z, np.nan)
    u, v = x / depth, y / depth
    return u, v, u * u + v * v


def _angles(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
    """u, v and r² of an equidistant fisheye: r is the angle to the axis."""
    sine = np.hypot(x, y)
    scale = np.where(sine > _TINY, np.arctan2(sine, z) / np.maximum(sine, _TINY), 1 / np.abs(z))
    u, v = x * scale, y * scale
    return u, v, u * u + v * v


def _tangential(u: np.ndarray, v: np.ndarray, r2: np.ndarray, p1: float, p2: float) -> Image:
    """What the tangential distortion of OpenCV adds to u and v."""
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def opencv(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """The rational model of OpenCV, or a model with some of its coefficients."""
    u, v, r2 = _tangents(x, y, z)
    k1, k2, k3, k4, k5, k6 = lens.values_of("k1", "k2", "k3", "k4", "k5", "k6")
    factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    if k4 or k5 or k6:
        divisor = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        factor = factor / np.where(divisor > 0, divisor, np.nan)
    du, dv = _tangential(u, v, r2, *lens.values_of("p1", "p2"))
    return u * factor + du, v * factor + dv


def brown(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Brown's model with r⁸, and with the skew divided by fx: Metashape, RealityScan."""
    u, v, r2 = _tangents(x, y, z)
    k1, k2, k3, k4, p1, p2, skew = lens.coefficients
    factor = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    du, dv = _tangential(u, v, r2, p1, p2)
    u, v = u * factor + du, v * factor + dv
    return u + skew * v, v


def field_of_view(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Devernay and Faugeras 2001."""
    u, v, r2 = _tangents(x, y, z)
    (omega,) = lens.coefficients
    if abs(omega) < 1e-6:
        return u, v
    r = np.maximum(np.sqrt(r2), 1e-9)
    factor = np.arctan(2 * r * math.tan(omega / 2)) / (r * omega)
    return u * factor, v * factor


def division(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Fitzgibbon 2001."""
    (k,) = lens.coefficients
    depth = (z + np.sqrt(z * z - 4 * k * (x * x + y * y))) / 2
    depth = np.where(depth > 0, depth, np.nan)
    return x / depth, y / depth


def enhanced_unified(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Khomutenko et al. 2016."""
    alpha, beta = lens.coefficients
    distance = np.sqrt(beta * (x * x + y * y) + z * z)
    depth = alpha * distance + (1 - alpha) * z
    limit = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
    depth = np.where((z > -limit * distance) & (depth > 0), depth, np.nan)
    return x / depth, y / depth


def fisheye(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """θ (1 + k₁ θ² + k₂ θ⁴ + …), with at most six coefficients; Kannala and Brandt 2006."""
    u, v, r2 = _angles(x, y, z)
    factor = np.zeros_like(r2)
    for coefficient in reversed(lens.coefficients[:6]):
        factor = r2 * (coefficient + factor)
    return u + u * factor, v + v * factor


def thin_prism_fisheye(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Weng et al. 1992, on the angle."""
    u, v, r2 = _angles(x, y, z)
    k1, k2, p1, p2, k3, k4, s1, s2 = lens.coefficients
    radial = r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    du, dv = _tangential(u, v, r2, p1, p2)
    return u + u * radial + du + s1 * r2, v + v * radial + dv + s2 * r2


def aria_fisheye(lens: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """Project Aria's Fisheye624: `fisheye`, then tangential and thin prism distortion."""
    u, v = fisheye(lens, x, y, z)
    p0, p1, s0, s1, s2, s3 = lens.coefficients[6:]
    r2 = u * u + v * v
    du, dv = _tangential(u, v, r2, p1, p0)
    return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


def longitude_and_latitude(_: Lens, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
    """A panorama of all directions."""
    return np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))


_F, _FXY = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
_OPENCV = (*_FXY, "k1", "k2", "p1", "p2")
_RATIONAL = (*_OPENCV, "k3", "k4", "k5", "k6")
_BROWN = (*_FXY, "k1", "k2", "k3", "k4", "p1", "p2", "skew")
_THIN_PRISM = (*_OPENCV, "k3", "k4", "sx1", "sy1")
_ARIA = (*_FXY, "k1", "k2", "k3", "k4", "k5", "k6", "p0", "p1", "s0", "s1", "s2", "s3")


def _fisheye(
    name: str, parameters: tuple[str, ...], equation: Equation = fisheye, *others: str
) -> Model:
    return Model(name, parameters, equation, (name, *others), angular=True)


def _opencv(
    name: str, parameters: tuple[str, ...], equation: Equation = opencv, *others: str
) -> Model:
    return Model(name, parameters, equation, (name, *others), straight=True)


#: The models of COLMAP; the index is the number of a model in its binary files.
COLMAP_MODELS = (
    _opencv("SIMPLE_PINHOLE", _F),
    _opencv("PINHOLE", _FXY, opencv, "PERSPECTIVE"),
    _opencv("SIMPLE_RADIAL", (*_F, "k1")),
    _opencv("RADIAL", (*_F, "k1", "k2")),
    _opencv("OPENCV", _OPENCV),
    _fisheye("OPENCV_FISHEYE", (*_FXY, "k1", "k2", "k3", "k4")),
    _opencv("FULL_OPENCV", _RATIONAL),
    Model("FOV", (*_FXY, "omega"), field_of_view),
    _fisheye("SIMPLE_RADIAL_FISHEYE", (*_F, "k1")),
    _fisheye("RADIAL_FISHEYE", (*_F, "k1", "k2")),
    _fisheye("THIN_PRISM_FISHEYE", _THIN_PRISM, thin_prism_fisheye),
    _fisheye("RAD_TAN_THIN_PRISM_FISHEYE", _ARIA, aria_fisheye, "FISHEYE624"),
    Model("SIMPLE_DIVISION", (*_F, "k"), division, straight=True),
    Model("DIVISION", (*_FXY, "k"), division, straight=True),
    _fisheye("SIMPLE_FISHEYE", _F),
    _fisheye("FISHEYE", _FXY),
    Model("EUCM", (*_FXY, "alpha", "beta"), enhanced_unified),
    Model("EQUIRECTANGULAR", ("width", "height"), longitude_and_latitude, panoramic=True),
)
#: All models by name.
MODELS = {model.name: model for model in (*COLMAP_MODELS, _opencv("BROWN", _BROWN, brown))}


def pinhole_of(camera: Camera) -> Lens:
    """The lens of a camera, which has no distortion."""
    params = camera.fx, camera.fy, camera.cx, camera.cy
    return lens_of("PINHOLE", camera.width, camera.height, params)


def lens_of(model: str, width: int, height: int, params: Iterable[float]) -> Lens:
    """The lens of a model in `MODELS`; ``params`` are in the order of `Model.parameters`."""
    return Lens(MODELS[model], width, height, tuple(params))


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
    r = np.linspace(0.0, 4.0 * corner, 8 * _RADII)
    outside = np.flatnonzero(~(r * _polynomial(r, radial) < corner))
    limit = r[outside[0]] if len(outside) else r[-1]
    r = np.linspace(0.0, limit, _RADII)[1:]
    g, s = _polynomial(r, radial), (r / limit) ** 2  # scaled, for a well conditioned matrix
    powers = np.column_stack([s, s**2, s**3])
    matrix = np.column_stack([powers, -g[:, None] * powers]) * r[:, None]
    scaled = np.linalg.lstsq(matrix, (g - 1.0) * r, rcond=1e-12)[0].reshape(2, 3)
    numerator, divisor = (scaled / limit ** (2 * np.arange(1, 4))).tolist()
    return numerator, divisor


def _polynomial(r: np.ndarray, radial: list[float]) -> np.ndarray:
    return np.polynomial.polynomial.polyval(r * r, (1.0, *radial))
