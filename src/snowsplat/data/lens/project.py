"""Lenses: from directions in the frame of a camera to pixels of its photo, and back.

https://colmap.github.io/cameras.html describes the models. A model whose equation is a polynomial
may fold: beyond some angle the pixels return to the centre. `field` finds this angle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Models with one focal length; the others, except EQUIRECTANGULAR, start with fx, fy.
_ONE_FOCAL_LENGTH = frozenset(
    {
        "SIMPLE_PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "SIMPLE_RADIAL_FISHEYE",
        "RADIAL_FISHEYE",
        "SIMPLE_DIVISION",
        "SIMPLE_FISHEYE",
    }
)
#: The model of Metashape and RealityScan, which COLMAP does not have: fx, fy, cx, cy, k1, k2, k3,
#: k4 (of r⁸), p1, p2 as in OPENCV, and the skew divided by fx.
BROWN = "BROWN"
_TINY = 1e-12
_NEWTON_STEPS = 30


@dataclass(frozen=True)
class LensModel:
    """The intrinsics of a distorted photo: one of COLMAP's camera models and its parameters.

    https://colmap.github.io/cameras.html lists the models and the order of their parameters.
    """

    model: str  # the name of a camera model of COLMAP, e.g. "OPENCV_FISHEYE"; or `BROWN`
    width: int  # pixels, of the photos that ``params`` are for
    height: int
    params: tuple[float, ...]  # focal lengths and principal point in pixels, then coefficients


def intrinsics(lens: LensModel) -> tuple[float, float, float, float, tuple[float, ...]]:
    """fx, fy, cx, cy in pixels, and the coefficients that follow.

    For EQUIRECTANGULAR the focal lengths are those of the centre, in pixels per radian.
    """
    p, width, height = lens.params, lens.width, lens.height
    if lens.model == "EQUIRECTANGULAR":
        return width / (2 * math.pi), height / math.pi, width / 2, height / 2, ()
    if lens.model in _ONE_FOCAL_LENGTH:
        return p[0], p[0], p[1], p[2], p[3:]
    return p[0], p[1], p[2], p[3], p[4:]


def project(lens: LensModel, rays: np.ndarray) -> np.ndarray:
    """The pixels (..., 2) of directions (..., 3), of any length, in OpenCV axes.

    float32 for directions in float32, otherwise float64. NaN where the model has no pixel.
    Positions outside of the photo are returned as they are.
    """
    rays = np.asarray(rays)
    if rays.dtype != np.float32:
        rays = rays.astype(np.float64)
    x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
    fx, fy, cx, cy, k = intrinsics(lens)
    with np.errstate(all="ignore"):
        if lens.model == "EQUIRECTANGULAR":
            u, v = np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))
        elif "FISHEYE" in lens.model:
            u, v = _fisheye(lens.model, k, x, y, z)
        else:
            u, v = _perspective(lens.model, k, x, y, z)
        u, v = fx * u + cx, fy * v + cy
    pixels = np.stack([u, v], -1)
    pixels[~(np.isfinite(u) & np.isfinite(v))] = np.nan
    return pixels


def unproject(lens: LensModel, pixels: np.ndarray) -> np.ndarray:
    """x / z and y / z (N, 2) of the directions of pixels (N, 2); NaN if there are none in front.

    By Newton's method, from the direction of a lens without coefficients.
    """
    fx, fy, cx, cy, _ = intrinsics(lens)
    found = (np.asarray(pixels, np.float64) - (cx, cy)) / (fx, fy)
    if "FISHEYE" in lens.model:  # the angle instead of its tangent
        angle = np.maximum(np.linalg.norm(found, axis=1, keepdims=True), _TINY)
        found = found * np.tan(np.minimum(angle, 1.55)) / angle
    return _solved(
        lens,
        pixels,
        found,
        ray_of=lambda tangents: np.column_stack([tangents, np.ones(len(tangents))]),
        step_of=lambda tangents: 1e-6 * (1 + np.abs(tangents).max(1, keepdims=True)),
    )


def _fisheye(
    model: str, k: tuple[float, ...], x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The models of a fisheye: distortion of the angle to the optical axis."""
    sine = np.hypot(x, y)
    scale = np.where(sine > _TINY, np.arctan2(sine, z) / np.maximum(sine, _TINY), 1 / np.abs(z))
    u, v = x * scale, y * scale
    r2 = u * u + v * v
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, s1, s2 = k
        radial = r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        du, dv = _tangential(u, v, r2, p1, p2)
        return u + u * radial + du + s1 * r2, v + v * radial + dv + s2 * r2
    factor = np.zeros_like(r2)
    for coefficient in reversed(k[:6]):
        factor = r2 * (coefficient + factor)
    u, v = u + u * factor, v + v * factor
    if model == "RAD_TAN_THIN_PRISM_FISHEYE":
        p0, p1, s0, s1, s2, s3 = k[6:]
        r2 = u * u + v * v
        du, dv = _tangential(u, v, r2, p1, p0)
        return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)
    return u, v


