"""The camera of a phone, with lens distortion: COLMAP's OPENCV with a single focal length."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class CentredLens:
    """One focal length, the principal point at the centre, and four coefficients of distortion."""

    width: int
    height: int
    focal: float  # pixels, per radian at the centre
    distortion: tuple[float, float, float, float]  # as in COLMAP's model of the same name
    model: ClassVar[str]  # the name of COLMAP's model
    xmp: ClassVar[bytes | None] = None  # metadata of the photos

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (3, P) in the camera's frame, of pixel positions (2, P)."""
        raise NotImplementedError

    @property
    def params(self) -> tuple[float, ...]:
        """Parameters of COLMAP's model: fx, fy, cx, cy, then the distortion."""
        return (self.focal, self.focal, self.width / 2, self.height / 2, *self.distortion)

    @property
    def _middle(self) -> np.ndarray:
        return np.array([[self.width / 2], [self.height / 2]])


@dataclass(frozen=True)
class Lens(CentredLens):
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
