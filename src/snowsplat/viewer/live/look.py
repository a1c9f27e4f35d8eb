"""What a browser wants to see, and from where."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from snowsplat.scene.camera import Camera
from snowsplat.scene.geometry import invert_rigid, rotation_from_quat

Mode = Literal["color", "depth", "alpha", "normals", "points", "ellipsoids", "cost", "error"]

_NARROWEST, _WIDEST = math.radians(1.0), math.radians(170.0)


@dataclass(frozen=True)
class Look:
    """How Gaussians are shown.

    Attributes:
        mode: what a pixel tells: its colour, its depth …; "error" compares with a photo.
        sh_degree: how far colours change with the direction of view.
        scale: factor on the size of every Gaussian.
        crop: low and high corner (x, y, z, world) of the box outside which nothing is shown.
        wipe: the part of a photo, from its left edge, that is shown over the render.
    """

    mode: Mode = "color"
    sh_degree: int = 3
    scale: float = 1.0
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    wipe: float = 0.0


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a browser looks from.

    Attributes:
        quat: (4,) wxyz and position: (3,) of world_from_cam, float64; x right, y down, z forward.
        fov: vertical field of view, radians.
        width, height: of its picture on the screen, pixels.
    """

    quat: Tensor = field(repr=False)
    position: Tensor
    fov: float
    width: int
    height: int

    def camera(self, width: int, height: int) -> Camera:
        """The camera of a picture of this size."""
        focal = 0.5 * height / math.tan(0.5 * min(max(self.fov, _NARROWEST), _WIDEST))
        pose = torch.cat([rotation_from_quat(self.quat), self.position[:, None]], 1)
        return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, invert_rigid(pose))

    def is_near(self, other: Pose) -> bool:
        """Whether it is the same place and direction, but for the rounding of a browser."""
        turn = abs(float((self.quat * other.quat).sum()))
        distance = float((self.position - other.position).norm())
        size = 1.0 + float(self.position.norm())
        return turn > 1.0 - 1e-6 and distance < 1e-4 * size and abs(self.fov - other.fov) < 1e-3


def fit(width: int, height: int, longest: int) -> tuple[int, int]:
    """The size, no larger than it is, whose longer side is at most ``longest``."""
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


@dataclass(frozen=True)
class Placed:
    """A photo's place in a picture: the largest rectangle of its shape that fits, in the middle."""

    left: int
    top: int
    width: int
    height: int

    @classmethod
    def within(cls, camera: Camera, width: int, height: int) -> Placed:
        """Where the photo of ``camera`` lies in a picture of ``width`` × ``height``."""
        scale = min(width / camera.width, height / camera.height)
        w = min(width, max(1, round(camera.width * scale)))
        h = min(height, max(1, round(camera.height * scale)))
        return cls((width - w) // 2, (height - h) // 2, w, h)

    def camera(self, camera: Camera, width: int, height: int) -> Camera:
        """The photo's own camera, its picture widened to ``width`` × ``height`` around it."""
        inner = camera.scaled(self.width, self.height)
        cx, cy = inner.cx + self.left, inner.cy + self.top
        return Camera(width, height, inner.fx, inner.fy, cx, cy, camera.cam_from_world)