def _perspective(
    model: str, k: tuple[float, ...], x: np.ndarray, y: np.ndarray, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The models whose coefficients distort the image of a pinhole camera."""
    if model == "EUCM":
        alpha, beta = k
        distance = np.sqrt(beta * (x * x + y * y) + z * z)
        depth = alpha * distance + (1 - alpha) * z
        limit = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        depth = np.where((z > -limit * distance) & (depth > 0), depth, np.nan)
        return x / depth, y / depth
    if model in ("SIMPLE_DIVISION", "DIVISION"):
        depth = (z + np.sqrt(z * z - 4 * k[0] * (x * x + y * y))) / 2
        depth = np.where(depth > 0, depth, np.nan)
        return x / depth, y / depth
    depth = np.where(z > 0, z, np.nan)
    u, v = x / depth, y / depth
    r2 = u * u + v * v
    if model == BROWN:
        k1, k2, k3, k4, p1, p2, skew = k
        factor = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        du, dv = _tangential(u, v, r2, p1, p2)
        u, v = u * factor + du, v * factor + dv
        return u + skew * v, v
    if model == "FOV":
        if abs(omega := k[0]) < 1e-6:
            return u, v
        r = np.maximum(np.sqrt(r2), 1e-9)
        factor = np.arctan(2 * r * math.tan(omega / 2)) / (r * omega)
        return u * factor, v * factor
    if model in ("OPENCV", "FULL_OPENCV"):
        k1, k2, p1, p2, k3, k4, k5, k6 = (*k, 0.0, 0.0, 0.0, 0.0)[:8]
        factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if k4 or k5 or k6:
            divisor = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            factor = factor / np.where(divisor > 0, divisor, np.nan)
        du, dv = _tangential(u, v, r2, p1, p2)
        return u * factor + du, v * factor + dv
    k1, k2 = (*k, 0.0, 0.0)[:2]  # SIMPLE_RADIAL, RADIAL and the two pinhole models
    factor = 1 + r2 * (k1 + r2 * k2)
    return u * factor, v * factor


def _tangential(
    u: np.ndarray, v: np.ndarray, r2: np.ndarray, p1: float, p2: float
) -> tuple[np.ndarray, np.ndarray]:
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def directions(lens: LensModel, pixels: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) of pixels (N, 2), also at 90° or more to the axis; NaN: none.

    By Newton's method in the plane of the angles to the axis, from the lens without coefficients.
    """
    fx, fy, cx, cy, _ = intrinsics(lens)
    pixels = np.asarray(pixels, np.float64)
    angles = (pixels - (cx, cy)) / (fx, fy)
    if lens.model == "EQUIRECTANGULAR":  # longitude and latitude
        (x, y), (level, down) = np.sin(angles).T, np.cos(angles).T
        return np.column_stack([down * x, y, down * level])
    if not lens.model.endswith("FISHEYE"):  # these are tangents
        tangent = np.maximum(np.linalg.norm(angles, axis=1, keepdims=True), _TINY)
        angles = angles * np.arctan(tangent) / tangent
    return _turned(_solved(lens, pixels, angles, ray_of=_turned, step_of=lambda _: 1e-6))


def _solved(
    lens: LensModel,
    pixels: np.ndarray,
    found: np.ndarray,
    ray_of: Callable[[np.ndarray], np.ndarray],
    step_of: Callable[[np.ndarray], np.ndarray | float],
) -> np.ndarray:
    """The values (N, 2) whose rays have these pixels, by Newton's method from ``found``; NaN: none.

    Args:
        ray_of: the directions (N, 3) of values (N, 2).
        step_of: the difference, (N, 1) or one, from which derivatives at these values are computed.
    """
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            step = step_of(found)
            at, right, down = (
                project(lens, ray_of(found + step * np.array(axis)))
                for axis in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
            )
            (a, b), (c, d) = ((right - at) / step).T, ((down - at) / step).T
            x, y = (at - pixels).T
            change = np.column_stack([d * x - c * y, a * y - b * x])
            found = found - change / (a * d - b * c)[:, None]
            wrong = np.hypot(x, y)
            if not (wrong > 1e-6).any():
                break
    return np.where((wrong < 1e-3)[:, None], found, np.nan)


def _turned(angles: np.ndarray) -> np.ndarray:
    """The axis (0, 0, 1), turned by angles (N, 2) in radians towards x and y."""
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    return np.concatenate([angles * np.sinc(angle / math.pi), np.cos(angle)], 1)
