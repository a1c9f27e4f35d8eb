"""The display settings and the camera of a browser, as the page sends them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import torch

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid, rotation_from_quat
from snowsplat.scene.near_plane import NEAR

Mode = Literal["color", "depth", "alpha", "normals", "points", "ellipsoids", "cost", "error"]
Vector = tuple[float, float, float]

_NARROWEST = math.radians(1.0)  # field of view
_WIDEST = math.radians(170.0)
_MAX_SIDE = 16384  # pixels of a window
_LONGEST = 320, 2560  # limits of the longer side of an image, in pixels
_SCALE = 0.02, 1.0  # limits of the size of the Gaussians
# The norm of a quaternion is above this value and below its inverse.
_SMALL = 1e-9
_MAX_COORDINATE = 1e15  # computations in float32 are finite below it


def within(value: float, low: float, high: float) -> float:
    """The nearest number from ``low`` to ``high``."""
    return min(max(value, low), high)


@dataclass(frozen=True)
class Display:
    """How Gaussians are displayed; numbers are limited to their ranges.

    Attributes:
        mode: what is displayed: colours, depth … "error" is the difference from a photo.
        degree: of the spherical harmonics that are used for colours.
        scale: factor on the size of every Gaussian.
        wipe: fraction of the width, from the left, in which the photo covers the rendering.
        longest: pixels of the longer side of an image while the camera does not move.
        crop: lower and upper corner (x, y, z) of a box in the world; Gaussians outside are hidden.
    """

    mode: Mode = "color"
    degree: int = 3
    scale: float = 1.0
    wipe: float = 0.0
    longest: int = 1280
    crop: tuple[Vector, Vector] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", within(self.degree, 0, 3))
        object.__setattr__(self, "scale", within(self.scale, *_SCALE))
        object.__setattr__(self, "wipe", within(self.wipe, 0.0, 1.0))
        object.__setattr__(self, "longest", within(self.longest, *_LONGEST))


@dataclass(frozen=True)
class View:
    """The camera of a browser, in the world, and the size of its window.

    Attributes:
        number: counted by the page; an image has the number of the view that it shows.
        quat: wxyz of world_from_cam; x right, y down, z forward.
        position: camera centre, world units.
        fov: vertical field of view, radians.
        width, height: of the window in pixels.
        photo: index of the photo from whose position it looks, if there is one.

    Raises: ValueError: a value is not possible.
    """

    number: int
    quat: tuple[float, float, float, float]
    position: Vector
    fov: float
    width: int
    height: int
    photo: int | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.number < 1 << 32:
            raise ValueError("the number of a view is out of range")
        if not _SMALL < math.hypot(*self.quat) < 1.0 / _SMALL:
            raise ValueError("the quaternion of a view is not a rotation")
        if not math.hypot(*self.position) < _MAX_COORDINATE or not self.fov > 0.0:
            raise ValueError("the position or the field of view is out of range")
        if not (1 <= self.width <= _MAX_SIDE and 1 <= self.height <= _MAX_SIDE):
            raise ValueError("the size of a window is out of range")

    def camera(self, width: int, height: int, near: float = NEAR) -> Camera:
        """The camera of an image of this size, with the near plane ``near`` (world units)."""
        focal = 0.5 * height / math.tan(0.5 * within(self.fov, _NARROWEST, _WIDEST))
        rotation = rotation_from_quat(torch.tensor(self.quat, dtype=torch.float64))
        position = torch.tensor(self.position, dtype=torch.float64)
        pose = torch.cat([rotation, position[:, None]], 1)
        cx, cy = 0.5 * width, 0.5 * height
        return Camera(width, height, focal, focal, cx, cy, invert_rigid(pose), near)


def fit(width: int, height: int, longest: int) -> tuple[int, int]:
    """The size, reduced if necessary, so that its longer side is at most ``longest``."""
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class PhotoRectangle:
    """The rectangle of a photo in an image of any aspect ratio: centred, as large as possible.

    The unit is a pixel of the image.
    """

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def within(cls, camera: Camera, width: int, height: int) -> PhotoRectangle:
        """The rectangle of the photo of ``camera`` in an image of ``width`` × ``height``."""
        scale = min(width / camera.width, height / camera.height)
        w = min(width, max(1, round(camera.width * scale)))
        h = min(height, max(1, round(camera.height * scale)))
        return cls((width - w) // 2, (height - h) // 2, w, h)

    def camera(self, camera: Camera, width: int, height: int) -> Camera:
        """The camera of the whole image, ``width`` × ``height``; ``camera``: of the photo."""
        inner = camera.scaled(self.width, self.height)
        cx, cy = inner.cx + self.left, inner.cy + self.top
        return replace(inner, width=width, height=height, cx=cx, cy=cy)
