"""Cameras with lens distortion: COLMAP's OPENCV and OPENCV_FISHEYE with a single focal length.

And the camera of a 360° panorama.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class _CentredLens:
    """One focal length, the principal point at the centre, and four coefficients of distortion."""

    width: int
    height: int
    focal: float  # pixels, per radian at the centre
    distortion: tuple[float, float, float, float]  # as in COLMAP's model of the same name

    @property
    def params(self) -> tuple[float, ...]:
        """Parameters of COLMAP's model: fx, fy, cx, cy, then the distortion."""
        return (self.focal, self.focal, self.width / 2, self.height / 2, *self.distortion)

    @property
    def _middle(self) -> np.ndarray:
        return np.array([[self.width / 2], [self.height / 2]])


@dataclass(frozen=True)
class Lens(_CentredLens):
    """Pixel coordinates as in `snowsplat.scene.camera.Camera`; principal point at the centre.

    A point (x, y, 1) in the camera's frame is at focal · d(x, y) from the image centre, where
    d(x, y) = (x, y) (1 + k1 r² + k2 r⁴) + (2 p1 xy + p2 (r² + 2x²), p1 (r² + 2y²) + 2 p2 xy).
    """

    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    model: ClassVar[str] = "OPENCV"

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel positions (2, P) of points (3, P) in the camera's frame, in front of it."""
        return self.focal * self._distorted(points[:2] / points[2]) + self._middle

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P).

        The inverse of `project`, by Newton's method. It converges to rounding error for weak
        distortion, such as that of a phone.
        """
        goal = (pixels - self._middle) / self.focal
        k1, k2, p1, p2 = self.distortion
        xy = goal.copy()
        for _ in range(_NEWTON_STEPS):
            x, y = xy
            r2 = x * x + y * y
            radial, growth = 1 + k1 * r2 + k2 * r2 * r2, 2 * k1 + 4 * k2 * r2
            xx = radial + x * x * growth + 2 * p1 * y + 6 * p2 * x
            yy = radial + y * y * growth + 6 * p1 * y + 2 * p2 * x
            xy_ = x * y * growth + 2 * p1 * x + 2 * p2 * y  # d(x, y) has a symmetric Jacobian
            ex, ey = self._distorted(xy) - goal
            determinant = xx * yy - xy_ * xy_
            xy = xy - np.stack([yy * ex - xy_ * ey, xx * ey - xy_ * ex]) / determinant
        rays = np.concatenate([xy, np.ones_like(xy[:1])])
        return rays / np.sqrt((rays * rays).sum(axis=0))

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        k1, k2, p1, p2 = self.distortion
        x, y = xy
        r2 = x * x + y * y
        bend = np.stack(
            [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y]
        )
        return xy * (1 + k1 * r2 + k2 * r2 * r2) + bend


@dataclass(frozen=True)
class FisheyeLens(_CentredLens):
    """As `Lens`, for a fisheye lens, which may see directions at 90° to its axis or more.

    A point at the angle θ to the axis is at focal · θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) pixels
    from the image centre.
    """

    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # k1, k2, k3, k4
    model: ClassVar[str] = "OPENCV_FISHEYE"

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixel positions (2, P) of points (3, P) in the camera's frame."""
        flat = np.hypot(points[0], points[1])
        radius = self.focal * self._distorted(np.arctan2(flat, points[2]))
        return radius * points[:2] / np.maximum(flat, 1e-300) + self._middle

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P).

        The inverse of `project`, by Newton's method.
        """
        x, y = (pixels - self._middle) / self.focal
        goal = np.hypot(x, y)
        angle = goal.copy()
        powers = 1 + 2 * np.arange(5)
        for _ in range(_NEWTON_STEPS):
            slope = sum(
                power * k * angle ** (power - 1)
                for power, k in zip(powers, (1.0, *self.distortion), strict=True)
            )
            angle = angle - (self._distorted(angle) - goal) / slope
        sine = np.sin(angle) / np.maximum(goal, 1e-300)
        return np.stack([sine * x, sine * y, np.cos(angle)])

    def _distorted(self, angle: np.ndarray) -> np.ndarray:
        k1, k2, k3, k4 = self.distortion
        squared = angle * angle
        return angle * (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4))))


@dataclass(frozen=True)
class Equirectangular:
    """The camera of a 360° panorama, in COLMAP's model EQUIRECTANGULAR.

    A column is a longitude and a row is a latitude: the direction (0, 0, 1) is at the centre of the
    image, (1, 0, 0) a quarter of the width to the right, and (0, 1, 0) in the last row.
    """

    width: int
    height: int
    model: ClassVar[str] = "EQUIRECTANGULAR"

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P)."""
        longitude = (pixels[0] / self.width - 0.5) * 2 * math.pi
        latitude = (pixels[1] / self.height - 0.5) * math.pi
        level = np.cos(latitude)
        return np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)])

    @property
    def focal(self) -> float:
        """Pixels per radian at the equator."""
        return self.width / (2 * math.pi)

    @property
    def params(self) -> tuple[float, ...]:
        """Parameters of COLMAP's EQUIRECTANGULAR: the width and the height in pixels."""
        return (float(self.width), float(self.height))


#: The camera of a photo.
AnyLens = Lens | FisheyeLens | Equirectangular
