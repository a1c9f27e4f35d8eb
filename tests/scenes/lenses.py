"""Cameras of the ray tracer besides that of a phone: a fisheye lens, and a 360° panorama."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from snowsplat.synthetic.photographer import CentredLens
from snowsplat.trajectory.video_file import panorama_xmp

_NEWTON_STEPS = 8
_FISHEYE_DISTORTION = (0.03, -0.008, 0.001, 0.0)  # OPENCV_FISHEYE: k1 … k4; of an action camera


@dataclass(frozen=True)
class FisheyeLens(CentredLens):
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

    @property
    def xmp(self) -> bytes:
        """The metadata of its photos."""
        return panorama_xmp(self.width, self.height)

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


def fisheye_lens(
    width: int,
    height: int,
    angle: float,
    distortion: tuple[float, float, float, float] = _FISHEYE_DISTORTION,
) -> FisheyeLens:
    """A fisheye lens that fills the frame; ``angle``: its field of view in degrees from corner to
    corner, without distortion."""
    focal = math.hypot(width, height) / 2 / math.radians(angle / 2)
    return FisheyeLens(width, height, focal, distortion)
