"""`Lens`: from directions in the frame of a camera to pixels of its photo, and back.

https://colmap.github.io/cameras.html describes the models; `models` lists a class for each of them.
A model whose equation is a polynomial may fold: beyond some angle the pixels return to the centre.
`views` finds this angle.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

TINY = 1e-12
_NEWTON_STEPS = 30

#: x and y of positions in an image with the focal length 1 and the principal point at (0, 0).
Image = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Lens(ABC):
    """The intrinsics of a photo. A subclass is a camera model.

    Attributes:
        width, height: in pixels, of the photos that ``params`` are for.
        params: the values of ``parameters``; focal lengths and principal point in pixels.
        model: the name of the model in COLMAP; in capitals, also if COLMAP does not have it.
        parameters: their names, in the order of COLMAP. Models with "f" instead of "fx" and "fy"
            have one focal length. Coefficients are called as in OpenCV.
        other_names: of the model in transforms.json.
        in_transforms: transforms.json may have the model.
        angular: a fisheye: the angle to the optical axis is distorted, and not its tangent.
        straight: without coefficients, it is a pinhole camera.
        panoramic: shows all directions; the left border of a photo continues at its right border.
    """

    width: int
    height: int
    params: tuple[float, ...]

    model: ClassVar[str]
    parameters: ClassVar[tuple[str, ...]]
    other_names: ClassVar[tuple[str, ...]] = ()
    in_transforms: ClassVar[bool] = False
    angular: ClassVar[bool] = False
    straight: ClassVar[bool] = False
    panoramic: ClassVar[bool] = False

    def __init_subclass__(
        cls, model: str = "", parameters: str = "", other_names: str = ""
    ) -> None:
        """A model is declared by the arguments of its class, with spaces between names."""
        if model:
            cls.model, cls.parameters = model, tuple(parameters.split())
            cls.other_names = tuple(other_names.split())

    @abstractmethod
    def image_of(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> Image:
        """Where directions are in the image; not finite where the model has no position."""

    def as_colmap(self) -> tuple[Lens, float]:
        """This lens in a model of COLMAP, and the largest difference in the photo, in pixels."""
        return self, 0.0

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels."""
        p = self.params
        return (p[0], p[0], p[1], p[2]) if self.parameters[0] == "f" else (p[0], p[1], p[2], p[3])

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The parameters that follow focal lengths and principal point."""
        return self.params[3 if self.parameters[0] == "f" else 4 :]

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion. A fisheye without coefficients is no pinhole."""
        return self.straight and not any(self.coefficients)

    def values_of(self, *names: str) -> list[float]:
        """The values of parameters; 0 for those that the model does not have."""
        values = dict(zip(self.parameters, self.params, strict=True))
        return [values.get(name, 0.0) for name in names]

    def project(self, rays: np.ndarray) -> np.ndarray:
        """The pixels (..., 2) of directions (..., 3), of any length, in OpenCV axes.

        float32 for directions in float32, otherwise float64. NaN where the model has no pixel.
        Positions outside of the photo are returned as they are.
        """
        rays = np.asarray(rays)
        if rays.dtype != np.float32:
            rays = rays.astype(np.float64)
        fx, fy, cx, cy = self.intrinsics
        with np.errstate(all="ignore"):
            u, v = self.image_of(rays[..., 0], rays[..., 1], rays[..., 2])
            u, v = fx * u + cx, fy * v + cy
        pixels = np.stack([u, v], -1)
        pixels[~(np.isfinite(u) & np.isfinite(v))] = np.nan
        return pixels

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """x / z and y / z (N, 2) of the directions of pixels (N, 2); NaN: none in front.

        By Newton's method, from the direction of a lens without coefficients.
        """
        start = self._central(pixels)
        if self.angular:
            angle = np.maximum(np.linalg.norm(start, axis=1, keepdims=True), TINY)
            start = start * np.tan(np.minimum(angle, 1.55)) / angle
        return self._newton(
            pixels,
            start,
            ray_of=lambda tangents: np.column_stack([tangents, np.ones(len(tangents))]),
            step_of=lambda tangents: 1e-6 * (1 + np.abs(tangents).max(1, keepdims=True)),
        )

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Unit directions (N, 3) of pixels (N, 2), also at 90° or more to the axis; NaN: none.

        By Newton's method in the plane of the angles to the axis, from the lens without
        coefficients.
        """
        angles = self._central(pixels)
        if not self.angular:
            tangent = np.maximum(np.linalg.norm(angles, axis=1, keepdims=True), TINY)
            angles = angles * np.arctan(tangent) / tangent
        return _turned_axis(self._newton(pixels, angles, _turned_axis, step_of=lambda _: 1e-6))

    def _central(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) relative to the principal point, in units of the focal lengths."""
        fx, fy, cx, cy = self.intrinsics
        return (np.asarray(pixels, np.float64) - (cx, cy)) / (fx, fy)

    def _newton(
        self,
        pixels: np.ndarray,
        found: np.ndarray,
        ray_of: Callable[[np.ndarray], np.ndarray],
        step_of: Callable[[np.ndarray], np.ndarray | float],
    ) -> np.ndarray:
        """The values (N, 2) whose rays have these pixels, by Newton's method from ``found``; NaN:
        none.

        Args:
            ray_of: the directions (N, 3) of values (N, 2).
            step_of: the difference, (N, 1) or one, from which derivatives at these values are
                computed.
        """
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                step = step_of(found)
                at, right, down = (
                    self.project(ray_of(found + step * np.array(axis)))
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


def tangential(u: np.ndarray, v: np.ndarray, r2: np.ndarray, p1: float, p2: float) -> Image:
    """The tangential distortion of OpenCV: what is added to u and v, with r² = u² + v²."""
    return 2 * p1 * u * v + p2 * (r2 + 2 * u * u), 2 * p2 * u * v + p1 * (r2 + 2 * v * v)


def _turned_axis(angles: np.ndarray) -> np.ndarray:
    """The axis (0, 0, 1), turned by angles (N, 2) in radians towards x and y."""
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    return np.concatenate([angles * np.sinc(angle / math.pi), np.cos(angle)], 1)
