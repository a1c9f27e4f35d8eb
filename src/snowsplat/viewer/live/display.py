"""The display settings and the camera pose of a browser."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid, rotation_from_quat
from snowsplat.scene.near_plane import NEAR

Mode = Literal["color", "depth", "alpha", "normals", "points", "ellipsoids", "cost", "error"]

_NARROWEST = math.radians(1.0)  # field of view
_WIDEST = math.radians(170.0)


@dataclass(frozen=True)
class DisplaySettings:
    """How Gaussians are displayed."""

    # What is displayed: colours, depth … "error" is the difference from a photo.
    mode: Mode = "color"
    sh_degree: int = 3  # degree of the spherical harmonics that are used for colours
    scale: float = 1.0  # factor on the size of every Gaussian
    # Lower and upper corner (x, y, z) of a box in the world; Gaussians outside are hidden.
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    # Fraction of the width, from the left, in which the photo covers the rendering.
    wipe: float = 0.0


@dataclass(frozen=True, eq=False)
class Pose:
    """The camera pose of a browser, in the world."""

    # (4,) wxyz, float64, rotation of world_from_cam; x right, y down, z forward.
    quat: Tensor = field(repr=False)
    position: Tensor  # (3,) float64, camera centre
    fov: float  # vertical field of view in radians
    width: int  # of the window, in pixels
    height: int  # of the window, in pixels
    number: int = 0  # that the browser has given to it

    def camera(self, width: int, height: int, near: float = NEAR) -> Camera:
        """The camera of an image of this size, with the near plane ``near`` (world units)."""
        focal = 0.5 * height / math.tan(0.5 * min(max(self.fov, _NARROWEST), _WIDEST))
        pose = torch.cat([rotation_from_quat(self.quat), self.position[:, None]], 1)
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
