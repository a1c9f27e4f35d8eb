"""The lenses that map the angle to the optical axis: fisheyes and panoramas."""

from __future__ import annotations

import math

import numpy as np

from snowsplat.data.lens.lens import TINY, Image, Lens, tangential


class OpenCVFisheye(Lens, model="OPENCV_FISHEYE", parameters="fx fy cx cy k1 k2 k3 k4"):
    """θ (1 + k₁ θ² + k₂ θ⁴ + …), Kannala and Brandt 2006; the other fisheyes add to it."""

    angular = True
    in_transforms = True

    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        sine = np.hypot(x, y)
        scale = np.where(sine > TINY, np.arctan2(sine, z) / np.maximum(sine, TINY), 1 / np.abs(z))
        u, v = x * scale, y * scale
        return self.distort(u, v, u * u + v * v)

    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        """Where the lens moves the position (u, v), at the angle r to the axis."""
        factor = np.zeros_like(r2)
        for coefficient in reversed(self.coefficients[:6]):
            factor = r2 * (coefficient + factor)
        return u + u * factor, v + v * factor


class RadialFisheye(OpenCVFisheye, model="RADIAL_FISHEYE", parameters="f cx cy k1 k2"):
    """Two coefficients."""


class SimpleRadialFisheye(OpenCVFisheye, model="SIMPLE_RADIAL_FISHEYE", parameters="f cx cy k1"):
    """One coefficient."""


class Fisheye(OpenCVFisheye, model="FISHEYE", parameters="fx fy cx cy"):
    """Equidistant."""


class SimpleFisheye(OpenCVFisheye, model="SIMPLE_FISHEYE", parameters="f cx cy"):
    """Equidistant, with square pixels."""


class ThinPrismFisheye(
    OpenCVFisheye, model="THIN_PRISM_FISHEYE", parameters="fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"
):
    """Weng et al. 1992, on the angle."""

    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        k1, k2, p1, p2, k3, k4, s1, s2 = self.coefficients
        radial = r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        du, dv = tangential(u, v, r2, p1, p2)
        return u + u * radial + du + s1 * r2, v + v * radial + dv + s2 * r2


class AriaFisheye(
    OpenCVFisheye,
    model="RAD_TAN_THIN_PRISM_FISHEYE",
    parameters="fx fy cx cy k1 k2 k3 k4 k5 k6 p0 p1 s0 s1 s2 s3",
    other_names="FISHEYE624",
):
    """Fisheye624 of Project Aria: six radial, two tangential and four thin prism coefficients."""

    def distort(self, u: np.ndarray, v: np.ndarray, r2: np.ndarray) -> Image:
        u, v = super().distort(u, v, r2)
        p0, p1, s0, s1, s2, s3 = self.coefficients[6:]
        r2 = u * u + v * v
        du, dv = tangential(u, v, r2, p1, p0)
        return u + du + r2 * (s0 + r2 * s1), v + dv + r2 * (s2 + r2 * s3)


class Equirectangular(Lens, model="EQUIRECTANGULAR", parameters="width height"):
    """A panorama: longitude and latitude. Its parameters are its width and height."""

    panoramic = True
    in_transforms = True

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """The focal lengths are those of the centre, in pixels per radian."""
        width, height = self.width, self.height
        return width / (2 * math.pi), height / math.pi, width / 2, height / 2

    @property
    def coefficients(self) -> tuple[float, ...]:
        return ()

    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        return np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """As in the other models, in closed form."""
        angles = self._central(pixels)
        (x, y), (level, down) = np.sin(angles).T, np.cos(angles).T
        return np.column_stack([down * x, y, down * level])
