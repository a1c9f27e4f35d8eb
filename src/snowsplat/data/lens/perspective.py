"""The lenses that distort the image of a pinhole camera."""

from __future__ import annotations

import math
from abc import abstractmethod

import numpy as np

from snowsplat.data.lens.lens import Image, Lens, tangential


class Perspective(Lens):
    """A lens that distorts the tangents u = x / z and v = y / z."""

    straight = True

    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        depth = np.where(z > 0, z, np.nan)
        u, v = x / depth, y / depth
        return self.distort(u, v, u * u + v * v)

    @abstractmethod
    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        """Where the lens moves the position (u, v), with r² = u² + v²."""


class FullOpenCV(
    Perspective, model="FULL_OPENCV", parameters="fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"
):
    """The rational model of OpenCV; the next models have some of its coefficients."""

    in_transforms = True

    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        k1, k2, k3, k4, k5, k6 = self.values_of("k1", "k2", "k3", "k4", "k5", "k6")
        factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if k4 or k5 or k6:
            divisor = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
            factor = factor / np.where(divisor > 0, divisor, np.nan)
        du, dv = tangential(u, v, r2, *self.values_of("p1", "p2"))
        return u * factor + du, v * factor + dv


class OpenCV(FullOpenCV, model="OPENCV", parameters="fx fy cx cy k1 k2 p1 p2"):
    """Two radial and two tangential coefficients."""


class Radial(FullOpenCV, model="RADIAL", parameters="f cx cy k1 k2"):
    """Two radial coefficients."""


class SimpleRadial(FullOpenCV, model="SIMPLE_RADIAL", parameters="f cx cy k1"):
    """One radial coefficient."""


class Pinhole(FullOpenCV, model="PINHOLE", parameters="fx fy cx cy", other_names="PERSPECTIVE"):
    """No distortion."""


class SimplePinhole(FullOpenCV, model="SIMPLE_PINHOLE", parameters="f cx cy"):
    """No distortion, and square pixels."""


class FieldOfView(Perspective, model="FOV", parameters="fx fy cx cy omega"):
    """Devernay and Faugeras 2001."""

    straight = False

    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        (omega,) = self.coefficients
        if abs(omega) < 1e-6:
            return u, v
        r = np.maximum(np.sqrt(r2), 1e-9)
        factor = np.arctan(2 * r * math.tan(omega / 2)) / (r * omega)
        return u * factor, v * factor


class Division(Lens, model="DIVISION", parameters="fx fy cx cy k"):
    """Fitzgibbon 2001."""

    straight = True

    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        (k,) = self.coefficients
        depth = (z + np.sqrt(z * z - 4 * k * (x * x + y * y))) / 2
        depth = np.where(depth > 0, depth, np.nan)
        return x / depth, y / depth


class SimpleDivision(Division, model="SIMPLE_DIVISION", parameters="f cx cy k"):
    """`Division` with square pixels."""


class EnhancedUnified(Lens, model="EUCM", parameters="fx fy cx cy alpha beta"):
    """The enhanced unified camera model; Khomutenko et al. 2016."""

    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        alpha, beta = self.coefficients
        distance = np.sqrt(beta * (x * x + y * y) + z * z)
        depth = alpha * distance + (1 - alpha) * z
        limit = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        depth = np.where((z > -limit * distance) & (depth > 0), depth, np.nan)
        return x / depth, y / depth
