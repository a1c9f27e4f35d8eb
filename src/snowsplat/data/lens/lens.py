"""`Lens`: from directions in the frame of a camera to pixels of its photo, and back.

`models` has the table of all models. A model whose equation is a polynomial may fold: beyond some
angle the pixels return to the centre. `views` finds this angle.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_TINY = 1e-12
_NEWTON_STEPS = 30

#: x and y of positions in an image with the focal length 1 and the principal point at (0, 0).
Image = tuple[np.ndarray, np.ndarray]
#: Of a lens and the x, y, z of directions: where these are in the image; not finite where the model
#: has no position.
Equation = Callable[["Lens", np.ndarray, np.ndarray, np.ndarray], Image]


@dataclass(frozen=True)
class Model:
    """A camera model.

    Attributes:
        name: in COLMAP; in capitals, also if COLMAP does not have the model.
        parameters: their names, in the order of COLMAP. Models with "f" instead of "fx" and "fy"
            have one focal length. Coefficients are called as in OpenCV.
        equation: see `Equation`.
        in_transforms: the names of the model in transforms.json; none if it is not read there.
        angular: a fisheye: the angle to the optical axis is distorted, and not its tangent.
        straight: without coefficients, it is a pinhole camera.
        panoramic: shows all directions; the left border of a photo continues at its right border.
    """

    name: str
    parameters: tuple[str, ...]
    equation: Equation
    in_transforms: tuple[str, ...] = ()
    angular: bool = False
    straight: bool = False
    panoramic: bool = False


@dataclass(frozen=True)
class Lens:
    """The intrinsics of a photo: a camera model and its parameters.

    Attributes:
        kind: the camera model.
        width, height: in pixels, of the photos that ``params`` are for.
        params: the values of ``kind.parameters``; focal lengths and principal point in pixels.
    """

    kind: Model
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def model(self) -> str:
        """The name of the camera model."""
        return self.kind.name

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels; of a panorama, in pixels per radian at its centre."""
        p, width, height = self.params, self.width, self.height
        if self.kind.panoramic:
            return width / (2 * math.pi), height / math.pi, width / 2, height / 2
        return (
            (p[0], p[0], p[1], p[2]) if self.kind.parameters[0] == "f" else (p[0], p[1], p[2], p[3])
        )

    @property
    def coefficients(self) -> tuple[float, ...]:
        """The parameters that follow focal lengths and principal point."""
        return () if self.kind.panoramic else self.params[self.kind.parameters.index("cy") + 1 :]

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion. A fisheye without coefficients is no pinhole."""
        return self.kind.straight and not any(self.coefficients)

    def values_of(self, *names: str) -> list[float]:
        """The values of parameters; 0 for those that the model does not have."""
        values = dict(zip(self.kind.parameters, self.params, strict=True))
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
            u, v = self.kind.equation(self, rays[..., 0], rays[..., 1], rays[..., 2])
            u, v = fx * u + cx, fy * v + cy
        pixels = np.stack([u, v], -1)
        pixels[~(np.isfinite(u) & np.isfinite(v))] = np.nan
        return pixels

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """x / z and y / z (N, 2) of the directions of pixels (N, 2); NaN: none in front.

        By Newton's method, from the direction of a lens without coefficients.
        """
        start = self._central(pixels)
        if self.kind.angular:
            angle = np.maximum(np.linalg.norm(start, axis=1, keepdims=True), _TINY)
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
        if self.kind.panoramic:  # longitude and latitude
            (x, y), (level, down) = np.sin(angles).T, np.cos(angles).T
            return np.column_stack([down * x, y, down * level])
        if not self.kind.angular:
            tangent = np.maximum(np.linalg.norm(angles, axis=1, keepdims=True), _TINY)
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


def _turned_axis(angles: np.ndarray) -> np.ndarray:
    """The axis (0, 0, 1), turned by angles (N, 2) in radians towards x and y."""
    angle = np.linalg.norm(angles, axis=1, keepdims=True)
    return np.concatenate([angles * np.sinc(angle / math.pi), np.cos(angle)], 1)
